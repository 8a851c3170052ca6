"""The free surface of a bed of particles as a height map on a regular horizontal grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["SurfaceGrid", "height_map", "surface_grid"]

# A column two particle spacings wide holds several particles of an undisturbed top layer, so that
# the highest of them follows the surface and no column of a full bed is empty.
SPACINGS_PER_COLUMN = 2.0


@dataclass(frozen=True)
class SurfaceGrid:
    """Columns of a height map.

    Attributes:
        x_edges: borders of the columns along x [m], shape (nx + 1,), increasing, equally spaced.
        y_edges: borders of the columns along y [m], shape (ny + 1,), increasing, equally spaced.
    """

    x_edges: np.ndarray
    y_edges: np.ndarray

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
    """Edge [m] of the cube that one particle occupies in an undisturbed bed.

    The bed reaches half a spacing s beyond its outermost particles, so Π (extent + s) = n s³, solved by
    iteration.

    Args:
        positions: an undisturbed bed [m], shape (n, 3).
    """
    extent = np.ptp(np.asarray(positions, dtype=np.float64), axis=0)
    solid = extent[extent > 0.0]
    if solid.size == 0:
        return 1.0
    spacing = 0.0
    for _ in range(50):
        spacing = (np.prod(solid + spacing) / len(positions)) ** (1.0 / solid.size)
    return float(spacing)


def surface_grid(positions: np.ndarray, column: float | None = None) -> SurfaceGrid:
    """Height-map columns that cover an undisturbed bed.

    Args:
        positions: particles of the undisturbed bed [m], shape (n, 3).
        column: wanted edge of a column [m]; by default two particle spacings. The edge used is the
            nearest that divides the bed's length and width.
    """
    positions = np.asarray(positions, dtype=np.float64)
    spacing = particle_spacing(positions)
    column = SPACINGS_PER_COLUMN * spacing if column is None else column
    edges = []
    for axis in (0, 1):
        # The bed reaches half a spacing beyond its outermost particles.
        low, high = positions[:, axis].min() - 0.5 * spacing, positions[:, axis].max() + 0.5 * spacing
        count = max(1, round((high - low) / column))
        edges.append(np.linspace(low, high, count + 1))
    return SurfaceGrid(*edges)


def height_map(positions: np.ndarray, grid: SurfaceGrid) -> np.ndarray:
    """Height of the highest particle of every column.

    Particles beyond the grid's border count for the outermost columns.

    Args:
        positions: particles [m], shape (n, 3).
        grid: columns of the map.

    Returns:
        Heights z [m], shape (nx, ny); NaN where a column holds no particle.
    """
    positions = np.asarray(positions)
    nx, ny = grid.shape
    column = []
    for axis, edges, count in ((0, grid.x_edges, nx), (1, grid.y_edges, ny)):
        share = (positions[:, axis] - edges[0]) / (edges[-1] - edges[0])
        share = np.clip(np.nan_to_num(share), 0.0, 1.0)  # clipped before the cast: inf has no integer
        column.append(np.minimum((share * count).astype(np.int64), count - 1))
    heights = np.full(nx * ny, -np.inf)
    np.maximum.at(heights, column[0] * ny + column[1], positions[:, 2].astype(np.float64))
    heights[heights == -np.inf] = np.nan
    return heights.reshape(nx, ny)
