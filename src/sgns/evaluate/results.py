"""What an evaluation found, in numbers: what the figures and the report are made from, and as files."""

from __future__ import annotations

import csv
import json
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mpm_warp.settings import short_repr
from sgns.data.files import whole_file, write_whole
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
from sgns.simulator import Simulator

# --- All metrics of one predicted run, or of several together, as one row of a table --------------------

POSITION_ERRORS = ("reduction", "network", "total", "frozen", "constant_velocity")
SURFACE_ERRORS = ("surface", "surface_frozen")
VECTOR_ERRORS = ("force", "torque", "mean_force", "mean_torque", "contact", "contact_mean")
CONTACT_SHARE = 0.01
"""Of a run's largest force: with less of it the tool does not touch the soil."""


@dataclass(frozen=True)
class Scores:
    """Errors of a prediction and of the baselines."""

    __repr__ = short_repr

    name: str  # of the run, or of the group of runs
    frames: int  # number of frames that count (the history does not)
    mse: Mapping[str, float]  # mean-square errors [m²] by the names of `PositionErrors`
    force: VectorErrors  # errors of the force [N]
    torque: VectorErrors  # errors of the torque about the centre of mass [N m]
    mean_force: VectorErrors  # errors of the mean force of the training split [N]
    mean_torque: VectorErrors  # errors of the mean torque of the training split [N m]
    contact: VectorErrors  # as `force`, over the frames in contact [N]
    contact_mean: VectorErrors  # there, of the true run's own mean: no constant is better [N]
    solver_rate: float  # wall seconds per simulated second of the solver; NaN if not recorded
    # mean-square distance of the body from its true place [m²]; 0 where its path was given
    body_mse: float = 0.0
    sinkage_mae: float = math.nan  # mean absolute error of a wheel's sinkage [m]; NaN for other bodies
    # share of the force's components within the prediction's spread, all frames [1]; NaN where it has none
    coverage: float = math.nan

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
        row |= {f"skill_{name}": self.skill(name) for name in ("frozen", "constant_velocity")}
        row |= {f"{name}_rmse_mm": self.rmse_mm(name) for name in SURFACE_ERRORS}
        for prefix, errors in (("", self.force), ("mean_force_", self.mean_force)):
            row |= columns(errors, FORCE_COMPONENTS, prefix, "force", "N")
        sizes = self.force.absolute_mpe
        row |= {f"{name}_abs_mpe_percent": float(sizes[axis]) for name, axis in FORCE_COMPONENTS.items()}
        for prefix, errors in (("", self.torque), ("mean_torque_", self.mean_torque)):
            row |= columns(errors, TORQUE_COMPONENTS, prefix, "torque", "Nm")
        row["contact_force_nrmse"] = self.contact.overall_nrmse
        row["contact_mean_force_nrmse"] = self.contact_mean.overall_nrmse
        row |= {"body_rmse_mm": 1e3 * math.sqrt(self.body_mse), "sinkage_mae_mm": 1e3 * self.sinkage_mae}
        row["force_coverage"] = self.coverage
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
    values[f"{prefix or vector + '_'}nrmse"] = errors.overall_nrmse
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
    force, torque = truth.force[history:], truth.torque[history:]
    simulated, wall = float(truth.time[-1] - truth.time[0]), truth.wall_time_s
    size = np.linalg.norm(force, axis=1)
    touching = ~(size < CONTACT_SHARE * size.max())  # all, where there is no force
    return Scores(
        name=name,
        frames=len(positions.time),
        mse={key: positions.mse(key) for key in POSITION_ERRORS + SURFACE_ERRORS},
        force=VectorErrors.compare(force, prediction.force[history:]),
        torque=VectorErrors.compare(torque, prediction.torque[history:]),
        mean_force=VectorErrors.compare(force, mean_force),
        mean_torque=VectorErrors.compare(torque, mean_torque),
        contact=VectorErrors.compare(force[touching], prediction.force[history:][touching]),
        contact_mean=VectorErrors.compare(force[touching], force[touching].mean(axis=0)),
        solver_rate=float(wall) / simulated if wall else math.nan,
        body_mse=body.mse,
        sinkage_mae=body.sinkage_mae,
        coverage=covered(force, prediction, history),
    )


def covered(force: np.ndarray, prediction: Any, history: int) -> float:
    """Share of the components of the true force (t, 3) within the prediction's spread; NaN where it has none."""
    if prediction.force_spread is None:
        return math.nan
    return float(np.mean(np.abs(prediction.force[history:] - force) <= prediction.force_spread[history:]))


def aggregate(runs: Sequence[Scores], name: str = "all runs") -> Scores:
    """Scores of several runs together.

    Position errors are means over runs, so that skill is 1 − Σ MSE / Σ MSE of the baseline; forces are pooled
    over all frames; |MPE|, sinkage, coverage and the solver's time are means over the runs that have them.
    """
    first = runs[0]

    def pooled(field: str) -> VectorErrors:
        return sum((getattr(run, field) for run in runs[1:]), start=getattr(first, field))

    return Scores(
        name=name,
        frames=sum(run.frames for run in runs),
        mse={key: float(np.mean([run.mse[key] for run in runs])) for key in first.mse},
        **{name: pooled(name) for name in VECTOR_ERRORS},
        solver_rate=mean_of_known([run.solver_rate for run in runs]),
        body_mse=float(np.mean([run.body_mse for run in runs])),
        sinkage_mae=mean_of_known([run.sinkage_mae for run in runs]),
        coverage=mean_of_known([run.coverage for run in runs]),
    )


def mean_of_known(values: Sequence[float]) -> float:
    """Mean of the values that are numbers; NaN if none is."""
    known = [value for value in values if not math.isnan(value)]
    return sum(known) / len(known) if known else math.nan


# --- Everything that an evaluation found ------------------------------------------------------------------


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

    @property
    def main_errors(self) -> tuple[float, float]:
        """Of the positions [mm] and of the force [NRMSE]."""
        return self.scores.rmse_mm("total"), self.scores.force.overall_nrmse


@dataclass(frozen=True)
class NetworkTiming:
    """Wall seconds per simulated second of network and solver, measured in turn on one thread: medians of warm
    repeats."""

    rollout: float  # along a known path: steps with force and torque; the soil stays in the subspace
    decoded: float  # the same, and every frame decoded to all particles
    stepped: float  # `Simulator.step`, pose by pose, likewise in the subspace
    solver: float  # nothing written; NaN where the run does not say what it takes to compute it again
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

    __repr__ = short_repr

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
    start: np.ndarray  # common start of the particles [m], shape (n, 3)
    costs: Costs = field(default_factory=Costs)  # of the network
    # of the same network on every particle; None if it was not asked for
    full_space: FullSpaceCost | None = None
    # mean torque of the training split [N m], shape (3,)
    mean_torque: np.ndarray = field(default_factory=lambda: np.zeros(3))
    # losses and validation scores by step, as `read_log` gives them
    training_log: Mapping[str, np.ndarray] = field(default_factory=dict)
    # names of the evaluated runs that the basis and the network were fitted on
    trained_on: Sequence[str] = ()
    chosen_by: Sequence[str] = ()  # names of those that chose the checkpoint
    new_rollouts: Sequence[Path] = ()  # run files without truth that are shown too
    made: dict[str, str] = field(default_factory=dict)  # how it was made: name → value, in the order to show

    @property
    def median_errors(self) -> tuple[float, float]:
        """Over the runs, of the positions [mm] and of the force [NRMSE]; NaN where no run has any."""
        rmse, nrmse = (
            [error for error in errors if not math.isnan(error)]
            for errors in zip(*(run.main_errors for run in self.runs), strict=True)
        )
        return statistics.median(rmse or [math.nan]), statistics.median(nrmse or [math.nan])


def typical_and_worst(evaluation: Evaluation) -> tuple[EvaluatedRun, EvaluatedRun]:
    """The run nearest to the medians of both main errors, by factors, and the one farthest above either of them."""

    def factors(run: EvaluatedRun) -> list[float]:
        pairs = zip(run.main_errors, evaluation.median_errors, strict=True)
        # 1 where there is no force, or no error at all.
        return [e / m if 0.0 < m < math.inf and not math.isnan(e) else 1.0 for e, m in pairs]

    def distance(run: EvaluatedRun) -> float:
        return sum(abs(math.log(max(factor, 1e-9))) for factor in factors(run))

    return min(evaluation.runs, key=distance), max(evaluation.runs, key=lambda run: max(factors(run)))


def seen_before(simulator: Simulator, names: Sequence[str]) -> tuple[list[str], list[str]]:
    """Of some runs' names those that the checkpoint was trained on, and those that chose it: for these a number is no
    test. A checkpoint knows its runs by name only."""
    fitted = set(simulator.basis.fitted_on or ())
    judged = set(simulator.card.get("settings", {}).get("validation_runs", ()))
    trained_on = [name for name in names if name in fitted]
    return trained_on, [name for name in names if name in judged - fitted]


# --- The numbers of an evaluation as files: `metrics.csv`, `examples.csv` and `metrics.json` ------------


def write_tables(evaluation: Evaluation, output: Path) -> None:
    """Writes the files.

    `metrics.csv`: a row per run and one for all; `examples.csv`: the columns of the paper's table of test
    examples with the baselines beside; `metrics.json`: the first and everything around it.
    """
    scores = [run.scores for run in evaluation.runs]
    write_csv(output / "metrics.csv", [score.row() for score in (*scores, evaluation.total)])
    write_csv(output / "examples.csv", [example_row(score) for score in (*scores, evaluation.total)])
    timing, costs = evaluation.timing, evaluation.costs
    write_json(
        output / "metrics.json",
        {
            "dataset": evaluation.dataset,
            "split": evaluation.split,
            "num_modes": evaluation.num_modes,
            "history": evaluation.history,
            "particles": len(evaluation.start),
            "aggregate": evaluation.total.row(),
            "runs": [score.row() for score in scores],
            "mean_training_force_N": evaluation.mean_force,
            "wall_s_per_simulated_s": {
                "solver": timing.solver,
                "solver_in_run_files": evaluation.total.solver_rate,
                "network_stepping_with_force": timing.rollout,
                "network_pose_by_pose": timing.stepped,
                "network_with_decoding": timing.decoded,
                "network_threads": 1,
                "network_repeats": timing.repeats,
            },
            "peak_memory_bytes": {
                "network_stepping_with_force": timing.rollout_bytes,
                "network_with_decoding": timing.decoded_bytes,
            },
            "network": {
                "parameters": costs.parameters,
                "checkpoint_bytes": costs.checkpoint_bytes,
                "training_steps": costs.training_steps,
                "training_wall_s": costs.training_seconds,
                "training_wall_s_per_step": costs.seconds_per_step,
                "training_batch_size": costs.batch_size,
            },
            "full_space": asdict(evaluation.full_space) if evaluation.full_space else None,
            "evaluated_runs_trained_on": list(evaluation.trained_on),
            "evaluated_runs_that_chose_the_checkpoint": list(evaluation.chosen_by),
            "reconstruction_mse_m2": evaluation.curves.held_out,
            "made": evaluation.made,
        },
    )


def example_row(scores: Scores) -> dict[str, Any]:
    """One row of the table of test examples: MSE of positions, signed MPE of the force, and baselines.

    The signed MPE of several runs together is that of the pooled means, in which runs cancel; beside it the mean
    of |MPE| over runs, in which they do not.
    """
    shown = ("network", "total", "frozen", "constant_velocity")
    row: dict[str, Any] = {"run": scores.name} | {f"mse_{name}_m2": scores.mse[name] for name in shown}
    for prefix, errors in (("", scores.force), ("mean_force_", scores.mean_force)):
        for name, axis in FORCE_COMPONENTS.items():
            row[f"{prefix}{name}_mpe_percent"] = float(errors.mpe[axis])
            row[f"{prefix}{name}_abs_mpe_percent"] = float(errors.absolute_mpe[axis])
        row[f"{prefix}nrmse"] = errors.overall_nrmse
    return row


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """One line per row under a line of column names; a metric without meaning is left empty."""
    with whole_file(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        for row in rows:
            writer.writerow({key: "" if value != value else value for key, value in row.items()})


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Nested plain values as JSON that every reader takes: numbers that are not finite become null."""
    write_whole(path, json.dumps(plain(content), indent=2, allow_nan=False) + "\n")


def plain(value: Any) -> Any:
    """Mappings, sequences, arrays and numbers as JSON knows them, with None for numbers that are not finite."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
