"""`sgns evaluate`: a trained network against the simulated runs of a split, as tables, figures and a page.

Every run of the split is rolled out from its first d true frames along the same tool path, written as a run
file, and compared with the simulated one; baselines and times are measured beside it.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tqdm import tqdm

from mpm_warp.poses import in_body_frame
from mpm_warp.settings import open_file
from sgns.config import UserError
from sgns.data.check import scene_problems
from sgns.data.dataset import SPLITS, Dataset
from sgns.data.files import only_here, require_replaceable
from sgns.data.run import Run
from sgns.data.surface import surface_grid
from sgns.evaluate.costs import network_costs, provenance, roll_out, time_network
from sgns.evaluate.figures import VALIDATION
from sgns.evaluate.metrics import PositionErrors, body_errors, mean_prediction, position_errors
from sgns.evaluate.report import describe, forward_name, seen_warning, short_names, write_report
from sgns.evaluate.results import (
    EvaluatedRun,
    Evaluation,
    Scores,
    aggregate,
    run_scores,
    seen_before,
    write_csv,
    write_json,
    write_tables,
)
from sgns.model.checkpoint import checkpoint_file
from sgns.model.features import is_wheel
from sgns.numbers import counted, error_hint, error_words
from sgns.reduction.basis import Basis, outside, reduction_curves
from sgns.reduction.packed import packed_dataset
from sgns.reduction.published import PARTICLES, fingerprint, published_runs
from sgns.reduction.reduce import ReducedRun
from sgns.rollout import single_thread, write_rollout
from sgns.settings import ModelSettings, model_settings
from sgns.simulator import Simulator

log = logging.getLogger(__name__)

MOST_BYTES = 1 << 26  # of a training's log, all files together; a day of training writes a tenth of that


def full_basis(dataset: Dataset, basis: Basis) -> Basis:
    """The dataset's cached basis with more modes whose first modes are the network's; else the network's."""
    best = basis
    for path in sorted(Path(dataset.path).glob("reduced/*/basis.h5")):
        try:
            other = Basis.load(path)
        except UserError:  # another version's cache: the report then shows the network's modes only
            continue
        first = other.modes[:, : basis.num_modes].double()
        larger = other.num_modes > best.num_modes and first.shape == basis.modes.shape
        if larger and torch.allclose(first, basis.modes.double(), atol=1e-5):
            best = other
    return best


def training_means(paths: Sequence[Path], history: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean force [N] and torque [N m] of the training split, shape (3,) each."""
    forces, torques = [], []
    for path in paths:
        with Run(path) as run:
            forces.append(run.force)
            torques.append(run.torque)
    return mean_prediction(forces, history), mean_prediction(torques, history)


def read_log(folder: Path) -> dict[str, np.ndarray]:
    """Scalars of a TensorBoard folder: name → steps and values, shape (k, 2); empty if there is no log.

    Raises:
        UserError: It holds what is no log.
    """
    if not folder.is_dir():
        return {}
    advice = "remove it: only a figure of the report needs it"
    left = MOST_BYTES
    for file in sorted(folder.glob("*tfevents*")):  # what TensorBoard would read
        try:
            with open_file(file, left) as content:
                left -= os.fstat(content.fileno()).st_size
        except (OSError, ValueError) as error:
            raise UserError(f"{file} is no log of TensorBoard ({error}); {advice}") from error
    try:
        events = EventAccumulator(str(folder), size_guidance={"scalars": 0}).Reload()
    except Exception as error:  # whatever bytes do to a reader that is not ours
        reason = " ".join(str(error).split()) or type(error).__name__
        raise UserError(f"{folder} holds no log of TensorBoard ({reason:.200}); {advice}") from error
    # A training that was killed logs some steps again, and its files are out of order if the clock went back.
    return {
        name: np.array(sorted({e.step: e.value for e in events.Scalars(name)}.items()), dtype=np.float64)
        for name in events.Tags()["scalars"]
        if name.startswith("loss/") or name in VALIDATION
    }


def require_known_run(simulator: Simulator, run: Run, checkpoint: Path) -> None:
    """Refuses a run that the checkpoint's subspace, or the report, cannot describe."""
    if problems := scene_problems(run.scene):
        raise UserError(f"{run.path}: {problems[0]}; repeat the run")
    if run.arrangement_hash != simulator.arrangement_hash:
        raise UserError(
            f"{run.path} has another particle arrangement ({run.arrangement_hash}) than {checkpoint} was "
            f"trained on ({simulator.arrangement_hash}); evaluate it on its own dataset"
        )
    if abs(run.frame_rate - simulator.frame_rate) > 1e-6 * run.frame_rate:
        raise UserError(
            f"{run.path} was recorded at {run.frame_rate:g} Hz, {checkpoint} steps at "
            f"{simulator.frame_rate:g} Hz; evaluate it on its own dataset"
        )


def evaluate(
    simulator: Simulator,
    dataset: Dataset,
    output: Path,
    *,
    split: str = "test",
    checkpoint: Path,
    new_rollouts: Sequence[Path] = (),
    repeats: int = 3,
    full_space: bool = False,
    made: dict[str, str] | None = None,
) -> Evaluation:
    """Rolls out every run of a split, measures, and writes `rollouts/`, `metrics.csv` and `metrics.json` into `output`.

    `new_rollouts` are run files without truth, checked here and shown in the report; `full_space` is whether to measure
    what the same network would cost on every particle; `made` says how the evaluation was made, for the report.
    """
    network = model_settings(simulator.card["model"]) if full_space else None
    if network is not None and not isinstance(network, ModelSettings):
        raise UserError(
            f"full_space=true: {checkpoint} holds polynomials; only a network has a counterpart in full space"
        )
    paths = dataset.runs(split)
    if not paths:
        raise UserError(
            f"dataset {dataset.title} has no complete run in its split {split!r}; allowed: train, "
            f"validation, test; simulate it first: {dataset.command}"
        )
    for path in (*paths, *new_rollouts):  # all of them before anything is written
        with Run(path) as run:
            require_known_run(simulator, run, checkpoint)
    costs = network_costs(checkpoint, simulator.card)
    # Of a job of a sweep the folder is called as the job.
    logs = sorted(file.parent for file in checkpoint.parent.glob("*/*tfevents*"))
    training_log = read_log(logs[0] if logs else checkpoint.parent / "tensorboard")
    require_replaceable(
        *(output / name for name in ("metrics.csv", "examples.csv", "metrics.json", "report.html")),
        *(output / "figures").glob("*.png"),
        *(output / "rollouts").glob("*.h5"),
    )
    try:
        (output / "rollouts").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(
            f"cannot write to output={output}: {error.strerror}; give a folder that you may write to"
        ) from error
    history = simulator.history
    means = training_means(dataset.runs("train"), history)
    start = np.asarray(simulator.start_positions, dtype=np.float64)
    grid = surface_grid(start)

    runs, names = [], [path.stem for path in paths]
    progress = tqdm(paths, desc="rolling out", unit="run", disable=None)
    for path, label in zip(progress, short_names(names), strict=True):
        target = output / "rollouts" / f"{path.stem}.h5"
        with Run(path) as truth:
            rollout = roll_out(simulator, truth)
            write_rollout(
                target,
                simulator,
                truth.scene,
                rollout,
                effects=truth.effects,
                seed=truth.seed,
                checkpoint=checkpoint,
                mesh=truth.mesh,
                given_frames=history,
            )
            with Run(target) as prediction:
                errors = position_errors(truth, prediction, simulator.basis, history, grid)
                body = body_errors(truth, prediction.pose, history)
                scores = run_scores(path.stem, errors, truth, prediction, history, *means, body)
            words, wheel = describe(truth.scene), is_wheel(truth.scene)
        runs.append(EvaluatedRun(path.stem, label, words, path, target, errors, scores, wheel))

    trained_on, chosen_by = seen_before(simulator, names)
    every_particle = None
    if network:
        from sgns.evaluate.full_space import full_space_cost

        every_particle = full_space_cost(paths[0], network, repeats)
    evaluation = Evaluation(
        dataset=dataset.title,
        split=split,
        runs=runs,
        total=aggregate([run.scores for run in runs]),
        timing=time_network(simulator, paths[0], repeats),
        costs=costs,
        full_space=every_particle,
        mean_force=means[0],
        mean_torque=means[1],
        training_log=training_log,
        trained_on=trained_on,
        chosen_by=chosen_by,
        curves=reduction_curves(full_basis(dataset, simulator.basis), paths),
        basis=simulator.basis,
        num_modes=simulator.num_modes,
        history=history,
        start=start,
        new_rollouts=new_rollouts,
        made=made or {},
    )
    write_tables(evaluation, output)
    return evaluation


def log_summary(evaluation: Evaluation, report: Path) -> None:
    """The main numbers on the terminal."""
    total, timing = evaluation.total, evaluation.timing
    if warning := seen_warning(evaluation):
        log.warning("%s", warning)
    soil, still = (1e-3 * total.rmse_mm(name) for name in ("total", "frozen"))
    errors = soil, still, total.force.overall_nrmse, total.mean_force.overall_nrmse
    least = "no soil error can be below"
    if evaluation.basis.closure:
        least = "the true modes and the closure leave a soil error of"
    lines = [
        f"{counted(len(evaluation.runs), f'{evaluation.split} run')} of {evaluation.dataset}: {error_words(*errors)}",
        f"{least} {total.rmse_mm('reduction'):.3g} mm with {counted(evaluation.num_modes, 'mode')}",
        f"mean absolute error of the force: {forward_name(evaluation)} {total.force.mae[0]:.3g} N, vertical "
        f"{total.force.mae[2]:.3g} N",
        f"computing time of one simulated second, on one thread: network along a path {timing.rollout:.3g} s (all "
        f"particles decoded {timing.decoded:.3g} s), pose by pose {timing.stepped:.3g} s; solver {timing.solver:.3g} s",
    ]
    if not math.isnan(total.coverage):
        lines.append(
            f"band around the force: {100 * total.coverage:.0f} % of the true values are in it, 90 % are to be"
        )
    if full := evaluation.full_space:
        lines.append(
            f"the same network on every particle: {full.rollout:.3g} s per simulated second, {full.training_step:.3g} "
            f"s per training step of {full.batch_size} samples"
        )
    hint = error_hint(*errors)
    for line in [*lines, *([hint] if hint else []), f"report: {report}"]:
        log.info("%s", line)


# --- Datasets of which only the modes are known, packed or published: a table, no pictures ----------------
# With an orthonormal basis the mean square over all particles is ‖ΔS′‖² / 3n all the same. What the reduction leaves
# out is known of packed runs only.


def evaluate_modes(
    simulator: Simulator, settings: Mapping[str, Any], split: str, output: Path, checkpoint: Path
) -> float:
    """Roll out, print the table, write metrics.csv and metrics.json; returns the skill against frozen."""
    of_split = published_split if settings["format"] == "published" else packed_split
    runs = of_split(simulator, settings, split, checkpoint)
    require_replaceable(output / "metrics.csv", output / "metrics.json")
    mean_force = simulator.mean_force
    with single_thread():
        scores = [scored(simulator, run, mean_force) for run in runs]
    total = aggregate(scores)
    log.info("%s", "\n".join(score_lines([*scores, total])))
    output.mkdir(parents=True, exist_ok=True)
    write_csv(output / "metrics.csv", [score.row() for score in (*scores, total)])
    write_json(
        output / "metrics.json",
        {
            "aggregate": total.row(),
            "runs": [score.row() for score in scores],
            "mean_training_force_N": mean_force,
            "particles": _particles(simulator, runs[0]),
            "made": provenance(simulator, checkpoint),
        },
    )
    log.info("tables: %s", output)
    return total.skill()


def scored(simulator: Simulator, run: ReducedRun, mean_force: np.ndarray) -> Scores:
    """Scores of one run, rolled out from its first d true frames."""
    d = simulator.history
    truth = run.latent[:, : simulator.num_modes]
    rollout = simulator.rollout(
        run.pose, in_body_frame(run.pose[0], run.body_points[0]), latent_history=truth[:d], values=run.scene
    )
    size = 3 * _particles(simulator, run)

    def mean_square(latent: np.ndarray) -> np.ndarray:
        return ((latent - truth)[d:] ** 2).sum(axis=(1, 2)) / size

    elapsed = np.arange(len(truth))[:, None, None] - (d - 1)
    network = mean_square(rollout.latent)
    unknown = np.full(len(network), np.nan)
    reduction, missed, way = unknown, np.zeros(1), np.zeros(1)
    if run.unseen is not None:
        missed, way = (part[d:] / size for part in outside(run.latent[:, simulator.num_modes :], run.unseen))
        reduction = missed
        if closure := simulator.basis.closure:
            beyond = run.latent[:, simulator.num_modes :][:, : closure.num_modes]

            def gained(latent: np.ndarray) -> np.ndarray:
                found = closure.coordinates(torch.from_numpy(latent)).numpy()
                return (np.square(beyond) - np.square(found - beyond))[d:].sum(axis=(1, 2)) / size

            missed, reduction = missed - gained(rollout.latent), missed - gained(truth)
    errors = PositionErrors(
        time=run.time[d:],
        reduction=reduction,
        network=network,
        total=network + missed,
        frozen=mean_square(truth[d - 1][None]) + way,
        # What moves outside the modes has hardly begun to when the history ends.
        constant_velocity=mean_square(truth[d - 1] + elapsed * (truth[d - 1] - truth[d - 2])) + way,
        surface=unknown,
        surface_frozen=unknown,
    )
    simulated = SimpleNamespace(time=run.time, force=run.force, torque=run.torque, wall_time_s=0.0)
    body = body_errors(run, rollout.poses, d)
    return run_scores(run.name, errors, simulated, rollout, d, mean_force, np.zeros(3), body)


def _particles(simulator: Simulator, run: ReducedRun) -> int:
    """How many particles the modes move; of published runs the basis does not say it."""
    return PARTICLES[run.scene["kind"]] if run.unseen is None else simulator.basis.num_particles


def score_lines(scores: Sequence[Scores]) -> list[str]:
    """The table as text: position errors in 1e-4 m², force errors in per cent; x is forward, z up."""
    lines = [
        "                      position MSE [1e-4 m2]      skill against      force MPE [%]   force NRMSE",
        "run               network   frozen  const vel  frozen const vel      x       z     network  mean force",
    ]
    for score in scores:
        mse = [1e4 * score.mse[name] for name in ("network", "frozen", "constant_velocity")]
        lines.append(
            f"{score.name:<16} {mse[0]:8.4f} {mse[1]:8.4f} {mse[2]:10.4f} {score.skill():7.3f} "
            f"{score.skill('constant_velocity'):9.3f} {score.force.mpe[0]:7.1f} {score.force.mpe[2]:7.1f} "
            f"{score.force.overall_nrmse:9.3f} {score.mean_force.overall_nrmse:11.3f}"
        )
    absolute = scores[-1].force.absolute_mpe
    lines.append(f"mean |MPE|: x {absolute[0]:.1f} %, z {absolute[2]:.1f} %")
    return lines


def published_split(
    simulator: Simulator, settings: Mapping[str, Any], split: str, checkpoint: Path
) -> list[ReducedRun]:
    """The split "train" are the published runs that the simulator was trained on, any other are the others there."""
    trained = {name.rsplit(" ", 1)[-1] for name in simulator.basis.fitted_on or []}
    everything = [run for found in published_runs(settings["path"]).values() for run in found]
    kind = everything[0].scene["kind"]
    if simulator.arrangement_hash != f"published-{kind}":
        raise UserError(
            f"{checkpoint} was not trained on published {kind} runs; train one: sgns train dataset=published "
            f"dataset.path={settings['path']}"
        )
    runs = [run for run in everything if (fingerprint(run) in trained) == (split == "train")]
    if not runs:
        if split == "train":
            raise UserError(
                f"{checkpoint} was trained on none of the runs in {settings['path']}; use split=test"
            )
        log.warning("%s was trained on all of these runs: errors on new runs will be larger", checkpoint)
        runs = everything
    return runs


def packed_split(
    simulator: Simulator, settings: Mapping[str, Any], split: str, checkpoint: Path
) -> list[ReducedRun]:
    """The runs of a packed dataset that the simulator was trained on a part of."""
    reduced = packed_dataset(Path(settings["path"]), {"num_modes": simulator.num_modes})
    if not simulator.basis.same_modes(reduced.basis.modes[:, : simulator.num_modes]):
        raise UserError(
            f"{checkpoint} was not trained on {settings['path']}: its modes are others; train one: sgns train "
            f"dataset={settings['name']}"
        )
    if not (runs := reduced.runs(split)):
        raise UserError(f"{settings['path']} has no {split} runs; use another split: {', '.join(SPLITS)}")
    return runs


# --- The command ---------------------------------------------------------------------------------------


def main(cfg: DictConfig) -> float:
    """The `sgns evaluate` command; returns the position skill against frozen over all runs of the split."""
    new_rollouts = [cfg.new_rollouts] if isinstance(cfg.new_rollouts, str) else cfg.new_rollouts or []
    checkpoint, output = checkpoint_file(cfg.checkpoint), Path(cfg.output)
    form = cfg.dataset.get("format")
    simulator = Simulator.load(checkpoint, cfg.device, cfg.num_modes, spread=cfg.spread)
    if form is None:
        dataset = Dataset.open(cfg.dataset.path, cfg.dataset.get("where"))
    with only_here(output / "metrics.json"):
        if form is not None:
            return evaluate_modes(simulator, cfg.dataset, cfg.split, output, checkpoint)
        evaluation = evaluate(
            simulator,
            dataset,
            output,
            split=cfg.split,
            checkpoint=checkpoint,
            new_rollouts=[Path(path) for path in new_rollouts],
            repeats=cfg.timing_repeats,
            full_space=cfg.full_space,
            made=provenance(simulator, checkpoint),
        )
        report = write_report(evaluation, output)
    log_summary(evaluation, Path(os.path.relpath(report)))
    return evaluation.total.skill("frozen")
