"""The bed of soil: its size, walls and undisturbed particles."""

from __future__ import annotations

import hashlib
import json
import math
from functools import cached_property, lru_cache
from typing import Any, ClassVar, Literal, get_args

import numpy as np
from scipy import ndimage

from .settings import Settings, lengths, setting, settings
from .state import SceneError


def _wall(where: str, kinds: str = "no_slip, slip, periodic") -> Any:
    return setting("no_slip", where, ge=0, words=f"; allowed: {kinds} or a friction coefficient of 0 or more")


@settings
class Walls(Settings):
    """Condition at each pair of walls and at the floor.

    - `no_slip`: soil sticks, also where it would move away.
    - `slip`: soil moves along the wall freely, but neither into it nor away from it.
    - a number, 0 or more: Coulomb friction with that coefficient; soil may move away.
    - `periodic` (x or y): no walls; what leaves at one end comes in at the other.
    """

    group: ClassVar[str] = "bed.walls"

    x: Literal["no_slip", "slip", "periodic"] | float = _wall("walls at x = 0, x = Lx")
    y: Literal["no_slip", "slip", "periodic"] | float = _wall("walls at y = 0, y = Ly")
    floor: Literal["no_slip", "slip"] | float = _wall("the floor at z = -Lz", "no_slip, slip")

    @property
    def conditions(self) -> tuple[str, str, str]:
        """`no_slip`, `slip`, `friction` or `periodic` for x, y and the floor: what the kernels are compiled for."""
        x, y, floor = (v if isinstance(v, str) else "friction" for v in (self.x, self.y, self.floor))
        return x, y, floor

    @property
    def friction(self) -> tuple[float, float, float]:
        """Coulomb coefficients for x, y and the floor, 0 where there is no friction [-]."""
        x, y, floor = (0.0 if isinstance(v, str) else v for v in (self.x, self.y, self.floor))
        return x, y, floor


# --- Where the particles of an undisturbed bed are ------------------------------------------------------

Arrangement = Literal["lattice", "jittered", "poisson"]
# Poisson-disk radius in units of the particle spacing; with it a bed holds about 0.8 points per cube of the
# spacing, which is the published beds' density.
POISSON_RADIUS = 0.897


@lru_cache(maxsize=8)  # a random bed takes seconds to fill, and all scenes of a dataset share it
def arrange(
    kind: str,
    size: tuple[float, float, float],
    spacing: float,
    seed: int,
    mirrored: bool = False,
    above: float = 0.0,
) -> tuple[np.ndarray, float]:
    """Particles of a bed 0 <= x <= Lx, 0 <= y <= Ly, -Lz <= z <= 0, or up to `above` or a little more.

    Args:
        kind: `lattice` (full, regular), `jittered` (the lattice, each particle moved at random by up to half
            a spacing) or `poisson` (random points no closer than 0.897 spacings, not filling the bed).
        size: (Lx, Ly, Lz) [m].
        spacing: nominal distance between particles [m].
        seed: of the random numbers.
        mirrored: a random bed is its own mirror image about y = Ly / 2.
        above: height above z = 0 that is filled, too [m].

    Returns:
        Positions [m], shape (n, 3), float64, read-only, and the volume of one particle [m^3].
    """
    if kind not in get_args(Arrangement):
        raise SceneError(f"bed.arrangement is {kind!r}; allowed: {', '.join(get_args(Arrangement))}")
    volume = particle_volume(kind, size, spacing)
    if kind == "poisson":
        lx, ly, lz = size
        points = _random_points((lx, ly, lz + above), POISSON_RADIUS * spacing, seed, mirrored)
        points[:, 2] += above
    else:
        counts = _lattice_counts(size, spacing)
        cell = np.asarray(size) / counts
        counts[2] += math.ceil(above / cell[2])
        axes = [(np.arange(c) + 0.5) * s for c, s in zip(counts, cell, strict=True)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        points[:, 2] -= size[2]
        if kind == "jittered":
            points = points + _jitter(cell, counts, seed, mirrored)
    points.flags.writeable = False
    return points, volume


def particle_volume(kind: str, size: tuple[float, float, float], spacing: float) -> float:
    """The volume that `arrange` gives with the particles [m^3], without making these."""
    if kind == "poisson":
        return spacing**3
    return float(np.prod(np.asarray(size) / _lattice_counts(size, spacing)))


def _lattice_counts(size: tuple[float, float, float], spacing: float) -> np.ndarray:
    """Particles of a lattice along each side, whose spacing is adjusted to fit it, shape (3,)."""
    return np.maximum(1, np.round(np.asarray(size) / spacing)).astype(int)


def _jitter(cell: np.ndarray, counts: np.ndarray, seed: int, mirrored: bool) -> np.ndarray:
    """By what the particles of a lattice of such cells [m] move [m], shape (n, 3)."""
    random = np.random.default_rng(seed).uniform(-0.5, 0.5, (np.prod(counts), 3))
    moved = (cell * random).reshape(*counts, 3)
    if mirrored:
        # The far half moves as the near one does, mirrored; particles in the middle stay in the plane.
        image = moved[:, ::-1] * [1.0, -1.0, 1.0]
        far = np.arange(counts[1]) >= (counts[1] + 1) // 2
        moved[:, far] = image[:, far]
        if counts[1] % 2:
            moved[:, counts[1] // 2, :, 1] = 0.0
    return moved.reshape(-1, 3)


def _random_points(size: tuple[float, float, float], radius: float, seed: int, mirrored: bool) -> np.ndarray:
    """Points of a bed that keep `radius` apart [m], shape (n, 3).

    Sampled in a larger box and trimmed: points crowd at the edge of the box they were sampled in.
    """
    lx, ly, lz = size
    margin = 2.0 * radius
    if mirrored:
        # Points that would be too close to their own image go onto the plane.
        half = (lx + 2.0 * margin, 0.5 * ly + margin, lz + 2.0 * margin)
        points = poisson_disk(half, radius, seed, snap=0.5 * radius)
        points += [-margin, 0.5 * ly, margin]
        off_plane = points[points[:, 1] > 0.5 * ly]
        points = np.concatenate([points, off_plane * [1.0, -1.0, 1.0] + [0.0, ly, 0.0]])
        points = points[_reading_order(points, radius)]
    else:
        points = poisson_disk((lx + 2.0 * margin, ly + 2.0 * margin, lz + 2.0 * margin), radius, seed)
        points += [-margin, -margin, margin]
    return points[((points >= [0.0, 0.0, -lz]) & (points <= [lx, ly, 0.0])).all(axis=1)]


def poisson_disk(size: tuple[float, float, float], radius: float, seed: int, snap: float = 0.0) -> np.ndarray:
    """Random points no closer to each other than `radius` (Bridson 2007), shape (n, 3) [m].

    What would come closer than `snap` [m] to the side y = 0 is put on it.
    """
    rng = np.random.default_rng(seed)
    extent = np.asarray(size, dtype=float)
    cell = radius / np.sqrt(3.0)
    shape = np.floor(extent / cell).astype(int) + 1
    pad = 2  # a point's neighbours lie at most two cells away; padding spares bounds checks
    index = np.full(shape + 2 * pad, -1, dtype=np.int64)
    points = np.empty((int(np.prod(shape)) + 1, 3))
    # Row -1 of `points` stands for "no neighbour": it lies outside every bed.
    points[-1] = -1e9
    offsets = np.stack(np.meshgrid(*[np.arange(-2, 3)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    strides = np.array([index.shape[1] * index.shape[2], index.shape[2], 1])
    flat, flat_offsets = index.reshape(-1), offsets @ strides

    def key(x: np.ndarray) -> np.ndarray:
        return ((x // cell).astype(np.int64) + pad) @ strides

    points[0] = extent * rng.random(3)
    points[0, 1] = points[0, 1] if points[0, 1] >= snap else 0.0
    flat[key(points[0])] = 0
    count, active = 1, [0]
    while active:
        slot = int(rng.integers(len(active)))
        direction = rng.normal(size=(30, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        distance = radius * (1.0 + 7.0 * rng.random((30, 1))) ** (1.0 / 3.0)
        trial = points[active[slot]] + direction * distance
        trial[(trial[:, 1] >= 0.0) & (trial[:, 1] < snap), 1] = 0.0
        trial = trial[np.all((trial >= 0.0) & (trial < extent), axis=1)]
        near = points[flat[key(trial)[:, None] + flat_offsets]]
        free = np.all(np.sum((near - trial[:, None]) ** 2, axis=-1) >= radius**2, axis=1)
        if free.any():
            new = trial[np.argmax(free)]
            points[count] = new
            flat[key(new)] = count
            active.append(count)
            count += 1
        else:
            active[slot] = active[-1]
            active.pop()
    # Sorted so that neighbours in space are near in memory: the transfers read the grid in order.
    found = points[:count]
    return found[_reading_order(found, radius)] - np.array([0.0, 0.0, extent[2]])


def _reading_order(points: np.ndarray, radius: float) -> np.ndarray:
    """Indices that sort points by cells of `radius` in x, then y, then z."""
    return np.lexsort((points[:, 2] // radius, points[:, 1] // radius, points[:, 0] // radius))


# --- The surface at the start ---------------------------------------------------------------------------

MOST_HEIGHTS = 100_000
"""Of a map; the scene holds them all, and more than one in a grid spacing says nothing."""
_STAIRS = 0.3
"""Slope from which on the columns of a lattice are stairs whose mean height is right."""
STEEPEST = 60.0
"""Slope of the surface as one number [degrees]."""


def _as_heights(rows: Any) -> tuple[tuple[float, ...], ...]:
    """The rows of a map of heights, checked."""
    try:
        heights = np.asarray(rows, dtype=float)
    except (TypeError, ValueError):
        heights = np.zeros(0)
    if heights.ndim != 2 or min(heights.shape) < 2:
        raise SceneError(
            "bed.surface is no map of heights; it needs 2 or more rows, from x = 0 to Lx, of 2 or more heights [m], "
            "from y = 0 to Ly, all rows of the same length"
        )
    if heights.size > MOST_HEIGHTS:
        raise SceneError(
            f"bed.surface has {heights.shape[0]} x {heights.shape[1]} heights; at most {MOST_HEIGHTS} are allowed: "
            "take a coarser map, one height for each grid spacing is enough"
        )
    if not np.isfinite(heights).all():
        row, column = np.argwhere(~np.isfinite(heights))[0]
        raise SceneError(
            f"bed.surface holds a height that is not finite, in row {row + 1}, number {column + 1}"
        )
    return tuple(map(tuple, heights.tolist()))


# --- The bed: its bin, grid and particles ----------------------------------------------------------------

PADDING = 3
"""Grid cells outside the bin, so that the nodes around a particle at a wall exist."""
_LONG = 20.0
"""A bin of that length [m] was likely given in millimetres, if its grid is too large."""
MOST_PARTICLES = 20_000_000
MOST_NODES = 200_000_000
"""Of the grid; both far beyond what has been computed, and short of what ends in an error or never ends."""


@settings
class Bed(Settings):
    """The soil bin and how it is filled. z = 0 is the undisturbed surface."""

    group: ClassVar[str] = "bed"

    size: tuple[float, float, float] = lengths((0.80, 0.60, 0.15), "Lx, Ly, Lz")
    spacing: float = setting(0.0133333333, "grid spacing, at most half the bin's smallest side", "m")
    particles_per_cell: float = setting(1.0, "particles in a grid cell of a full bed", gt=0, le=64)
    arrangement: Arrangement = setting(
        "lattice", "of the particles: a lattice, one with each particle moved at random, or random points"
    )
    seed: int = setting(0, "of the random arrangements", ge=0, le=10**18)
    mirrored: bool = setting(False, "a random arrangement mirrors itself about y = Ly / 2, as symmetry needs")
    initial_stress: Literal["geostatic", "k0", "none"] = setting(
        "geostatic",
        "geostatic: the pressure is rho g depth, the same in all directions; k0: the horizontal stress is "
        "nu / (1 - nu) times the vertical one; none: stress-free, settles in the first frames",
    )
    headroom: float = setting(0.25, "height above the surface that soil may reach", "m", gt=0)
    surface: float | tuple[Any, ...] | None = setting(
        None,
        "of the soil at the start: its slope, rising towards +x; or a map of heights above z = 0 [m], rows from x = 0 "
        "to Lx of heights from y = 0 to Ly (a file; in Python also a function of x and y). None: flat, z = 0",
        "degrees",
        ge=-STEEPEST,
        le=STEEPEST,
        words=f" degrees; allowed: -{STEEPEST:g} to {STEEPEST:g}, or a map of heights [m]",
    )
    store_every: int = setting(
        1,
        "one particle of so many is recorded; the solver computes all",
        ge=1,
        words="; it must be a whole number, 1 or more",
    )
    walls: Walls = setting(Walls, "what soil may do at walls and floor")

    def __post_init__(self) -> None:
        given: Any = self.surface
        if callable(given):
            axes = [np.linspace(0.0, side, max(2, round(side / self.spacing) + 1)) for side in self.size[:2]]
            given = np.broadcast_to(given(*np.meshgrid(*axes, indexing="ij")), [len(one) for one in axes])
        if isinstance(given, (list, tuple, np.ndarray)):
            object.__setattr__(self, "surface", _as_heights(given))
        super().__post_init__()
        if not 0 < self.spacing <= min(self.size) / 2:
            raise SceneError(
                f"bed.spacing is {self.spacing} m; allowed: above 0, at most half the bin's smallest side "
                f"({min(self.size) / 2:g} m); lengths are in metres"
            )
        lowest, high = self._lowest_and_highest
        if not (lowest >= -self.size[2] and high < self.headroom and high > -self.size[2] + self.spacing):
            raise SceneError(
                f"bed.surface reaches from {lowest:.3g} to {high:.3g} m; allowed: from the floor ({-self.size[2]:g} m) "
                f"to below bed.headroom ({self.headroom:g} m), and a grid spacing of soil somewhere"
            )
        filled = (*self.size[:2], self.size[2] + max(0.0, high))
        particles = math.prod(s / self.spacing for s in filled) * self.particles_per_cell
        if not particles <= MOST_PARTICLES:
            raise SceneError(
                f"the bed would hold {particles:.2g} particles; at most {MOST_PARTICLES:g} are allowed: "
                + (
                    f"bed.size is {list(self.size)}, in metres: was it given in millimetres?"
                    if max(self.size) >= _LONG
                    else "use a larger bed.spacing, a smaller bed.size or fewer bed.particles_per_cell"
                )
            )
        height, margin = self.size[2] + self.headroom, 2.0 * PADDING + 2.0
        floor = math.prod(s / self.spacing + margin for s in self.size[:2])
        nodes = floor * (height / self.spacing + margin)
        if not nodes <= MOST_NODES:
            fits = floor * (self.size[2] / self.spacing + margin) <= 0.5 * MOST_NODES
            key = "lower bed.headroom" if fits else "use a larger bed.spacing"
            raise SceneError(
                f"bed.headroom is {self.headroom} m and bed.spacing {self.spacing} m: the grid would have {nodes:.3g} "
                f"nodes; at most {MOST_NODES:g} are allowed: {key}"
            )
        for name, kind, length in zip("xy", self.walls.conditions, self.size, strict=False):
            if kind == "periodic" and abs(length / self.spacing - round(length / self.spacing)) > 1e-6:
                raise SceneError(
                    f"bed.walls.{name} is periodic but the bin's {length} m are {length / self.spacing:.3f} grid "
                    "spacings; it must be a whole number of them: change bed.size or bed.spacing"
                )

    @property
    def particle_spacing(self) -> float:
        """Nominal distance between particles [m]."""
        return self.spacing / self.particles_per_cell ** (1.0 / 3.0)

    @property
    def particle_volume(self) -> float:
        """Volume of a particle [m^3], as in `filled`."""
        return particle_volume(self.arrangement, self.size, self.particle_spacing)

    @property
    def node_counts(self) -> tuple[int, int, int]:
        """Nodes of the grid along x, y and z, with those outside the bin and up to the headroom."""
        h = self.spacing
        x, y = (math.ceil(s / h - 1e-6) + 2 * PADDING + 1 for s in self.size[:2])
        return x, y, math.ceil((self.size[2] + self.headroom) / h) + 2 * PADDING + 1

    @cached_property
    def filled(self) -> tuple[np.ndarray, float]:
        """Particle positions (n, 3) [m] and the volume of one [m^3]."""
        if self.surface is None:
            return self._arranged
        above = max(0.0, self._lowest_and_highest[1])
        given = self.arrangement, self.size, self.particle_spacing, self.seed, self.mirrored
        positions, volume = arrange(*given, above)
        height = positions[:, 2]
        if self.arrangement == "lattice":
            # Whole layers would be half a layer off where the surface is flat: there columns end at one layer or the
            # next, in the order of a sequence that never repeats (Roberts's R2), the same on both sides of mid-width.
            along, across, layers = _lattice_counts(self.size, self.particle_spacing).tolist()
            i, j = np.indices((along, across))
            turn = (0.7548776662466927 * i + 0.5698402909980532 * np.minimum(j, across - 1 - j)) % 1.0 - 0.5
            turn = np.repeat(turn.ravel(), len(positions) // turn.size)
            steep = np.linalg.norm(self.slope_at(*positions[:, :2].T), axis=0)
            height = height + np.clip(1.0 - steep / _STAIRS, 0.0, 0.998) * turn * self.size[2] / layers
        below = height < self.surface_at(*positions[:, :2].T)
        return positions[below], volume

    @cached_property
    def _heights(self) -> np.ndarray:
        """A map whose bilinear interpolation is the surface [m]."""
        if isinstance(self.surface, tuple):
            return np.array(self.surface)
        rise = 0.5 * self.size[0] * math.tan(math.radians(self.surface or 0.0))
        return np.array([[-rise, -rise], [rise, rise]])

    @property
    def _lowest_and_highest(self) -> tuple[float, float]:
        return float(self._heights.min()), float(self._heights.max())

    def surface_at(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Height of the soil's surface at the start at some places, beyond the walls as at them [m]."""
        shares = (np.asarray(place) / length for place, length in zip((x, y), self.size, strict=False))
        counts = np.array(self._heights.shape) - 1
        places = [share * count for share, count in zip(shares, counts, strict=True)]
        return ndimage.map_coordinates(self._heights, places, order=1, mode="nearest")

    def slope_at(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Rise of the surface along x and y over a grid spacing [-], shape (2, n)."""
        h, (lx, ly, _) = 0.5 * self.spacing, self.size
        along = self.surface_at(x + h, y) - self.surface_at(x - h, y)
        across = self.surface_at(x, y + h) - self.surface_at(x, y - h)
        # At a wall only one side is there.
        return np.stack(
            [
                along / (np.minimum(x + h, lx) - np.maximum(x - h, 0.0)),
                across / (np.minimum(y + h, ly) - np.maximum(y - h, 0.0)),
            ]
        )

    @property
    def soil_volume(self) -> float:
        """Between the floor and the surface [m^3]."""
        if self.surface is None:
            return float(np.prod(self.size))
        parts = [np.r_[0.5, np.ones(count - 2), 0.5] / (count - 1) for count in self._heights.shape]
        return float(np.prod(self.size[:2]) * (self.size[2] + parts[0] @ self._heights @ parts[1]))

    @property
    def _arranged(self) -> tuple[np.ndarray, float]:
        return arrange(self.arrangement, self.size, self.particle_spacing, self.seed, self.mirrored)

    @property
    def filling(self) -> float:
        """Share of the bin below the surface that its particles fill [-]: 1, but for random points that keep apart."""
        positions, volume = self._arranged
        return len(positions) * volume / float(np.prod(self.size))

    @property
    def arrangement_hash(self) -> str:
        """Same for every run whose recorded particles start at the same places in the same order."""
        key: list[Any] = [self.size, self.spacing, self.particles_per_cell, self.arrangement]
        if self.arrangement != "lattice":
            key.append(self.seed)
            if self.mirrored:
                key.append("mirrored")
        if self.surface is not None:
            key.append(["surface", self.surface])
        if self.store_every != 1:
            key.append(f"one of {self.store_every}")
        return digest(key)


def digest(key: list[Any]) -> str:
    """A short name of plain data, the same for the same data."""
    return hashlib.blake2b(json.dumps(key).encode(), digest_size=8).hexdigest()
