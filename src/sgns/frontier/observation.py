"""What is kept of a run so that it can be compared with runs of the same scene on other beds of particles.

Forces, torques and poses are kept in every frame. The soil is kept a few times a second, in two forms that do not
depend on which particles stand for it:

- its displacement around the points of a lattice: the mean displacement of the particles that started there, each
  weighted with its nearness (1 at the point, 0 one lattice spacing away along any axis);
- its surface: the highest particle, half a particle spacing added, in vertical columns.

Letters: T frames, n particles, K observed frames, P lattice points.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from mpm_warp import Scene
from sgns.errors import UserError
from sgns.evaluation.surface import SurfaceGrid, height_map
from sgns.shapes import require_shapes
from sgns.smallfile import read_arrays
from sgns.wholefile import whole_file

__all__ = ["Observation", "Observer", "observe_arrays", "observed_frames", "read_observation"]

LATTICE = 0.02  # of displacements, coarse enough for the coarsest beds of a study [m]
COLUMN = 0.03  # edge of a column of the surface [m]
TIMES_PER_SECOND = 5  # that the soil is observed
_SHAPES: dict[str, tuple[int | str, ...]] = {
    "time": ("T",),
    "force": ("T", 3),
    "torque": ("T", 3),
    "pose": ("T", 7),
    "soil_time": ("K",),
    "moved": ("K", "P", 3),
    "surface": ("K", "nx", "ny"),
}


@dataclass(frozen=True)
class Observation:
    """One run, whoever made it.

    Attributes:
        time: of the frames [s], shape (T,).
        force: by the soil on the body [N], shape (T, 3); frame 0 is at rest.
        torque: about its centre of mass [N m], shape (T, 3).
        pose: of the body, shape (T, 7).
        soil_time: when the soil was observed [s], shape (K,).
        moved: displacement of the soil around the lattice points since the start [m], shape (K, P, 3), float32.
        surface: height of the columns [m], shape (K, nx, ny); NaN where a column is empty.
    """

    time: np.ndarray
    force: np.ndarray
    torque: np.ndarray
    pose: np.ndarray
    soil_time: np.ndarray
    moved: np.ndarray
    surface: np.ndarray

    def save(self, file: Path) -> None:
        """Write it, complete or not at all."""
        file.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(file) as temporary, temporary.open("wb") as stream:
            np.savez_compressed(stream, **{f.name: getattr(self, f.name) for f in fields(self)})

    @property
    def finite(self) -> bool:
        """Whether force and soil, where there is some, stayed finite all the time."""
        soil = self.moved[:, ~np.isnan(self.moved[0])]
        return bool(soil.size and np.isfinite(self.force).all() and np.isfinite(soil).all())


def read_observation(file: Path) -> Observation:
    """What `Observation.save` wrote.

    Raises:
        UserError: it is missing or damaged.
    """
    advice = "remove it and its point to make it again"
    content = read_arrays(file, "not an observed run", advice)
    try:
        require_shapes(content, _SHAPES)
        for name in ("time", "soil_time"):
            if not (np.isfinite(content[name]).all() and (np.diff(content[name]) > 0).all()):
                raise ValueError(f"{name} does not increase")
    except ValueError as error:
        raise UserError(f"{file} is not an observed run ({error}); {advice}") from error
    return Observation(**{name: content[name] for name in _SHAPES})


def observed_frames(frame_count: int, frame_rate: float) -> np.ndarray:
    """Frames in which the soil is looked at: the first, then `TIMES_PER_SECOND` times a second, and the last."""
    every = max(1, round(frame_rate / TIMES_PER_SECOND))
    return np.union1d(np.arange(0, frame_count, every), frame_count - 1)


class Observer:
    """Collects an observation frame by frame.

    Args:
        scene: what is simulated; says where the bin is.
        start: positions of the particles at time 0 [m], shape (n, 3).
    """

    def __init__(self, scene: Scene, start: np.ndarray) -> None:
        self._start = np.asarray(start, dtype=np.float64)
        size = np.asarray(scene.bed.size)
        self._points = _NearPoints(self._start, size)
        x, y = (np.linspace(0.0, edge, max(1, round(edge / COLUMN)) + 1) for edge in size[:2])
        self._columns = SurfaceGrid(x, y)
        # Half the edge of the cube that belongs to one particle, whatever share of them is here.
        self._above = 0.5 * (scene.soil_volume / len(self._start)) ** (1.0 / 3.0)
        self._frames: dict[str, list[Any]] = {f.name: [] for f in fields(Observation)}

    def add(self, time: float, force: np.ndarray, torque: np.ndarray, pose: np.ndarray) -> None:
        """A frame: its time [s], force [N], torque [N m] and the pose of the body."""
        for key, value in (("time", time), ("force", force), ("torque", torque), ("pose", pose)):
            self._frames[key].append(np.array(value, dtype=np.float64))

    def add_soil(self, time: float, position: np.ndarray) -> None:
        """The particles in a frame in which the soil is to be observed [m], shape (n, 3)."""
        position = np.asarray(position, dtype=np.float64)
        self._frames["soil_time"].append(time)
        self._frames["moved"].append(self._points.mean(position - self._start).astype(np.float32))
        self._frames["surface"].append(height_map(position, self._columns) + self._above)

    def finish(self) -> Observation:
        """All that was seen."""
        return Observation(**{key: np.array(values) for key, values in self._frames.items()})


class _NearPoints:
    """Means over the particles near the points of a regular lattice in the bin."""

    def __init__(self, start: np.ndarray, size: np.ndarray) -> None:
        counts = np.maximum(1, np.round(size / LATTICE)).astype(int)
        spacing = size / counts
        place = (start + np.array([0.0, 0.0, size[2]])) / spacing - 0.5
        low = np.floor(place).astype(int)
        index, weight = [], []
        for corner in itertools.product((0, 1), repeat=3):
            node = low + corner
            share = np.prod(np.maximum(0.0, 1.0 - np.abs(place - node)), axis=1)
            share[((node < 0) | (node >= counts)).any(axis=1)] = 0.0
            index.append(np.ravel_multi_index(tuple(np.clip(node, 0, counts - 1).T), tuple(counts)))
            weight.append(share)
        self._index, self._weight = np.concatenate(index), np.concatenate(weight)
        self._count = int(np.prod(counts))
        self._total = np.bincount(self._index, self._weight, self._count)

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Of a vector of each particle (n, 3), shape (P, 3); NaN where no particle is near."""
        sums = [
            np.bincount(self._index, self._weight * np.tile(values[:, axis], 8), self._count)
            for axis in range(3)
        ]
        with np.errstate(invalid="ignore"):
            return np.stack(sums, axis=1) / self._total[:, None]


def observe_arrays(
    scene: Scene,
    start: np.ndarray,
    time: np.ndarray,
    force: np.ndarray,
    torque: np.ndarray,
    pose: np.ndarray,
    frames: np.ndarray,
    positions: Iterable[np.ndarray],
) -> Observation:
    """The observation of a run that is in memory.

    Args:
        scene: what was simulated.
        start: where the particles are in an undisturbed bed [m], shape (n, 3). Not a frame of the run: what a reduction
            leaves out of the bed at rest would be left out of every error.
        time: of all frames [s], shape (T,).
        force: [N], shape (T, 3).
        torque: [N m], shape (T, 3).
        pose: of the body, shape (T, 7).
        frames: numbers of the frames in which the soil is known, `observed_frames`, the first of them 0.
        positions: particles in each of these frames [m], (n, 3) each.
    """
    observer = Observer(scene, start)
    for frame, position in zip(frames, positions, strict=True):
        observer.add_soil(float(time[frame]), position)
    for values in zip(time, force, torque, pose, strict=True):
        observer.add(*values)
    return observer.finish()
