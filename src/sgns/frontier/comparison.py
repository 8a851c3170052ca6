"""How far observed runs are from reference runs of the same scenes, on whatever particles either was made.

Definitions are those of docs/conventions.md where it has them. Frame 0, at rest, does not count. Forces, torques and
poses of a run with another frame rate are interpolated in time at the reference's frames, its soil at the times
at which the reference's soil was observed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sgns.errors import UserError
from sgns.evaluation.metrics import VectorErrors
from sgns.frontier.observation import Observation

__all__ = ["QUARTERS", "compare", "errors"]

QUARTERS = (1, 2, 3, 4)


@dataclass(frozen=True)
class Comparison:
    """One run beside its reference.

    Attributes:
        force: by quarter of the run, four `VectorErrors` [N].
        torque: of the whole run [N m].
        position: mean-square difference of displacement at every observed time but the first [m²], shape (K - 1,).
        surface: mean-square difference of the last surface [m²].
        sinkage: mean absolute difference of the body's height [m].
    """

    force: tuple[VectorErrors, ...]
    torque: VectorErrors
    position: np.ndarray
    surface: float
    sinkage: float

    @property
    def whole_force(self) -> VectorErrors:
        """Of all quarters."""
        return sum(self.force[1:], start=self.force[0])

    def position_at(self, quarter: int) -> float:
        """Mean-square difference of displacement at the end of a quarter of the run, 1 to 4 [m²]."""
        return float(self.position[max(0, round(len(self.position) * quarter / 4) - 1)])


def compare(run: Observation, reference: Observation) -> Comparison:
    """How far a run is from the reference run of its scene.

    Raises:
        UserError: the two are not of one scene, or one is longer than the other.
    """
    if (
        run.moved.shape[1:] != reference.moved.shape[1:]
        or run.surface.shape[1:] != reference.surface.shape[1:]
    ):
        raise UserError("two runs in bins of different sizes cannot be compared")
    if run.time[-1] < reference.time[-1] - 1.5 / 60.0:
        raise UserError(
            f"a run that ends at {run.time[-1]:.3f} s cannot be compared with one that ends at "
            f"{reference.time[-1]:.3f} s"
        )
    time = reference.time[1:]
    force, torque = (resampled(run.time, values, time) for values in (run.force, run.torque))
    quarters = np.array_split(np.arange(len(time)), 4)
    heights = resampled(run.time, run.pose[:, 2:3], time)[:, 0]
    return Comparison(
        force=tuple(VectorErrors.compare(reference.force[1:][part], force[part]) for part in quarters),
        torque=VectorErrors.compare(reference.torque[1:], torque),
        position=mean_squares(run, reference),
        surface=height_difference(run.surface[-1], reference.surface[-1]),
        sinkage=float(np.abs(heights - reference.pose[1:, 2]).mean()),
    )


def resampled(time: np.ndarray, values: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Values (T, k) at other times, interpolated linearly; the first and last hold beyond the ends."""
    if len(time) == len(wanted) + 1 and np.allclose(time[1:], wanted):
        return values[1:]
    return np.stack([np.interp(wanted, time, column) for column in values.T], axis=1)


def mean_squares(run: Observation, reference: Observation) -> np.ndarray:
    """Mean-square difference of displacements over lattice points and axes, shape (K - 1,) [m²].

    Points that hold soil in only one of the two beds do not count.
    """
    moved = run.moved
    if len(run.soil_time) != len(reference.soil_time) or not np.allclose(
        run.soil_time, reference.soil_time, atol=1e-6
    ):
        flat = resampled(run.soil_time, moved.reshape(len(moved), -1), reference.soil_time)
        moved = flat.reshape(len(reference.soil_time), *moved.shape[1:])
    both = ~np.isnan(reference.moved[0]) & ~np.isnan(run.moved[0])
    difference = moved[1:, both].astype(np.float64) - reference.moved[1:, both]
    return (difference**2).mean(axis=1)


def height_difference(a: np.ndarray, b: np.ndarray) -> float:
    """Mean-square difference of two height maps [m²] over the columns that both fill."""
    both = np.isfinite(a) & np.isfinite(b)
    return float(np.mean((a[both] - b[both]) ** 2)) if both.any() else math.nan


def errors(comparisons: Sequence[Comparison], *, free_body: bool = False) -> dict[str, float]:
    """Errors of a point over its cases, by the names of the columns of `Point`.

    Squares are summed over the cases before the root is taken; low and high are those of the best and the worst case.

    Args:
        comparisons: of each case.
        free_body: whether the body's height is part of the answer.
    """
    force = sum((c.whole_force for c in comparisons[1:]), start=comparisons[0].whole_force)
    torque = sum((c.torque for c in comparisons[1:]), start=comparisons[0].torque)
    quarters = [
        sum((c.force[q - 1] for c in comparisons[1:]), start=comparisons[0].force[q - 1]) for q in QUARTERS
    ]
    found = {
        "force_nrmse": force.overall_nrmse,
        "draft_nrmse": float(force.nrmse[0]),
        "draft_mean_error": float(force.mpe[0]) / 100.0,
        "vertical_nrmse": float(force.nrmse[2]),
        "vertical_mean_error": float(force.mpe[2]) / 100.0,
        "torque_nrmse": torque.overall_nrmse,
        "position_rmse_mm": _root_mm([c.position.mean() for c in comparisons]),
        "surface_rmse_mm": _root_mm([c.surface for c in comparisons]),
        "sinkage_error_mm": 1e3 * float(np.mean([c.sinkage for c in comparisons])) if free_body else math.nan,
    }
    found |= {f"force_nrmse_q{q}": quarters[q - 1].overall_nrmse for q in QUARTERS}
    found |= {f"position_rmse_mm_q{q}": _root_mm([c.position_at(q) for c in comparisons]) for q in QUARTERS}
    for name, values in (
        ("force_nrmse", [c.whole_force.overall_nrmse for c in comparisons]),
        ("position_rmse_mm", [_root_mm([c.position.mean()]) for c in comparisons]),
        ("surface_rmse_mm", [_root_mm([c.surface]) for c in comparisons]),
    ):
        found |= {f"{name}_low": min(values), f"{name}_high": max(values)}
    return found


def _root_mm(squares: Sequence[float]) -> float:
    """Root of the mean of squares [m²] in mm."""
    return 1e3 * math.sqrt(float(np.mean(squares)))
