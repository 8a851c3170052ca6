"""`sgns evaluate`: a trained network against the simulated runs of a split, as tables, figures and a page.

Every run of the split is rolled out from its first d true frames along the same tool path, written as a run
file, and compared with the simulated one; baselines and times are measured beside it.
"""

from __future__ import annotations

import logging
import os
import statistics
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tqdm import tqdm

from sgns.errors import UserError
from sgns.evaluation.metrics import PositionErrors, mean_prediction, position_errors, reconstruction_curve
from sgns.evaluation.provenance import provenance
from sgns.evaluation.report_words import describe, short_names
from sgns.evaluation.scores import Scores, aggregate, run_scores, write_csv, write_json
from sgns.evaluation.surface import surface_grid
from sgns.reduction import Basis
from sgns.rollout import write_rollout
from sgns.runs import Run

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["EvaluatedRun", "Evaluation", "NetworkTiming", "ReductionCurves", "evaluate", "main"]

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class EvaluatedRun:
    """One run of the split and its rollout.

    Attributes:
        name: of the run.
        label: short name.
        words: its scene in a few words; empty if there is nothing to say.
        truth: path of the simulated run.
        rollout: path of the predicted run.
        errors: position errors through time.
        scores: every metric.
    """

    name: str
    label: str
    words: str
    truth: Path
    rollout: Path
    errors: PositionErrors
    scores: Scores


@dataclass(frozen=True)
class NetworkTiming:
    """Wall seconds per simulated second of the network: medians of warm repeats on one thread.

    Attributes:
        stepping: steps with force and torque; the soil stays in the subspace.
        decoding: the same, and every frame decoded to all particles.
        repeats: number of timed repeats.
        run: run that was timed.
    """

    stepping: float
    decoding: float
    repeats: int
    run: str


@dataclass(frozen=True)
class ReductionCurves:
    """What the subspace holds for r = 1 … R modes.

    Attributes:
        energy: the paper's energy on the training runs, shape (R,).
        displacement_energy: share of the motion's variance on the training runs, shape (R,).
        training: reduction MSE on the training runs [m²], shape (R,).
        evaluated: reduction MSE on the evaluated runs [m²] for r = 0 … R, shape (R + 1,).
    """

    energy: np.ndarray
    displacement_energy: np.ndarray
    training: np.ndarray
    evaluated: np.ndarray


@dataclass(frozen=True)
class Evaluation:
    """Everything that a report shows, in numbers.

    Attributes:
        dataset: name of the dataset.
        split: which of its splits was evaluated.
        runs: the evaluated runs.
        total: scores of all of them together.
        timing: of the network.
        mean_force: mean force of the training split [N], shape (3,).
        curves: of the reduction.
        num_modes: modes r that the network uses.
        history: frames d that it was given.
        particle_count: particles n of the bed.
        start: common start of the particles [m], shape (n, 3).
        new_rollouts: run files without truth that are shown too.
        made: how it was made: name → value, in the order to show.
    """

    dataset: str
    split: str
    runs: Sequence[EvaluatedRun]
    total: Scores
    timing: NetworkTiming
    mean_force: np.ndarray
    curves: ReductionCurves
    num_modes: int
    history: int
    particle_count: int
    start: np.ndarray
    new_rollouts: Sequence[Path] = ()
    made: dict[str, str] = field(default_factory=dict)


@contextmanager
def single_thread() -> Iterator[None]:
    """torch on one thread, as before afterwards."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def points_in_body_frame(run: Run) -> np.ndarray:
    """The body's points fixed to the body [m], shape (M, 3), from their places in frame 0."""
    pose = run.pose[0]
    offset = run.body_points[0] - pose[:3]
    axis, w = -pose[3:6], pose[6]  # the conjugate turns world → body
    twice = 2.0 * np.cross(axis, offset)
    return offset + w * twice + np.cross(axis, twice)


def true_history(simulator: Any, run: Run) -> torch.Tensor:
    """The first d true frames in the subspace, shape (d, r, 3)."""
    return simulator.basis.transform(torch.from_numpy(run.positions(slice(0, simulator.history))).double())


def roll_out(simulator: Any, run: Run) -> Any:
    """The network's `Rollout` along a run's tool path from its true history."""
    return simulator.rollout(run.pose, points_in_body_frame(run), latent_history=true_history(simulator, run))


def time_network(simulator: Any, path: Path, repeats: int) -> NetworkTiming:
    """Times rollouts along one run's tool path, after one that warms up."""
    stepping, decoding = [], []
    with Run(path) as run, single_thread():
        simulated = (run.frame_count - simulator.history) / run.frame_rate
        for repeat in range(max(repeats, 3) + 1):
            rollout = roll_out(simulator, run)
            began = time.perf_counter()
            for latent in torch.as_tensor(rollout.latent):
                simulator.basis.inverse(latent)
            if repeat:
                stepping.append(float(rollout.wall_time_s) / simulated)
                decoding.append(stepping[-1] + (time.perf_counter() - began) / simulated)
        return NetworkTiming(
            statistics.median(stepping), statistics.median(decoding), len(stepping), path.stem
        )


def full_basis(dataset: Any, basis: Basis) -> Basis:
    """The dataset's cached basis with more modes whose first modes are the network's; else the network's."""
    best = basis
    for path in sorted(Path(dataset.path).glob("reduced/*/basis.h5")):
        try:
            other = Basis.load(path)
        except UserError:  # another version's cache: the report then shows the network's modes only
            continue
        shared = other.num_modes > best.num_modes and other.modes.shape[0] == basis.modes.shape[0]
        if shared and torch.allclose(
            other.modes[:, : basis.num_modes].double(), basis.modes.double(), atol=1e-5
        ):
            best = other
    return best


def reduction_curves(basis: Basis, paths: Sequence[Path]) -> ReductionCurves:
    """Energy and reconstruction error of a basis on the training runs and on some others."""

    def runs() -> Iterator[Run]:
        for path in paths:
            with Run(path) as run:
                yield run

    return ReductionCurves(
        energy=np.asarray(basis.energy()),
        displacement_energy=np.asarray(basis.displacement_energy()),
        training=np.asarray(basis.residual_mse()),
        evaluated=reconstruction_curve(runs(), basis),
    )


def training_means(paths: Sequence[Path], history: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean force [N] and torque [N m] of the training split, shape (3,) each."""
    forces, torques = [], []
    for path in paths:
        with Run(path) as run:
            forces.append(run.force)
            torques.append(run.torque)
    return mean_prediction(forces, history), mean_prediction(torques, history)


def require_known_run(simulator: Any, run: Run, checkpoint: Path) -> None:
    """Refuses a run that the checkpoint's subspace cannot describe."""
    if run.arrangement_hash != simulator.arrangement_hash:
        raise UserError(
            f"{run.path} has another particle arrangement ({run.arrangement_hash}) than {checkpoint} was "
            f"trained on ({simulator.arrangement_hash}); evaluate it on its own dataset"
        )
    if abs(run.frame_rate - float(simulator.frame_rate)) > 1e-6 * run.frame_rate:
        raise UserError(
            f"{run.path} was recorded at {run.frame_rate:g} Hz, {checkpoint} steps at "
            f"{simulator.frame_rate:g} Hz; evaluate it on its own dataset"
        )


def evaluate(
    simulator: Any,
    dataset: Any,
    output: Path,
    *,
    split: str = "test",
    checkpoint: Path = Path("checkpoint"),
    new_rollouts: Sequence[Path] = (),
    repeats: int = 3,
    made: dict[str, str] | None = None,
) -> Evaluation:
    """Rolls out every run of a split, measures, and writes `rollouts/`, `metrics.csv` and `metrics.json`.

    Args:
        simulator: the trained `Simulator`.
        dataset: `Dataset` with the runs.
        output: folder to write to.
        split: `train`, `validation` or `test`.
        checkpoint: named in messages.
        new_rollouts: run files without truth, checked here and shown in the report.
        repeats: timed rollouts, at least 3.
        made: how it was made, for the report.
    """
    paths = [Path(path) for path in dataset.runs(split)]
    if not paths:
        raise UserError(
            f"dataset {dataset.name} has no complete run in its split {split!r}; allowed: train, "
            f"validation, test; simulate it first: sgns simulate dataset={dataset.name}"
        )
    for path in new_rollouts:
        with Run(path) as run:
            require_known_run(simulator, run, checkpoint)
    try:
        (output / "rollouts").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(
            f"cannot write to output={output}: {error.strerror}; give a folder that you may write to"
        ) from error
    history = int(simulator.history)
    mean_force, mean_torque = training_means(dataset.runs("train"), history)
    start = np.asarray(simulator.start_positions, dtype=np.float64)
    grid = surface_grid(start)

    runs = []
    labels = short_names([path.stem for path in paths])
    for path, label in zip(tqdm(paths, desc="rolling out", unit="run", disable=None), labels, strict=True):
        target = output / "rollouts" / f"{path.stem}.h5"
        with ExitStack() as stack:
            truth = stack.enter_context(Run(path))
            require_known_run(simulator, truth, checkpoint)
            rollout = roll_out(simulator, truth)
            write_rollout(
                target,
                simulator,
                truth.scene,
                rollout,
                effects=truth.effects,
                seed=truth.seed,
                extra={"checkpoint": str(checkpoint), "history": history},
            )
            prediction = stack.enter_context(Run(target))
            errors = position_errors(truth, prediction, simulator.basis, history, grid)
            words = describe(truth.scene)
            scores = run_scores(path.stem, errors, truth, prediction, history, mean_force, mean_torque)
        runs.append(EvaluatedRun(path.stem, label, words, path, target, errors, scores))

    evaluation = Evaluation(
        dataset=str(dataset.name),
        split=split,
        runs=runs,
        total=aggregate([run.scores for run in runs]),
        timing=time_network(simulator, paths[0], repeats),
        mean_force=mean_force,
        curves=reduction_curves(full_basis(dataset, simulator.basis), paths),
        num_modes=int(simulator.num_modes),
        history=history,
        particle_count=len(start),
        start=start,
        new_rollouts=[Path(path) for path in new_rollouts],
        made=dict(made or {}),
    )
    write_tables(evaluation, output)
    return evaluation


def write_tables(evaluation: Evaluation, output: Path) -> None:
    """`metrics.csv`: a row per run and one for all; `metrics.json`: the same and everything around it."""
    scores = [run.scores for run in evaluation.runs]
    write_csv(output / "metrics.csv", [*scores, evaluation.total])
    timing = evaluation.timing
    write_json(
        output / "metrics.json",
        {
            "dataset": evaluation.dataset,
            "split": evaluation.split,
            "num_modes": evaluation.num_modes,
            "history": evaluation.history,
            "particles": evaluation.particle_count,
            "aggregate": evaluation.total.row(),
            "runs": [score.row() for score in scores],
            "mean_training_force_N": evaluation.mean_force,
            "wall_s_per_simulated_s": {
                "solver": evaluation.total.solver_rate,
                "network_stepping_with_force": timing.stepping,
                "network_with_decoding": timing.decoding,
                "network_threads": 1,
                "network_repeats": timing.repeats,
            },
            "reconstruction_mse_m2": evaluation.curves.evaluated,
            "made": evaluation.made,
        },
    )


def log_summary(evaluation: Evaluation, report: Path) -> None:
    """The main numbers on the terminal."""
    total, timing = evaluation.total, evaluation.timing
    log.info("%d %s runs of %s", len(evaluation.runs), evaluation.split, evaluation.dataset)
    log.info(
        "position: RMSE %.3g mm (reduction alone %.3g, frozen %.3g); skill %.3f against frozen, %.3f "
        "against constant velocity",
        total.rmse_mm("total"),
        total.rmse_mm("reduction"),
        total.rmse_mm("frozen"),
        total.skill(),
        total.skill("constant_velocity"),
    )
    log.info(
        "force: NRMSE %.3f (mean force of the training split: %.3f); draft MAE %.3g N, vertical MAE %.3g N",
        total.force.overall_nrmse,
        total.mean_force.overall_nrmse,
        total.force.mae[0],
        total.force.mae[2],
    )
    log.info(
        "wall seconds per simulated second: network %.3g (with decoding %.3g, one thread), solver %.3g",
        timing.stepping,
        timing.decoding,
        total.solver_rate,
    )
    log.info("report: %s", report)


def main(cfg: DictConfig) -> float:
    """The `sgns evaluate` command; returns the position skill against frozen over all runs of the split."""
    from sgns.campaign import Dataset
    from sgns.evaluation.report import write_report
    from sgns.simulator import Simulator

    checkpoint = Path(cfg.checkpoint)
    simulator = Simulator.load(checkpoint, device=cfg.get("device") or "cpu")
    output = Path(cfg.output)
    evaluation = evaluate(
        simulator,
        Dataset.open(cfg.dataset.path),
        output,
        split=str(cfg.split),
        checkpoint=checkpoint,
        new_rollouts=[Path(path) for path in cfg.get("new_rollouts") or ()],
        repeats=int(cfg.get("timing_repeats") or 3),
        made=provenance(simulator, checkpoint),
    )
    report = write_report(evaluation, output)
    log_summary(evaluation, Path(os.path.relpath(report)))
    return evaluation.total.skill("frozen")
