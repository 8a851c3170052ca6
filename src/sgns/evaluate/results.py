"""What an evaluation found, in numbers: what the tables, the figures and the report are made from."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sgns.evaluate.metrics import (
    FORCE_COMPONENTS,
    PRESCRIBED,
    TORQUE_COMPONENTS,
    BodyErrors,
    PositionErrors,
    VectorErrors,
    rms_mm,
    skill,
)
from sgns.reduction.basis import Basis, ReductionCurves

if TYPE_CHECKING:
    from sgns.simulator import Simulator


# --- All metrics of one predicted run, or of several together, as one row of a table --------------------

POSITION_ERRORS = ("reduction", "network", "total", "frozen", "constant_velocity")
SURFACE_ERRORS = ("surface", "surface_frozen")


@dataclass(frozen=True)
class Scores:
    """Errors of a prediction and of the baselines."""

    name: str  # of the run, or of the group of runs
    frames: int  # number of frames that count (the history does not)
    mse: Mapping[str, float]  # mean-square errors [m²] by the names of `PositionErrors`
    force: VectorErrors  # errors of the force [N]
    torque: VectorErrors  # errors of the torque about the centre of mass [N m]
    mean_force: VectorErrors  # errors of the mean force of the training split [N]
    mean_torque: VectorErrors  # errors of the mean torque of the training split [N m]
    solver_rate: float  # wall seconds per simulated second of the solver; NaN if not recorded
    absolute_mpe: Mapping[str, float]  # mean over runs of |MPE| [%] by component of the force
    mean_force_absolute_mpe: Mapping[str, float]  # the same of the mean force of the training split [%]
    # mean-square distance of the body from its true place [m²]; 0 where its path was given
    body_mse: float = 0.0
    sinkage_mae: float = math.nan  # mean absolute error of a wheel's sinkage [m]; NaN for other bodies

    def rmse_mm(self, name: str) -> float:
        """Root of a mean-square error [mm]."""
        return rms_mm(self.mse[name])

    def skill(self, baseline: str = "frozen") -> float:
        """1 − MSE / MSE of a baseline; for several runs 1 − Σ MSE / Σ MSE of the baseline."""
        return skill([self.mse["total"]], [self.mse[baseline]])

    def row(self) -> dict[str, Any]:
        """Everything as plain numbers by column name; the unit is the end of the name."""
        row: dict[str, Any] = {"run": self.name, "frames": self.frames}
        row |= {f"mse_{name}_m2": self.mse[name] for name in POSITION_ERRORS}
        row |= {f"rmse_{name}_mm": self.rmse_mm(name) for name in POSITION_ERRORS}
        row |= {
            "skill_frozen": self.skill("frozen"),
            "skill_constant_velocity": self.skill("constant_velocity"),
        }
        row |= {f"{name}_rmse_mm": self.rmse_mm(name) for name in SURFACE_ERRORS}
        for prefix, errors in (("", self.force), ("mean_force_", self.mean_force)):
            row |= columns(errors, FORCE_COMPONENTS, prefix, "force", "N")
        row |= {f"{name}_abs_mpe_percent": value for name, value in self.absolute_mpe.items()}
        for prefix, errors in (("", self.torque), ("mean_torque_", self.mean_torque)):
            row |= columns(errors, TORQUE_COMPONENTS, prefix, "torque", "Nm")
        row |= {"body_rmse_mm": 1e3 * math.sqrt(self.body_mse), "sinkage_mae_mm": 1e3 * self.sinkage_mae}
        row["solver_wall_s_per_s"] = self.solver_rate
        return row


def columns(
    errors: VectorErrors, components: Mapping[str, int], prefix: str, vector: str, unit: str
) -> dict[str, float]:
    """MAE, NRMSE and MPE of every component and the NRMSE of the whole vector."""
    values: dict[str, float] = {}
    for name, axis in components.items():
        values[f"{prefix}{name}_mae_{unit}"] = float(errors.mae[axis])
        values[f"{prefix}{name}_nrmse"] = float(errors.nrmse[axis])
        values[f"{prefix}{name}_mpe_percent"] = float(errors.mpe[axis])
    values[f"{prefix}{vector}_nrmse" if not prefix else f"{prefix}nrmse"] = errors.overall_nrmse
    return values


def run_scores(
    name: str,
    positions: PositionErrors,
    truth: Any,
    prediction: Any,
    history: int,
    mean_force: np.ndarray,
    mean_torque: np.ndarray,
    body: BodyErrors = PRESCRIBED,
) -> Scores:
    """Scores of one run over the frames after its history.

    The mean force [N] and torque [N m] of the training split are baselines, shape (3,) each.
    """
    force = VectorErrors.compare(truth.force[history:], prediction.force[history:])
    mean = VectorErrors.compare(truth.force[history:], mean_force)
    simulated = float(truth.time[-1] - truth.time[0])
    wall = truth.wall_time_s
    return Scores(
        name=name,
        frames=len(positions.time),
        mse={key: positions.mse(key) for key in POSITION_ERRORS + SURFACE_ERRORS},
        force=force,
        torque=VectorErrors.compare(truth.torque[history:], prediction.torque[history:]),
        mean_force=mean,
        mean_torque=VectorErrors.compare(truth.torque[history:], mean_torque),
        solver_rate=float(wall) / simulated if wall else math.nan,
        absolute_mpe=absolute_mpe(force),
        mean_force_absolute_mpe=absolute_mpe(mean),
        body_mse=body.mse,
        sinkage_mae=body.sinkage_mae,
    )


def absolute_mpe(force: VectorErrors) -> dict[str, float]:
    """|MPE| [%] by component of the force."""
    return {key: abs(float(force.mpe[axis])) for key, axis in FORCE_COMPONENTS.items()}


def aggregate(runs: Sequence[Scores], name: str = "all runs") -> Scores:
    """Scores of several runs together.

    Position errors are means over runs, so that skill is 1 − Σ MSE / Σ MSE of the baseline; forces are pooled
    over all frames; |MPE|, sinkage and the solver's time are means over the runs that have them.
    """
    first = runs[0]

    def pooled(field: str) -> VectorErrors:
        return sum((getattr(run, field) for run in runs[1:]), start=getattr(first, field))

    return Scores(
        name=name,
        frames=sum(run.frames for run in runs),
        mse={key: float(np.mean([run.mse[key] for run in runs])) for key in first.mse},
        force=pooled("force"),
        torque=pooled("torque"),
        mean_force=pooled("mean_force"),
        mean_torque=pooled("mean_torque"),
        solver_rate=mean_of_known([run.solver_rate for run in runs]),
        absolute_mpe=means_of_known([run.absolute_mpe for run in runs]),
        mean_force_absolute_mpe=means_of_known([run.mean_force_absolute_mpe for run in runs]),
        body_mse=float(np.mean([run.body_mse for run in runs])),
        sinkage_mae=mean_of_known([run.sinkage_mae for run in runs]),
    )


def means_of_known(runs: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """`mean_of_known` for every key of the first."""
    return {key: mean_of_known([run[key] for run in runs]) for key in runs[0]}


def mean_of_known(values: Sequence[float]) -> float:
    """Mean of the values that are numbers; NaN if none is."""
    known = [value for value in values if not math.isnan(value)]
    return sum(known) / len(known) if known else math.nan


# --- What an evaluation found, in numbers: what the tables, the figures and the report are made from ----


@dataclass(frozen=True)
class EvaluatedRun:
    """One run of the split and its rollout."""

    name: str  # of the run
    label: str  # short name
    words: str  # its scene in a few words; empty if there is nothing to say
    truth: Path  # path of the simulated run
    rollout: Path  # path of the predicted run
    errors: PositionErrors  # position errors through time
    scores: Scores  # every metric
    wheel: bool = False  # whether its body is a wheel


@dataclass(frozen=True)
class NetworkTiming:
    """Wall seconds per simulated second of the network: medians of warm repeats on one thread."""

    rollout: float  # steps with force and torque; the soil stays in the subspace
    decoded: float  # the same, and every frame decoded to all particles
    repeats: int  # number of timed repeats
    run: str  # run that was timed
    rollout_bytes: float = math.nan  # peak memory of the whole process while it steps; NaN if not known
    decoded_bytes: float = math.nan  # the same while it decodes


@dataclass(frozen=True)
class Costs:
    """What the network takes besides time; NaN is not known."""

    parameters: int | float = math.nan  # weights that were learned
    # size of the file, with the basis and what is needed to go on training
    checkpoint_bytes: float = math.nan
    training_steps: int | float = math.nan  # of the whole training
    training_seconds: float = math.nan  # wall time of the whole training, validation included
    batch_size: int | float = math.nan  # samples of a training step

    @property
    def seconds_per_step(self) -> float:
        """Wall time of a training step [s]."""
        return self.training_seconds / self.training_steps


@dataclass(frozen=True)
class FullSpaceCost:
    """A network on every particle, untrained."""

    parameters: int  # weights that would be learned
    # wall time of a step of `batch_size` windows on one thread, reading them included [s]
    training_step: float
    batch_size: int  # windows of that step
    rollout: float  # wall seconds per simulated second on one thread
    peak_bytes: float  # peak memory of the whole process while it trains; NaN if not known


@dataclass(frozen=True)
class Evaluation:
    """Everything that a report shows, in numbers."""

    dataset: str  # name of the dataset
    split: str  # which of its splits was evaluated
    runs: Sequence[EvaluatedRun]  # the evaluated runs
    total: Scores  # scores of all of them together
    timing: NetworkTiming  # of the network
    mean_force: np.ndarray  # mean force of the training split [N], shape (3,)
    curves: ReductionCurves  # of the reduction; held out are the evaluated runs
    basis: Basis  # of the network
    num_modes: int  # modes r that the network uses
    history: int  # frames d that it was given
    particle_count: int  # particles n of the bed
    start: np.ndarray  # common start of the particles [m], shape (n, 3)
    costs: Costs = field(default_factory=Costs)  # of the network
    # of the same network on every particle; None if it was not asked for
    full_space: FullSpaceCost | None = None
    # mean torque of the training split [N m], shape (3,)
    mean_torque: np.ndarray = field(default_factory=lambda: np.zeros(3))
    # losses and validation scores by step, as `figures.read_log` gives them
    training_log: Mapping[str, np.ndarray] = field(default_factory=dict)
    # names of the evaluated runs that the basis and the network were fitted on
    trained_on: Sequence[str] = ()
    chosen_by: Sequence[str] = ()  # names of those that chose the checkpoint
    new_rollouts: Sequence[Path] = ()  # run files without truth that are shown too
    made: dict[str, str] = field(default_factory=dict)  # how it was made: name → value, in the order to show


# --- Which of the judged runs a checkpoint has already seen: a number for those is no test --------------


def seen_before(simulator: Simulator, names: Sequence[str]) -> tuple[list[str], list[str]]:
    """Of some runs' names those that the checkpoint was trained on, and those that chose it.

    A checkpoint knows its runs by name only.
    """
    fitted = set(simulator.basis.fitted_on or ())
    judged = set(simulator.card.get("settings", {}).get("validation_runs", ()))
    trained_on = [name for name in names if name in fitted]
    return trained_on, [name for name in names if name in judged - fitted]


def seen_warning(evaluation: Evaluation) -> str:
    """One sentence if the evaluation is no clean test, else nothing."""
    count = len(evaluation.runs)
    parts = [
        f"{len(names)} of the {count} evaluated runs {verb} ({names[0]}{', …' if len(names) > 1 else ''})"
        for names, verb in (
            (evaluation.trained_on, "bear the names of runs that this checkpoint was trained on"),
            (evaluation.chosen_by, "bear the names of validation runs that chose this checkpoint"),
        )
        if names
    ]
    return f"{'; '.join(parts)}: for those the numbers are no test." if parts else ""
