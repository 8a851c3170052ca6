"""How far a predicted run is from a simulated one: positions, surface, force and torque."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mpm_warp.motions import along_and_across
from mpm_warp.settings import short_repr
from sgns.config import UserError
from sgns.data.run import frame_chunks
from sgns.data.surface import SurfaceGrid, height_map
from sgns.model.features import is_wheel


def named_forces(scene: Mapping[str, Any], force: np.ndarray) -> tuple[tuple[str, str, str], np.ndarray]:
    """Forces (..., 3), world frame, as pictures show them, with their names: forward, lateral, vertical.

    Of a turned wheel along its heading and its axle, of a tool that is no wheel the draft.
    """
    if not is_wheel(scene):
        return ("draft −Fx", "lateral Fy", "vertical Fz"), force * [-1.0, 1.0, 1.0]
    if not scene.get("slip_angle"):
        return ("drawbar pull Fx", "lateral Fy", "vertical Fz"), force
    names = "drawbar pull\n(along heading)", "lateral force\n(along axle)", "vertical Fz"
    return names, along_and_across(scene, force)


def named_torques(scene: Mapping[str, Any], torque: np.ndarray) -> tuple[tuple[str, str, str], np.ndarray]:
    """Torques (..., 3), world frame, as pictures show them, with their names; as in `named_forces`."""
    if is_wheel(scene) and scene.get("slip_angle"):
        names = "torque about\nheading", "drive torque\n(about axle)", "yaw Tz"
        return names, along_and_across(scene, torque)
    return ("roll Tx", "pitch Ty", "yaw Tz"), torque


# Both runs are files of the same kind and are read in chunks of frames, so memory does not grow with the length
# of a run. The frames of the history, which the prediction was given, count in no metric.

# Reported names of the world axes x, y, z. Draft is −F_x; every relative metric is the same for −F_x and F_x.
FORCE_COMPONENTS = {"draft": 0, "lateral": 1, "vertical": 2}
TORQUE_COMPONENTS = {"roll": 0, "pitch": 1, "yaw": 2}
# A component this small beside the whole vector (RMS) is zero by symmetry, up to noise of the truth:
# dividing by it says nothing, so relative metrics are left out (NaN).
NEGLIGIBLE_SHARE = 0.05


@dataclass(frozen=True)
class ParticleErrors:
    """Mean-square position errors of one run's particles, over axes and the frames after the history."""

    # PCA⁻¹ is the decoding, a closure included
    reduction: np.ndarray  # PCA⁻¹PCA(truth) − truth [m²], shape (n,)
    network: np.ndarray  # prediction − PCA⁻¹PCA(truth) [m²], shape (n,)


@dataclass(frozen=True)
class PositionErrors:
    """Mean-square position errors of one run at every frame after the history."""

    __repr__ = short_repr

    time: np.ndarray  # time of the frames [s], shape (t,)
    reduction: np.ndarray  # PCA⁻¹PCA(truth) − truth [m²], shape (t,)
    network: np.ndarray  # prediction − PCA⁻¹PCA(truth) [m²], shape (t,); the paper's figure
    total: np.ndarray  # prediction − truth [m²], shape (t,)
    frozen: np.ndarray  # last frame of the history, kept − truth [m²], shape (t,)
    constant_velocity: np.ndarray  # last step of the history, continued − truth [m²], shape (t,)
    surface: np.ndarray  # height map of the prediction − of the truth [m²], shape (t,)
    surface_frozen: np.ndarray  # height map of the last frame of the history − of the truth [m²], shape (t,)
    # the same run, by particle instead of by frame; None if only frames were asked for
    particles: ParticleErrors | None = None

    def mse(self, name: str) -> float:
        """Mean over frames of one of the errors [m²]."""
        return float(np.mean(getattr(self, name)))


@dataclass(frozen=True)
class BodyErrors:
    """How far a predicted body is from its true place, over the frames after the history."""

    mse: float  # mean-square distance of the centres of mass [m²]
    sinkage_mae: float  # mean absolute error of a wheel's sinkage [m]; NaN for other bodies


PRESCRIBED = BodyErrors(0.0, math.nan)
"""Of a body whose path was given."""


@dataclass(frozen=True)
class VectorErrors:
    """Sums from which every metric of a predicted force or torque follows; sums of runs add up."""

    __repr__ = short_repr

    samples: int  # number of frames
    absolute: np.ndarray  # Σ |prediction − truth| per world axis, shape (3,)
    squared: np.ndarray  # Σ (prediction − truth)², shape (3,)
    truth_squared: np.ndarray  # Σ truth², shape (3,)
    truth_sum: np.ndarray  # Σ truth, shape (3,)
    prediction_sum: np.ndarray  # Σ prediction, shape (3,)
    mpe_sizes: np.ndarray | float = 0.0  # Σ |MPE| over the runs for which it has a meaning [%], shape (3,)
    mpe_runs: np.ndarray | int = 0  # number of those runs, shape (3,)

    @classmethod
    def compare(cls, truth: np.ndarray, prediction: np.ndarray) -> VectorErrors:
        """Errors of predicted vectors [N or N m], shape (t, 3), or (3,) for a constant, beside true ones, (t, 3)."""
        truth = np.asarray(truth, dtype=np.float64)
        prediction = np.broadcast_to(np.asarray(prediction, dtype=np.float64), truth.shape)
        difference = prediction - truth
        errors = cls(
            samples=len(truth),
            absolute=np.abs(difference).sum(axis=0),
            squared=(difference**2).sum(axis=0),
            truth_squared=(truth**2).sum(axis=0),
            truth_sum=truth.sum(axis=0),
            prediction_sum=prediction.sum(axis=0),
        )
        size = np.abs(errors.mpe)
        unknown = np.isnan(size)
        return replace(errors, mpe_sizes=np.where(unknown, 0.0, size), mpe_runs=np.where(unknown, 0, 1))

    def __add__(self, other: VectorErrors) -> VectorErrors:
        return VectorErrors(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))

    @property
    def mae(self) -> np.ndarray:
        """Mean absolute error per axis [N or N m], shape (3,)."""
        return self.absolute / self.samples

    @property
    def nrmse(self) -> np.ndarray:
        """RMS error / RMS of the truth per axis, shape (3,); NaN where the truth is negligible."""
        significant = self.truth_squared > NEGLIGIBLE_SHARE**2 * self.truth_squared.sum()
        return np.sqrt(_ratio(self.squared, self.truth_squared, significant))

    @property
    def overall_nrmse(self) -> float:
        """RMS length of the error vector / RMS length of the true vector; NaN for a truth of zeros."""
        scale = float(self.truth_squared.sum())
        return math.sqrt(float(self.squared.sum()) / scale) if scale > 0.0 else math.nan

    @property
    def mpe(self) -> np.ndarray:
        """100 (mean prediction − mean truth) / mean truth per axis [%], shape (3,), signed.

        NaN where the mean of the truth is negligible beside the RMS length of the vector.
        """
        rms_length = math.sqrt(self.truth_squared.sum() / self.samples)
        significant = np.abs(self.truth_sum) / self.samples > NEGLIGIBLE_SHARE * rms_length
        return 100.0 * _ratio(self.prediction_sum - self.truth_sum, self.truth_sum, significant)

    @property
    def absolute_mpe(self) -> np.ndarray:
        """Mean of |MPE| over the runs per axis [%], shape (3,): errors of different runs do not cancel."""
        return _ratio(self.mpe_sizes, self.mpe_runs, np.greater(self.mpe_runs, 0))


def _ratio(a: ArrayLike, b: ArrayLike, where: np.ndarray) -> np.ndarray:
    return np.divide(a, b, out=np.full(3, np.nan), where=where)


def rms_mm(mse: float) -> float:
    """Root of a mean-square error [m²] in mm; NaN of NaN."""
    return 1e3 * math.sqrt(mse) if mse >= 0.0 else math.nan


def skill(mse: Sequence[float], baseline: Sequence[float]) -> float:
    """1 − Σ MSE / Σ MSE of the baseline over runs: 1 is perfect, 0 no better, negative is worse.

    NaN if the baseline makes no error at all.
    """
    reference = float(np.sum(baseline))
    return 1.0 - float(np.sum(mse)) / reference if reference > 0.0 else math.nan


def mean_prediction(histories: Iterable[np.ndarray], history: int) -> np.ndarray:
    """Mean force (or torque) of the training split, the simplest prediction of one, shape (3,).

    Over all frames of all runs, (T, 3) each, but the first `history` of every run, as in every metric.
    """
    total, count = np.zeros(3), 0
    for values in histories:
        values = np.asarray(values, dtype=np.float64)[history:]
        total, count = total + values.sum(axis=0), count + len(values)
    return total / max(count, 1)


def position_errors(
    truth: Any, prediction: Any, basis: Any, history: int, grid: SurfaceGrid
) -> PositionErrors:
    """Position errors of a predicted `Run` of the same scene at every frame after the history of d frames that it was
    given.

    With orthonormal modes the network's error needs no decoding: it is ‖Uᵀ(prediction − truth)‖² / 3n, for a
    prediction that lies in the subspace of the basis. A closure moves modes at right angles to it, so this is the error
    of the modes that are stepped; only without a closure is the total the sum of both.
    """
    if truth.frame_count <= history:
        raise UserError(
            f"{truth.path} has {truth.frame_count} frames, the network needs {history} as its history; "
            "nothing is left to compare: use a longer run"
        )
    given = np.asarray(truth.positions(slice(max(history - 2, 0), history)), dtype=np.float64)
    last, step = given[-1], given[-1] - given[0]
    last_heights = height_map(last, grid)
    parts: list[dict[str, Any]] = []  # PositionErrors of some frames each
    by_particle = {name: np.zeros(truth.particle_count) for name in ("reduction", "network")}
    for frames in frame_chunks(truth.particle_count, truth.frame_count, history):
        true = np.asarray(truth.positions(frames), dtype=np.float64)
        predicted = np.asarray(prediction.positions(frames), dtype=np.float64)
        latent = basis.transform(true)
        difference = basis.transform(predicted) - latent
        since = np.arange(frames.start, frames.stop) - (history - 1)
        projected = basis.inverse(latent).numpy()
        by_particle["reduction"] += np.einsum("tna,tna->n", projected - true, projected - true)
        by_particle["network"] += np.einsum("tna,tna->n", predicted - projected, predicted - projected)
        heights, guesses = ([height_map(frame, grid) for frame in run] for run in (true, predicted))
        parts.append(
            {
                "reduction": mean_square(projected - true),
                "network": difference.square().sum(dim=(-2, -1)).numpy() / (3 * truth.particle_count),
                "total": mean_square(predicted - true),
                "frozen": mean_square(last - true),
                "constant_velocity": mean_square(last + since[:, None, None] * step - true),
                "surface": [height_error(a, b) for a, b in zip(guesses, heights, strict=True)],
                "surface_frozen": [height_error(last_heights, b) for b in heights],
            }
        )
    values = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    entries = 3 * (truth.frame_count - history)
    particles = ParticleErrors(**{name: total / entries for name, total in by_particle.items()})
    return PositionErrors(time=np.asarray(truth.time)[history:], **values, particles=particles)


def body_errors(truth: Any, predicted: np.ndarray, history: int) -> BodyErrors:
    """Errors of predicted poses (T, 7) of a run's body, over the frames after the history."""
    misplaced = predicted[history:, :3] - truth.pose[history:, :3]
    return BodyErrors(
        mse=float(np.mean((misplaced**2).sum(axis=1))),
        sinkage_mae=float(np.mean(np.abs(misplaced[:, 2]))) if is_wheel(truth.scene) else math.nan,
    )


def mean_square(difference: np.ndarray) -> np.ndarray:
    """Mean over particles and axes of squared differences (t, n, 3) [m], shape (t,) [m²]."""
    return np.mean(difference**2, axis=(1, 2))


def height_error(a: np.ndarray, b: np.ndarray) -> float:
    """Mean-square difference [m²] of two height maps (nx, ny) [m] over the columns that both fill."""
    both = np.isfinite(a) & np.isfinite(b)
    return float(np.mean((a[both] - b[both]) ** 2)) if both.any() else math.nan
