"""Paths of a tool drawn by chance, to simulate and to train on."""

from __future__ import annotations

import csv
import math
import os
from pathlib import Path

import numpy as np
from scipy.interpolate import PchipInterpolator

from mpm_warp import Bed
from mpm_warp.bodies import Tool
from mpm_warp.poses import rotation_matrices
from sgns.config import UserError

_ROWS_PER_SECOND = 30
_PLACES = 5
"""Of a path, between which it is smooth; the tool is above the soil at the first and the last."""


def random_paths(
    count: int,
    tool: Tool,
    bed: Bed,
    *,
    duration: float = 2.0,
    depth: float = 0.06,
    tilt: float = 15.0,
    seed: int = 0,
    folder: str | os.PathLike[str] | None = None,
) -> list[np.ndarray]:
    """Smooth paths through the bed along +x: into the soil, through it and out again.

    The tool begins and ends at rest and above the soil. It stays three grid spacings away from walls and floor.
    Path number i is the same whatever the count.

        random_paths(60, MeshBody(file="bucket.stl", scale=0.001), Bed(spacing=0.02), folder="paths")

    Args:
        count: how many.
        tool: that is to follow them.
        bed: that it moves through.
        duration: of each path [s].
        depth: greatest depth of the tool's lowest point [m]; every path draws its own, from a quarter of it on.
        tilt: largest angle about y [degrees].
        seed: of the draws.
        folder: where to write them as path_000.csv and so on, for `scene.path`; None: nowhere.

    Returns:
        Paths with rows t [s], x, y, z [m], qx, qy, qz, qw, each of shape (T, 8).

    Raises:
        UserError: the tool has no room to move, or a number is out of range.
    """
    for name, value, good, allowed in (
        ("count", count, 1 <= count <= 100_000, "1 to 100000"),
        ("duration", duration, 0.1 <= duration <= 1000.0, "0.1 to 1000 s"),
        ("tilt", tilt, 0.0 <= tilt <= 60.0, "0 to 60 degrees"),
    ):
        if not good:
            raise UserError(f"{name} is {value}; allowed: {allowed}")
    lx, ly, lz = bed.size
    away, outline = 3.0 * bed.spacing, tool.outline()
    if not 0.0 < depth <= lz - away:
        raise UserError(
            f"depth is {depth} m; allowed: above 0 up to {lz - away:g} m, three grid spacings above the floor"
        )
    reach = np.hypot(outline[:, 0], outline[:, 2]).max()
    low = np.array([away + reach, away - outline[:, 1].min()])
    high = np.array([lx - away - reach, ly - away - outline[:, 1].max()])
    if not (low[0] < high[0] and low[1] <= high[1]):
        raise UserError(
            f"the tool has no room in a bin of {lx:g} x {ly:g} m with three grid spacings to every wall; use a larger "
            "bed.size or check the unit of the tool"
        )
    times = np.linspace(0.0, duration, max(2, round(duration * _ROWS_PER_SECOND)) + 1)
    paths = []
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        places = _places(rng, low, high, bed.spacing, depth, math.radians(tilt))
        x, y, lowest, angle = PchipInterpolator(np.linspace(0.0, 1.0, _PLACES), places, axis=0)(
            _eased(times / duration)
        ).T
        zero = np.zeros_like(angle)
        turned = np.stack([zero, np.sin(0.5 * angle), zero, np.cos(0.5 * angle)], axis=-1)
        z = lowest - np.array([(outline @ matrix[2]).min() for matrix in rotation_matrices(turned)])
        paths.append(np.column_stack([times, x, y, z, turned]))
    if folder is not None:
        _write(paths, Path(folder))
    return paths


def _places(
    rng: np.random.Generator, low: np.ndarray, high: np.ndarray, spacing: float, depth: float, tilt: float
) -> np.ndarray:
    """Where a path passes: x, y, height of the tool's lowest point [m] and angle about y, shape (_PLACES, 4)."""
    begin, end = low[0], high[0]
    share = np.cumsum(rng.uniform(0.5, 1.5, _PLACES - 1))
    travel = rng.uniform(0.5, 1.0) * (end - begin)
    x = begin + rng.uniform(0.0, end - begin - travel) + travel * np.concatenate([[0.0], share / share[-1]])
    across = 0.25 * (high[1] - low[1])
    y = np.clip(0.5 * (low[1] + high[1]) + rng.uniform(-across, across), low[1], high[1])
    y = np.clip(y + rng.uniform(-0.2, 0.2, _PLACES) * across, low[1], high[1])
    deepest = depth * rng.uniform(0.25, 1.0)
    inside = -deepest * rng.uniform(0.5, 1.0, _PLACES - 2)
    inside[rng.integers(_PLACES - 2)] = -deepest
    lowest = np.concatenate([[spacing], inside, [spacing]])
    return np.stack([x, y, lowest, rng.uniform(-tilt, tilt, _PLACES)], axis=-1)


def _eased(share: np.ndarray) -> np.ndarray:
    """From 0 to 1 with speed 0 at both ends, for a tenth of the time; constant speed between."""
    ease = 0.1
    rest = 1.0 - ease
    s = np.minimum(share, 1.0 - share)
    way = np.where(s < ease, s**2 / (2.0 * ease), s - 0.5 * ease) / rest
    return np.where(share <= 0.5, way, 1.0 - way)


def _write(paths: list[np.ndarray], folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for number, path in enumerate(paths):
            with open(folder / f"path_{number:03d}.csv", "w", newline="", encoding="utf-8") as file:
                rows = csv.writer(file, lineterminator="\n")
                rows.writerow("t x y z qx qy qz qw".split())
                rows.writerows([f"{value:.9g}" for value in row] for row in path)
    except OSError as error:
        raise UserError(f"cannot write {error.filename or folder}: {error.strerror}") from None
