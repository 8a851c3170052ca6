"""The soil's surface: the height of the highest particle in columns."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mpm_warp import Bed, SceneError
from mpm_warp.settings import short_repr
from sgns.config import UserError, library

if TYPE_CHECKING:
    import xarray

# A column two particle spacings wide holds several particles of an undisturbed top layer, so that
# the highest of them follows the surface and no column of a full bed is empty.
SPACINGS_PER_COLUMN = 2.0


@dataclass(frozen=True)
class SurfaceGrid:
    """Columns of a height map."""

    x_edges: np.ndarray  # borders of the columns along x [m], shape (nx + 1,), increasing, equally spaced
    y_edges: np.ndarray  # borders of the columns along y [m], shape (ny + 1,), increasing, equally spaced

    @property
    def shape(self) -> tuple[int, int]:
        """Number of columns along x and y: (nx, ny)."""
        return len(self.x_edges) - 1, len(self.y_edges) - 1

    @property
    def x_centres(self) -> np.ndarray:
        """Middle of the columns along x [m], shape (nx,)."""
        return 0.5 * (self.x_edges[1:] + self.x_edges[:-1])

    @property
    def y_centres(self) -> np.ndarray:
        """Middle of the columns along y [m], shape (ny,)."""
        return 0.5 * (self.y_edges[1:] + self.y_edges[:-1])


def particle_spacing(positions: np.ndarray) -> float:
    """Edge [m] of the cube that one particle occupies in an undisturbed bed (n, 3) [m].

    The bed reaches half a spacing s beyond its outermost particles, so Π (extent + s) = n s³, solved by iteration.
    """
    extent = np.ptp(np.asarray(positions, dtype=np.float64), axis=0)
    solid = extent[extent > 0.0]
    if solid.size == 0:
        return 1.0
    spacing = 0.0
    for _ in range(50):
        spacing = (np.prod(solid + spacing) / len(positions)) ** (1.0 / solid.size)
    return float(spacing)


def surface_grid(positions: np.ndarray) -> SurfaceGrid:
    """Height-map columns that cover an undisturbed bed (n, 3) [m]."""
    positions = np.asarray(positions, dtype=np.float64)
    spacing = particle_spacing(positions)
    # The bed reaches half a spacing beyond its outermost particles.
    return columns(positions.min(axis=0) - 0.5 * spacing, positions.max(axis=0) + 0.5 * spacing, spacing)


def columns(low: np.ndarray, high: np.ndarray, spacing: float) -> SurfaceGrid:
    """Height-map columns between two corners [m] for particles so far apart [m].

    Their edge is the nearest to two particle spacings that divides length and width.
    """
    counts = [max(1, round(length / (SPACINGS_PER_COLUMN * spacing))) for length in high - low]
    return SurfaceGrid(*(np.linspace(low[axis], high[axis], counts[axis] + 1) for axis in (0, 1)))


def height_map(positions: np.ndarray, grid: SurfaceGrid) -> np.ndarray:
    """Height of the highest particle of every column [m], shape (nx, ny); NaN where a column holds no particle.

    Particles (n, 3) [m] beyond the grid's border count for the outermost columns.
    """
    positions, count = np.asarray(positions), np.array(grid.shape)
    low, high = (np.array([grid.x_edges[end], grid.y_edges[end]]) for end in (0, -1))
    share = (positions[:, :2] - low) / (high - low)
    share = np.clip(np.nan_to_num(share), 0.0, 1.0)  # clipped before the cast: inf has no integer
    column, row = np.minimum((share * count).astype(np.int64), count - 1).T
    heights = np.full(grid.shape, -np.inf)
    np.maximum.at(heights, (column, row), positions[:, 2].astype(np.float64))
    heights[heights == -np.inf] = np.nan
    return heights


class Surface(NamedTuple):
    """The soil's surface over the bin. Flat soil at rest has z = 0, to a part of a particle."""

    x: np.ndarray
    """Middle of the columns along x [m], shape (nx,)."""
    y: np.ndarray
    """Middle of the columns along y [m], shape (ny,)."""
    z: np.ndarray
    """Height [m], shape (nx, ny): half a particle spacing above the highest particle of a column; NaN where a column
    holds none."""

    def __repr__(self) -> str:
        return short_repr(self)

    def to_xarray(self) -> xarray.DataArray:
        """The heights with named dimensions x and y. Needs xarray."""
        xr = library("xarray", "surface.to_xarray()")
        coords = {name: (name, getattr(self, name), {"units": "m"}) for name in ("x", "y")}
        return xr.DataArray(self.z, coords, ("x", "y"), "height", {"units": "m"})


_MOST_CELLS = 10_000_000


def soil_surface(positions: np.ndarray, scene: Mapping[str, Any], resolution: float | None = None) -> Surface:
    """Surface of particles (n, 3) [m] in the bin of a scene, given as plain data.

    Args:
        positions: Of the particles.
        scene: Says how the bin is filled.
        resolution: Edge of the cells [m]; the nearest to it that divides length and width is taken. Heights are still
            those of columns two particle spacings wide, each cell has the mean over its area: the volume stays. None:
            the columns themselves.

    Raises:
        UserError: The scene does not say how its bed is filled, or the resolution is no such edge.
    """
    try:
        bed = Bed.from_dict(scene["bed"])
    except (KeyError, SceneError) as error:
        raise UserError(
            f"the scene does not say how its bed is filled ({error}), so it has no columns to measure a surface in"
        ) from error
    spacing = bed.particle_spacing * bed.store_every ** (1 / 3)
    grid = columns(np.zeros(3), np.array(bed.size), spacing)
    surface = Surface(grid.x_centres, grid.y_centres, height_map(positions, grid) + 0.5 * spacing)
    if resolution is None:
        return surface
    size = bed.size[:2]
    if not (isinstance(resolution, Real) and _least_edge(size) <= resolution <= max(size)):
        raise UserError(
            f"resolution is {resolution!r}; allowed: the edge of a cell in metres, {_least_edge(size):.2g} to "
            f"{max(size):g}"
        )
    counts = [max(1, round(length / float(resolution))) for length in size]
    edges = [np.linspace(0.0, length, count + 1) for length, count in zip(size, counts, strict=True)]
    cells = SurfaceGrid(*edges)
    across = _shares(grid.x_edges, cells.x_edges), _shares(grid.y_edges, cells.y_edges)
    held, known = np.nan_to_num(surface.z), np.isfinite(surface.z).astype(float)
    total, area = (across[0] @ part @ across[1].T for part in (held, known))
    with np.errstate(invalid="ignore"):  # where a cell holds no particle
        return Surface(cells.x_centres, cells.y_centres, total / area)


def _least_edge(size: Sequence[float]) -> float:
    """Of cells that are not too many for the memory [m]."""
    return math.sqrt(size[0] * size[1] / _MOST_CELLS)


def _shares(old: np.ndarray, new: np.ndarray) -> np.ndarray:
    """How much of each old interval lies in each new one [m], shape (new, old); by their borders."""
    low, high = np.maximum(old[:-1], new[:-1, None]), np.minimum(old[1:], new[1:, None])
    overlap = np.maximum(high - low, 0.0)
    return np.where(overlap > 1e-9 * (old[-1] - old[0]), overlap, 0.0)  # not round-off
