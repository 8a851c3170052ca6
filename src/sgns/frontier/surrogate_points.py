"""Points of surrogates."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import shlex
import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra import compose, initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf

from mpm_warp import Scene
from sgns.clock import elapsed
from sgns.config import UserError
from sgns.data.dataset import SPLITS, Dataset
from sgns.data.files import claimed, write_whole
from sgns.data.run import Run
from sgns.data.small_files import read_json, read_table
from sgns.evaluate.command import roll_out, training_means
from sgns.evaluate.costs import network_costs
from sgns.evaluate.metrics import body_errors, position_errors, surface_grid
from sgns.evaluate.results import Scores, aggregate, run_scores
from sgns.frontier.observation import Observation, observe_arrays, observed_frames
from sgns.frontier.point import Point
from sgns.frontier.study import (
    PointSettings,
    Study,
    StudyScene,
    Workload,
    composed_scene,
    cost_fields,
    made_here,
    one_core,
)
from sgns.model.settings import ModelSettings, model_settings
from sgns.reduction.reduce import ReducedDataset, ReducedRun, reduce_dataset
from sgns.rollout import finite_frames, single_thread
from sgns.simulator import Simulator
from sgns.states import Rollout
from sgns.train.command import train
from sgns.train.lightning_module import SurrogateTraining, TrainingSettings, prepared

log = logging.getLogger(__name__)


# --- What a surrogate is trained on, made smaller: fewer runs, fewer frames a second --------------------


def with_training_runs(dataset: Dataset, count: int | None, seed: int = 0) -> Dataset:
    """The dataset with some of its training runs; a smaller number's runs are among a larger one's.

    Args:
        dataset: With all its runs.
        count: Of training runs; None: all.
        seed: Of the order in which they are taken.

    Raises:
        UserError: It has fewer.
    """
    names = dataset.split["train"]
    if count is None:
        return dataset
    if not 1 <= count <= len(names):
        raise UserError(f"training_runs is {count}; {dataset.path} has {len(names)}: give 1 to {len(names)}")
    chosen = set(np.random.default_rng(seed).permutation(len(names))[:count].tolist())
    kept = [name for number, name in enumerate(names) if number in chosen]
    return replace(dataset, split=dataset.split | {"train": kept})


def every_nth_frame(reduced: ReducedDataset, n: int) -> ReducedDataset:
    """The dataset at 1/n of its frame rate: every nth frame, forces as means over the n frames that end there."""
    if n == 1:
        return reduced
    runs: Mapping[str, list[ReducedRun]] = {
        split: [_thinned(run, n) for run in reduced.runs(split)] for split in SPLITS
    }
    return replace(reduced, frame_rate=reduced.frame_rate / n, _runs=runs)


def _thinned(run: ReducedRun, n: int) -> ReducedRun:
    kept = {name: getattr(run, name)[::n] for name in ("latent", "time", "pose", "body_points")}
    return replace(run, **kept, force=frame_means(run.force, n), torque=frame_means(run.torque, n))


def frame_means(values: np.ndarray, n: int) -> np.ndarray:
    """Means over the n frames that end with every nth one.

    Args:
        values: Forces or torques, means over a recorded frame each, shape (T, 3).
        n: Frames in one of the result.

    Returns:
        Shape (1 + (T - 1) // n, 3); frame 0 has none before it and stays.
    """
    count = (len(values) - 1) // n
    return np.concatenate([values[:1], values[1 : 1 + count * n].reshape(count, n, 3).mean(axis=1)])


class EveryNthFrame:
    """A run at 1/n of its frame rate, as far as `sgns.evaluate.metrics` reads runs.

    Args:
        run: The `Run`.
        n: 1 leaves it as it is.
    """

    def __init__(self, run, n: int) -> None:
        self._run, self._frames = run, np.arange(run.frame_count)[::n]
        self.path: Path = run.path
        self.frame_count = len(self._frames)
        self.particle_count: int = run.particle_count
        self.arrangement_hash: str = run.arrangement_hash
        self.frame_rate: float = run.frame_rate / n
        self.wall_time_s: float = run.wall_time_s
        self.scene = run.scene
        self.time: np.ndarray = run.time[self._frames]
        self.pose: np.ndarray = run.pose[self._frames]
        self.body_points: np.ndarray = run.body_points[self._frames]
        self.force: np.ndarray = frame_means(run.force, n)
        self.torque: np.ndarray = frame_means(run.torque, n)

    def positions(self, frames: slice = slice(None)) -> np.ndarray:
        """Soil particles [m], shape (t, n, 3)."""
        return self._run.positions(self._frames[frames])


# --- Trainings that take a given processor time, whatever a step of theirs takes ------------------------

# Steps that are timed to find out how many fit, after as many that warm up.
PILOT_STEPS = 12
SHORTEST_STEP = 1e-6  # [s]; less no step takes
# How often the validation runs choose the best checkpoint.
VALIDATIONS = 4
_SCHEME = 1  # of what a folder of a training stands for


@dataclass(frozen=True)
class TimedTraining:
    """A complete training.

    Attributes:
        checkpoint: The best by the validation runs.
        processor_s: Processor time of the training, validation included [s].
        steps: Optimiser steps; 0 where there are none (polynomials).
        samples: Windows seen, all steps together; of polynomials those of the moments, noise drawn anew counted again.
    """

    checkpoint: Path
    processor_s: float
    steps: int
    samples: int


def train_for(
    seconds: float, reduced: ReducedDataset, settings: Mapping[str, Any], folder: Path, seed: int = 0
) -> TimedTraining:
    """Train on this thread for about so much processor time, or take what is complete.

    The steps of the optimiser are as many as fit, by the time of a few, and the learning rate falls over them, so that
    every training is a whole one. Polynomials are fitted, however long it takes.

    Args:
        seconds: Processor time of the steps; validation comes on top.
        reduced: The dataset in its basis.
        settings: `conf/train` as plain values.
        folder: Trainings are kept in, each in a folder named by what it depends on.
        seed: Of weights, noise and order.
    """
    model, training = settings["model"], settings["training"] | {"threads": 1, "resume": False}
    num_modes = reduced.num_modes
    output = folder / _key(seconds, reduced, model, training, seed)
    record = output / "timed.json"
    if record.exists():
        return read_record(record)
    torch.set_num_threads(1)
    frames = sum(len(run.latent) - 1 for run in reduced.runs("train"))
    checked = model_settings(model)
    if not isinstance(checked, ModelSettings):
        steps, samples = 0, frames * training["draws"]
    else:
        steps = max(VALIDATIONS, round(seconds / seconds_per_step(reduced, checked, training, seed)))
        training |= {
            "max_steps": steps,
            "validate_every": -(-steps // VALIDATIONS),
            "warmup_steps": min(training["warmup_steps"], steps // 10),
        }
        samples = steps * training["batch_size"]
    began = time.process_time()
    train(
        reduced,
        num_modes=num_modes,
        model=model,
        training=training,
        output=output,
        seed=seed,
        provenance={
            "preset": settings["preset"]["name"],
            "dataset": settings["dataset"]["name"],
            "seconds": seconds,
        },
    )
    done = TimedTraining(output / "best.ckpt", round(elapsed(began, time.process_time()), 1), steps, samples)
    write_whole(record, json.dumps({k: v for k, v in asdict(done).items() if k != "checkpoint"}) + "\n")
    return done


def read_record(record: Path) -> TimedTraining:
    """What `train_for` keeps beside a checkpoint.

    Raises:
        UserError: It is damaged.
    """
    advice = "remove it to train again"
    known = read_json(record, "not the record of a training", advice)
    kinds = {"processor_s": (int, float), "steps": int, "samples": int}
    if not isinstance(known, dict) or known.keys() != kinds.keys():
        raise UserError(f"{record} does not say {', '.join(kinds)}; {advice}")
    for key, kind in kinds.items():
        value = known[key]
        if not isinstance(value, kind) or isinstance(value, bool) or not 0 <= value < math.inf:
            raise UserError(f"{record}: {key} is {value!r:.40}, not a number of 0 or more; {advice}")
    return TimedTraining(record.with_name("best.ckpt"), **known)


def seconds_per_step(
    reduced: ReducedDataset, model: ModelSettings, training: Mapping[str, Any], seed: int
) -> float:
    """Processor time of an optimiser step with its batch, median of a few [s].

    Raises:
        UserError: the processor's clock stands still.
    """
    settings = TrainingSettings.from_dict(training)
    surrogate, data = prepared(reduced, reduced.num_modes, model, settings, seed, {}, None)
    module = SurrogateTraining(surrogate, settings)
    # Lightning logs only within a trainer, so the step is taken by hand; small, for nothing of it is kept.
    optimiser = torch.optim.AdamW(module.parameters(), lr=1e-6, fused=True)
    taken = []
    for step in range(2 * PILOT_STEPS):
        began = time.process_time()
        losses = module.losses(data.training_windows.batch(step, settings.batch_size, data.noise))
        optimiser.zero_grad()
        sum(settings.loss[name] * value for name, value in losses.items()).backward()
        torch.nn.utils.clip_grad_norm_(module.parameters(), 1.0)
        optimiser.step()
        taken.append(elapsed(began, time.process_time()))
    found = statistics.median(taken[PILOT_STEPS:])
    if found < SHORTEST_STEP:
        raise UserError(
            "the processor's clock stands still, so nobody knows how many steps a training may take; repeat the "
            "command when the machine runs undisturbed"
        )
    return found


def _key(
    seconds: float,
    reduced: ReducedDataset,
    model: Mapping[str, Any],
    training: Mapping[str, Any],
    seed: int,
) -> str:
    """Name of the folder of a training: of everything that its result depends on."""
    told = [
        _SCHEME,
        seconds,
        reduced.folder.name,
        reduced.num_modes,
        reduced.frame_rate,
        model,
        training,
        seed,
    ]
    return hashlib.blake2b(json.dumps(told, sort_keys=True).encode(), digest_size=8).hexdigest()


# --- A surrogate against the solver that made its training runs, on runs that it has not seen -----------


class Decoded:
    """A rollout as far as `sgns.evaluate.metrics` reads runs; frames are decoded when they are asked for.

    Args:
        simulator: Whose it is.
        rollout: Of T frames.
        name: For messages.
    """

    def __init__(self, simulator: Simulator, rollout: Rollout, name: str) -> None:
        self._basis, self._latent = simulator.basis, torch.as_tensor(rollout.latent)
        self.path = Path(f"rollout of {name}")
        self.frame_count = len(rollout.latent)
        self.particle_count = len(simulator.start_positions)
        self.arrangement_hash = simulator.arrangement_hash
        self.time: np.ndarray = np.arange(self.frame_count) / simulator.frame_rate
        self.pose, self.force, self.torque = rollout.poses, rollout.force, rollout.torque

    def positions(self, frames: slice = slice(None)) -> np.ndarray:
        """Soil particles [m], shape (t, n, 3)."""
        return self._basis.inverse(self._latent[frames]).numpy()


def own_errors(
    simulator: Simulator, paths: Sequence[Path], training_paths: Sequence[Path], every: int = 1
) -> Scores:
    """Scores over some runs together, each rolled out from its first d true frames, as `sgns evaluate` does it.

    Args:
        simulator: Trained at 1/every of the runs' frame rate.
        paths: Runs to be predicted.
        training_paths: Runs whose mean force is a baseline.
        every: Frames of the runs in one of the simulator's.
    """
    d = int(simulator.history)
    mean_force, mean_torque = training_means(training_paths, d)
    grid = surface_grid(np.asarray(simulator.start_positions, dtype=np.float64))
    found = []
    for path in paths:
        with Run(path) as run, single_thread():
            truth = EveryNthFrame(run, every)
            guess = Decoded(simulator, roll_out(simulator, truth), path.stem)
            errors = position_errors(truth, guess, simulator.basis, d, grid)
            body = body_errors(truth, guess, d)
            found.append(run_scores(path.stem, errors, truth, guess, d, mean_force, mean_torque, body))
    return aggregate(found)


# --- Operating points of surrogates: trained for a given time, rolled out from rest on the cases, timed -
# An entry of `study.scenes.<scene>.surrogate` has axis, label and overrides of `sgns train`, and these
# keys, which may
# also be given for all entries of a scene under `training`:
#
#     seconds          processor time of the training's steps [s]
#     runs             training runs, of which the basis is made, too; null: all
#     every            frames of the dataset in one of the surrogate's
#     seed             of weights, noise and order of the samples
#     table, case      an entry that was measured elsewhere: the line `case` of a table of experiments/full_space

REPEATS = 5  # timed rollouts of every case, after one that warms up
INCLUDES = (
    "all steps of the network with force and torque; not: loading the checkpoint, and (in a column of their own) "
    "decoding particles; nothing is read or written"
)
FULL_SPACE_INCLUDES = "processor time of all steps, as experiments/full_space measures it"


@dataclass(frozen=True)
class TrainingPlan:
    """Keys of an entry beside axis, label and overrides."""

    seconds: float = 60.0
    runs: int | None = None
    every: int = 1
    seed: int = 0

    @property
    def beyond_overrides(self) -> str:
        """What no override of `sgns train` says."""
        runs = "" if self.runs is None else f"trained on {self.runs} runs"
        frames = "" if self.every == 1 else f"one frame in {self.every}"
        return ", ".join(filter(None, (runs, frames)))

    @classmethod
    def of(cls, scene: StudyScene, entry: PointSettings) -> TrainingPlan:
        """The keys of an entry over those of its scene.

        Raises:
            UserError: A key is unknown, or its value makes no sense.
        """
        where = f"study.scenes.{scene.name}.surrogate, {entry.label!r}"
        values = dict(scene.settings.get("training") or {}) | dict(entry.more or {})
        known = [field.name for field in fields(cls)]
        if unknown := set(values) - set(known):
            allowed = ", ".join([*known, "table with case"])
            raise UserError(f"{where} has the unknown key {min(unknown)!r}; allowed: {allowed}")
        plan = cls(**values)
        if not _number(plan.seconds) or plan.seconds <= 0:
            raise UserError(f"{where}: seconds is {plan.seconds!r}; it must be a number above 0")
        for key, low in (("runs", 1), ("every", 1), ("seed", 0)):
            value = getattr(plan, key)
            if value is None and key == "runs":
                continue
            if not isinstance(value, int) or isinstance(value, bool) or value < low:
                raise UserError(f"{where}: {key} is {value!r}; it must be a whole number, at least {low}")
        return plan


def _number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def measure_surrogates(study: Study) -> None:
    """Measure the surrogates of a study that are not there yet, in their order."""
    with one_core(last=True):
        workload: Workload | None = None
        for scene in study.scenes:
            for entry in scene.points("surrogate"):
                if "table" in (entry.more or {}):
                    measure_elsewhere(study, scene, entry)
                    continue
                plan = TrainingPlan.of(scene, entry)
                file = study.store.file(scene.name, "surrogate", entry.label)
                with claimed(file) as ours:
                    if not ours or file.exists():
                        continue
                    workload = workload or Workload()
                    began = time.perf_counter()
                    study.store.save(*measured(study, scene, entry, plan, workload))
                    took = elapsed(began, time.perf_counter())
                    log.info("%s, surrogate: %s (%.0f s)", scene.name, entry.label, took)


def measured(
    study: Study, scene: StudyScene, entry: PointSettings, plan: TrainingPlan, workload: Workload
) -> tuple[Point, dict[str, Observation]]:
    """A point and its rollouts; no rollouts where one of them left the range of numbers."""
    settings = training_settings(scene.dataset, entry.set)
    whole = Dataset.open(settings["dataset"]["path"])
    dataset = with_training_runs(whole, plan.runs)
    reduced = reduce_dataset(dataset, settings["reduction"], progress=False)
    require_same_bed(scene, reduced.arrangement_hash)
    done = train_for(
        plan.seconds, every_nth_frame(reduced, plan.every), settings, study.folder / "trainings", plan.seed
    )
    simulator = Simulator.load(done.checkpoint)
    before = workload.measure()
    costs, rollouts = timed_rollouts(simulator, scene)
    costs |= cost_fields(costs.pop("rates"), [*before, *workload.measure()], costs.pop("processor_rate"))
    scores = own_errors(simulator, whole.runs("test"), dataset.runs("train"), plan.every)
    point = described(study, scene, entry, plan, done, simulator)
    own = own_fields(scores, len(whole.runs("test")))
    point = replace(point, training_runs=float(len(dataset.runs("train"))), **own, **costs)
    observations = {}
    for case, (case_scene, rollout) in rollouts.items():
        if (good := finite_frames(rollout)) < len(rollout.latent):
            notes = (point.note, f"{case}: not finite from frame {good} on")
            return replace(point, note="; ".join(filter(None, notes))), {}
        observations[case] = observed(simulator, case_scene, rollout)
    return point, observations


def require_same_bed(scene: StudyScene, arrangement: str) -> None:
    """Refuses cases whose particles are not those of the dataset."""
    for case in scene.cases:
        if scene.case_scene(case).arrangement_hash != arrangement:
            raise UserError(
                f"study.scenes.{scene.name}.cases.{case} has another bed of particles than dataset={scene.dataset}, "
                "so that no surrogate of it can be judged there; use the dataset's scene and bed"
            )


def training_settings(dataset: str, overrides: tuple[str, ...]) -> dict[str, Any]:
    """`conf/train` with overrides, as plain values."""
    asked = [f"dataset={dataset}", "output=.", *overrides]
    if GlobalHydra.instance().is_initialized():
        config = compose("train", asked)
    else:
        with initialize_config_module("sgns.conf", version_base="1.3"):
            config = compose("train", asked)
    plain = OmegaConf.to_container(config, resolve=True)
    assert isinstance(plain, dict)
    return plain


def described(
    study: Study,
    scene: StudyScene,
    entry: PointSettings,
    plan: TrainingPlan,
    done: TimedTraining,
    simulator: Simulator,
) -> Point:
    """What a point says of itself before anything is measured."""
    return Point(
        study=study.name,
        scene=scene.name,
        kind="surrogate",
        axis=entry.axis,
        label=entry.label,
        settings=shlex.join([f"dataset={scene.dataset}", *entry.set, *other_overrides(plan, done)]),
        paper=entry.paper,
        particles=float(len(simulator.start_positions)),
        modes=float(simulator.num_modes),
        parameters=float(network_costs(done.checkpoint, simulator.card).parameters),
        training_s=done.processor_s,
        training_samples=float(done.samples),
        note=plan.beyond_overrides,
        includes=INCLUDES,
        **made_here(),
    )


def other_overrides(plan: TrainingPlan, done: TimedTraining) -> list[str]:
    """The steps that fitted, and the seed, for who wants to train the same."""
    steps = [f"training.max_steps={done.steps}"] if done.steps else []
    return [*steps, *([f"seed={plan.seed}"] if plan.seed else [])]


def timed_rollouts(
    simulator: Simulator, scene: StudyScene
) -> tuple[dict[str, Any], dict[str, tuple[Scene, Rollout]]]:
    """Every case from rest, several times.

    Returns:
        Rates (mean over the cases of each repeat, wall seconds per simulated second), the processor's, and the wall's
        with all frames decoded; the rollouts.
    """
    rates, processor, decoded = [], [], []
    scenes = {case: case_scene(scene, case, simulator.frame_rate) for case in scene.cases}
    paths = {case: (s.body_poses(), s.body_points(), s.to_dict()) for case, s in scenes.items()}
    rollouts: dict[str, tuple[Scene, Rollout]] = {}
    for repeat in range(REPEATS + 1):
        walls, clocks, decodings = [], [], []
        for case, (poses, points, values) in paths.items():
            simulated = (len(poses) - 1) / simulator.frame_rate
            clock = time.process_time()
            rollout = simulator.rollout(poses, points, values=values)
            clocks.append(elapsed(clock, time.process_time()) / simulated)
            walls.append(rollout.wall_time_s / simulated)
            began = time.perf_counter()
            for latent in torch.as_tensor(rollout.latent):
                simulator.basis.inverse(latent)
            decodings.append(walls[-1] + elapsed(began, time.perf_counter()) / simulated)
            rollouts[case] = (scenes[case], rollout)
        if repeat:
            for series, values_ in ((rates, walls), (processor, clocks), (decoded, decodings)):
                series.append(float(np.mean(values_)))
    found = {
        "rates": rates,
        "processor_rate": statistics.median(processor),
        "decoded_wall_s_per_simulated_s": statistics.median(decoded),
    }
    return found, rollouts


def case_scene(scene: StudyScene, case: str, frame_rate: float) -> Scene:
    """The scene of a case at a surrogate's frame rate."""
    return composed_scene([*scene.cases[case], f"scene.frame_rate={frame_rate}"])[0]


def observed(simulator: Simulator, scene: Scene, rollout: Rollout) -> Observation:
    """What is kept of a rollout."""
    times = np.arange(len(rollout.latent)) / simulator.frame_rate
    frames = observed_frames(len(times), simulator.frame_rate)
    soil = (simulator.basis.inverse(torch.as_tensor(rollout.latent[frame])).numpy() for frame in frames)
    bed, forces = simulator.start_positions, (rollout.force, rollout.torque)
    return observe_arrays(scene, bed, times, *forces, rollout.poses, frames, soil)


def own_fields(scores: Scores, runs: int) -> dict[str, float]:
    """The columns of errors against the solver that made the training runs."""
    return {
        "own_runs": float(runs),
        "own_force_nrmse": scores.force.overall_nrmse,
        "own_draft_mean_error": float(scores.force.mpe[0]) / 100.0,
        "own_position_rmse_mm": scores.rmse_mm("total"),
        "own_surface_rmse_mm": scores.rmse_mm("surface"),
        "own_sinkage_error_mm": 1e3 * scores.sinkage_mae,
        "frozen_rmse_mm": scores.rmse_mm("frozen"),
        "skill_frozen": scores.skill("frozen"),
        "skill_constant_velocity": scores.skill("constant_velocity"),
        "mean_force_nrmse": scores.mean_force.overall_nrmse,
    }


# --- measured elsewhere -----------------------------------------------------------------------------------


def measure_elsewhere(study: Study, scene: StudyScene, entry: PointSettings) -> None:
    """Take a line of a table of experiments/full_space, anew each time; nothing where the table is not there."""
    more = dict(entry.more or {})
    file, case = Path(str(more["table"])), str(more.get("case"))
    if not file.exists():
        log.info("%s: %s is left out, there is no %s here", scene.name, entry.label, file)
        return
    table = read_table(file, "no table of trainings", "make it: experiments/full_space/run.py")
    rows = {row.get("case", ""): row for row in table}
    if case not in rows:
        raise UserError(f"{file} has no case {case!r}; there are: {'; '.join(rows)}")
    try:
        columns = full_space_fields(rows[case])
    except ValueError as error:
        raise UserError(f"{file}: {case!r} has a column that is no number ({error})") from None
    point = Point(
        study=study.name,
        scene=scene.name,
        kind="full space",
        axis=entry.axis,
        label=entry.label,
        includes=FULL_SPACE_INCLUDES,
        note=f"{case!r} of {file.as_posix()}",
        **columns,
    )
    study.store.save(point, {})


def full_space_fields(row: Mapping[str, str]) -> dict[str, float]:
    """Columns of a point from a line of experiments/full_space/table.csv; what it lacks is not known."""

    def value(key: str) -> float:
        return float(row.get(key) or math.nan)

    return {
        "wall_s_per_simulated_s": value("rollout_s_per_simulated_s"),
        "processor_s_per_simulated_s": value("rollout_s_per_simulated_s"),
        "decoded_wall_s_per_simulated_s": value("rollout_s_per_simulated_s"),
        "repeats": value("repeats"),
        "parameters": value("parameters"),
        "threads": 1.0,
        "own_runs": value("test_runs"),
        "own_force_nrmse": value("force_nrmse"),
        "own_position_rmse_mm": value("position_rmse_mm"),
        "frozen_rmse_mm": value("frozen_rmse_mm"),
        "skill_frozen": value("skill_frozen"),
        "skill_constant_velocity": value("skill_constant_velocity"),
        "mean_force_nrmse": value("mean_force_nrmse"),
        "training_s": value("trained_processor_s"),
        "training_samples": value("trained_steps"),  # one window a step
    }
