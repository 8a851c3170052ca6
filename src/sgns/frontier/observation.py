"""What is kept of a run for comparison, and how far observed runs are from reference runs."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from functools import reduce
from operator import add
from pathlib import Path

import numpy as np
from scipy.sparse import csr_array

from mpm_warp import Scene
from sgns.config import UserError
from sgns.data.files import read_arrays, write_arrays
from sgns.data.surface import SurfaceGrid, height_map
from sgns.evaluate.metrics import VectorErrors, height_error, rms_mm
from sgns.numbers import require_shapes

# --- What is kept of a run ------------------------------------------------------------------------------
# Forces, torques and poses are kept in every frame. The soil is kept a few times a second, in two forms that do
# not depend on which particles stand for it:
#
# - its displacement around the points of a lattice: the mean displacement of the particles that started there, each
#   weighted with its nearness (1 at the point, 0 one lattice spacing away along any axis);
# - its surface: the highest particle, half a particle spacing added, in vertical columns.
#
# Letters: T frames, n particles, K observed frames, P lattice points.

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

Seen = tuple[float, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""A frame: time [s], force [N] and torque [N m] by the soil on the body, its pose, the particles (n, 3) [m]."""


@dataclass(frozen=True)
class Observation:
    """One run, whoever made it."""

    time: np.ndarray  # of the frames [s], shape (T,)
    force: np.ndarray  # by the soil on the body [N], shape (T, 3); frame 0 is at rest
    torque: np.ndarray  # about its centre of mass [N m], shape (T, 3)
    pose: np.ndarray  # of the body, shape (T, 7)
    soil_time: np.ndarray  # when the soil was observed [s], shape (K,)
    # displacement of the soil around the lattice points since the start [m], shape (K, P, 3), float32
    moved: np.ndarray
    surface: np.ndarray  # height of the columns [m], shape (K, nx, ny); NaN where a column is empty

    def save(self, file: Path) -> None:
        """Write it, complete or not at all."""
        write_arrays(file, {f.name: getattr(self, f.name) for f in fields(self)})

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


def observe(scene: Scene, frames: Iterable[Seen]) -> Observation:
    """The observation of a run of a scene: of all its frames, one after the other.

    Displacements are from the undisturbed bed, not from frame 0 of the run: what a reduction leaves out of the bed at
    rest would be left out of every error.
    """
    start = np.asarray(scene.initial_positions(), dtype=np.float64)
    weights = lattice_weights(start, np.asarray(scene.bed.size))
    x, y = (np.linspace(0.0, edge, max(1, round(edge / COLUMN)) + 1) for edge in scene.bed.size[:2])
    # Half the edge of the cube that belongs to one particle, whatever share of them is here.
    above = 0.5 * (scene.soil_volume / len(start)) ** (1.0 / 3.0)
    wanted = set(observed_frames(scene.frame_count, scene.frame_rate).tolist())
    series, soil = [], []
    for index, (time, force, torque, pose, position) in enumerate(frames):
        series.append((time, force, torque, pose))
        if index in wanted:
            position = np.asarray(position, dtype=np.float64)
            with np.errstate(invalid="ignore"):  # no particle is near: NaN
                moved = weights @ (position - start) / weights.sum(axis=1)[:, None]
            surface = height_map(position, SurfaceGrid(x, y)) + above
            soil.append((time, moved.astype(np.float32), surface))
    columns = [np.array(values, dtype=np.float64) for values in zip(*series, strict=True)]
    return Observation(*columns, *map(np.array, zip(*soil, strict=True)))


def lattice_weights(start: np.ndarray, size: np.ndarray) -> csr_array:
    """Weight of each particle (n, 3) [m] at each point of a regular lattice in a bin of a size [m], shape (P, n)."""
    counts = np.maximum(1, np.round(size / LATTICE)).astype(int)
    place = (start + np.array([0.0, 0.0, size[2]])) / (size / counts) - 0.5
    points, weights = [], []
    for corner in itertools.product((0, 1), repeat=3):
        node = np.floor(place).astype(int) + corner
        weight = np.prod(np.maximum(0.0, 1.0 - np.abs(place - node)), axis=1)
        weight[((node < 0) | (node >= counts)).any(axis=1)] = 0.0
        points.append(np.ravel_multi_index(tuple(np.clip(node, 0, counts - 1).T), tuple(counts)))
        weights.append(weight)
    entries = np.concatenate(weights), (np.concatenate(points), np.tile(np.arange(len(start)), 8))
    return csr_array(entries, shape=(int(np.prod(counts)), len(start)))


# --- How far observed runs are from reference runs of the same scenes, on whatever particles --------------
# Definitions are those of docs/conventions.md where it has them. Frame 0, at rest, does not count. Forces,
# torques and poses of a run with another frame rate are interpolated in time at the reference's frames, its
# soil at the times at which the reference's soil was observed.


@dataclass(frozen=True)
class Comparison:
    """One run beside its reference."""

    force: tuple[VectorErrors, ...]  # by quarter of the run [N]
    torque: VectorErrors  # of the whole run [N m]
    # mean-square difference of displacement at every observed time but the first [m²], shape (K - 1,)
    position: np.ndarray
    surface: float  # mean-square difference of the last surface [m²]
    sinkage: float  # mean absolute difference of the body's height [m]


def pooled(errors: Iterable[VectorErrors]) -> VectorErrors:
    """Errors of several runs, or parts of one, together."""
    return reduce(add, errors)


def compare(run: Observation, reference: Observation) -> Comparison:
    """How far a run is from the reference run of its scene.

    Raises:
        UserError: the two are not of one scene, or one is longer than the other.
    """
    if any(getattr(run, k).shape[1:] != getattr(reference, k).shape[1:] for k in ("moved", "surface")):
        raise UserError("two runs in bins of different sizes cannot be compared")
    if run.time[-1] < reference.time[-1] - 1.5 / 60.0:
        raise UserError(
            f"a run that ends at {run.time[-1]:.3f} s cannot be compared with one that ends at "
            f"{reference.time[-1]:.3f} s"
        )
    force, torque, pose = (
        resampled(run.time, values, reference.time) for values in (run.force, run.torque, run.pose)
    )
    quarters = np.array_split(np.arange(1, len(reference.time)), 4)
    # Points that hold soil in only one of the two beds do not count.
    both = ~np.isnan(reference.moved[0]) & ~np.isnan(run.moved[0])
    moved = resampled(run.soil_time, run.moved[:, both].astype(np.float64), reference.soil_time)
    return Comparison(
        force=tuple(VectorErrors.compare(reference.force[part], force[part]) for part in quarters),
        torque=VectorErrors.compare(reference.torque[1:], torque[1:]),
        position=((moved[1:] - reference.moved[1:, both]) ** 2).mean(axis=1),
        surface=height_error(run.surface[-1], reference.surface[-1]),
        sinkage=float(np.abs(pose[1:, 2] - reference.pose[1:, 2]).mean()),
    )


def resampled(time: np.ndarray, values: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Values (T, ...) at other times, interpolated linearly; the first and last hold beyond the ends."""
    place = np.interp(wanted, time, np.arange(len(time)))
    before = place.astype(int)
    after = np.minimum(before + 1, len(time) - 1)
    share = (place - before).reshape(-1, *[1] * (values.ndim - 1))
    return values[before] + share * (values[after] - values[before])


def errors(comparisons: Sequence[Comparison], *, free_body: bool = False) -> dict[str, float]:
    """Errors of a point over its cases, by the names of the columns of `Point`; sinkage only where the body is free.

    Squares are summed over the cases before the root is taken; low and high are those of the best and the worst case.
    """
    forces = [pooled(c.force) for c in comparisons]
    force, torque = pooled(forces), pooled(c.torque for c in comparisons)
    by_case = [one.overall_nrmse for one in forces]
    found = {
        "force_nrmse": force.overall_nrmse,
        "force_nrmse_low": min(by_case),
        "force_nrmse_high": max(by_case),
        "draft_nrmse": float(force.nrmse[0]),
        "draft_mean_error": float(force.mpe[0]) / 100.0,
        "vertical_nrmse": float(force.nrmse[2]),
        "vertical_mean_error": float(force.mpe[2]) / 100.0,
        "torque_nrmse": torque.overall_nrmse,
        "sinkage_error_mm": 1e3 * float(np.mean([c.sinkage for c in comparisons])) if free_body else math.nan,
    }
    squares = [c.position.mean() for c in comparisons], [c.surface for c in comparisons]
    for name, values in zip(("position_rmse_mm", "surface_rmse_mm"), squares, strict=True):
        for end, pool in (("", np.mean), ("_low", min), ("_high", max)):
            found[name + end] = rms_mm(float(pool(values)))
    for q in range(1, 5):
        found[f"force_nrmse_q{q}"] = pooled(c.force[q - 1] for c in comparisons).overall_nrmse
        ends = [c.position[max(0, round(len(c.position) * q / 4) - 1)] for c in comparisons]
        found[f"position_rmse_mm_q{q}"] = rms_mm(float(np.mean(ends)))
    return found
