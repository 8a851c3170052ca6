"""Where the particles of an undisturbed bed are."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from .errors import SceneError

__all__ = ["ARRANGEMENTS", "arrange", "lattice", "particle_volume", "poisson_disk", "rows_of"]

ARRANGEMENTS = ("lattice", "jittered", "poisson")

# Poisson-disk radius in units of the particle spacing; with it a bed holds about 0.8 points per cube of the
# spacing, which is the published beds' density.
POISSON_RADIUS = 0.897


@lru_cache(maxsize=8)  # a random bed takes seconds to fill, and all scenes of a dataset share it
def arrange(
    kind: str, size: tuple[float, float, float], spacing: float, seed: int, mirrored: bool = False
) -> tuple[np.ndarray, float]:
    """Particles of a bed 0 <= x <= Lx, 0 <= y <= Ly, -Lz <= z <= 0.

    Args:
        kind: `lattice` (full, regular), `jittered` (the lattice, each particle moved at random by up to half
            a spacing) or `poisson` (random points no closer than 0.897 spacings, not filling the bed).
        size: (Lx, Ly, Lz) [m].
        spacing: nominal distance between particles [m].
        seed: of the random numbers.
        mirrored: a random bed is its own mirror image about y = Ly / 2.

    Returns:
        Positions [m], shape (n, 3), float64, read-only, and the volume of one particle [m^3].
    """
    points, volume = _arranged(kind, size, spacing, seed, mirrored)
    points.flags.writeable = False
    return points, volume


def _arranged(
    kind: str, size: tuple[float, float, float], spacing: float, seed: int, mirrored: bool
) -> tuple[np.ndarray, float]:
    if kind == "lattice":
        return lattice(size, spacing)
    if kind == "jittered":
        points, volume = lattice(size, spacing)
        rng = np.random.default_rng(seed)
        counts = rows_of(size, spacing)
        moved = (np.asarray(size) / counts * rng.uniform(-0.5, 0.5, points.shape)).reshape(*counts, 3)
        if mirrored:
            # The far half of the rows moves as the near one does, mirrored; a row in the middle stays in the plane.
            image = moved[:, ::-1] * [1.0, -1.0, 1.0]
            far = np.arange(counts[1]) >= (counts[1] + 1) // 2
            moved[:, far] = image[:, far]
            if counts[1] % 2:
                moved[:, counts[1] // 2, :, 1] = 0.0
        points = points + moved.reshape(-1, 3)
        return points, volume
    if kind == "poisson":
        # Sampled on a larger box and trimmed: points crowd at the edge of the box they were sampled in.
        radius = POISSON_RADIUS * spacing
        margin = 2.0 * radius
        if mirrored:
            # Points that would be too close to their own image go onto the plane.
            lx, ly, lz = size
            points = poisson_disk(
                (lx + 2.0 * margin, 0.5 * ly + margin, lz + 2.0 * margin), radius, seed, snap=0.5 * radius
            )
            points += [-margin, 0.5 * ly, margin]
            off_plane = points[points[:, 1] > 0.5 * ly]
            points = np.concatenate([points, off_plane * [1.0, -1.0, 1.0] + [0.0, ly, 0.0]])
            points = points[_reading_order(points, radius)]
            inside = (points >= [0.0, 0.0, -lz]) & (points <= [lx, ly, 0.0])
            return points[inside.all(axis=1)], spacing**3
        points = poisson_disk(tuple(s + 2.0 * margin for s in size), radius, seed)
        points += [-margin, -margin, margin]
        inside = (points >= [0.0, 0.0, -size[2]]) & (points <= [size[0], size[1], 0.0])
        return points[inside.all(axis=1)], spacing**3
    raise SceneError(f"bed.arrangement is {kind!r}; allowed: {', '.join(ARRANGEMENTS)}")


def rows_of(size: tuple[float, float, float], spacing: float) -> np.ndarray:
    """Particles of a lattice along each side, shape (3,)."""
    return np.maximum(1, np.round(np.asarray(size) / spacing)).astype(int)


def particle_volume(kind: str, size: tuple[float, float, float], spacing: float) -> float:
    """The volume that `arrange` gives with the particles [m^3], without making these."""
    if kind == "poisson":
        return spacing**3
    return float(np.prod(np.asarray(size) / rows_of(size, spacing)))


def lattice(size: tuple[float, float, float], spacing: float) -> tuple[np.ndarray, float]:
    """A regular lattice that fills the bed exactly; the spacing is adjusted to fit each side."""
    counts = rows_of(size, spacing)
    step = np.asarray(size) / counts
    axes = [(np.arange(c) + 0.5) * s for c, s in zip(counts, step, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    grid[:, 2] -= size[2]
    return grid, float(np.prod(step))


def poisson_disk(
    size: tuple[float, float, float], radius: float, seed: int, candidates: int = 30, snap: float = 0.0
) -> np.ndarray:
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
        direction = rng.normal(size=(candidates, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        distance = radius * (1.0 + 7.0 * rng.random((candidates, 1))) ** (1.0 / 3.0)
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
