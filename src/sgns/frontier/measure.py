"""Measure the points of a study that are missing: of the solver, of reductions and of surrogates."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import shlex
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import OmegaConf

from mpm_warp import Scene, Solver, SolverStopped
from sgns.config import UserError
from sgns.data.dataset import SPLITS, Dataset
from sgns.data.files import file_lock, read_json, read_table, write_whole
from sgns.data.run import Run
from sgns.evaluate.command import roll_out, training_means
from sgns.evaluate.costs import network_costs
from sgns.evaluate.metrics import body_errors, position_errors, surface_grid
from sgns.evaluate.results import Scores, aggregate, run_scores
from sgns.frontier.observation import Observation, Observer, observe_arrays, observed_frames
from sgns.frontier.point import Point
from sgns.frontier.study import (
    PointSettings,
    Study,
    StudyScene,
    Workload,
    composed,
    composed_scene,
    cost_fields,
    made_here,
    one_core,
    stopwatch,
)
from sgns.model.settings import ModelSettings, model_settings
from sgns.numbers import elapsed, is_whole
from sgns.reduction.basis import CENTRINGS, Basis, reconstruction_curve
from sgns.reduction.reduce import ReducedDataset, ReducedRun, fit_runs, reduce_dataset
from sgns.rollout import finite_frames, single_thread
from sgns.simulate.scene import asked_effects, decided
from sgns.simulator import Simulator
from sgns.states import Rollout
from sgns.train.command import train
from sgns.train.lightning_module import SurrogateTraining, TrainingSettings, prepared

log = logging.getLogger(__name__)

STRETCHES = 3  # of each run of the solver, each timed for itself
REPEATS = 5  # timed rollouts of every case, or passes of encoding, after one that warms up
CODED_FRAMES = 16  # of one pass of encoding and decoding
INCLUDES = {
    "solver": "all substeps of the recorded frames; not: compiling kernels, set-up, writing files",
    "reduction": "encoding and decoding every frame; not: reading the frames, fitting the basis",
    "surrogate": "all steps of the network with force and torque; not: loading the checkpoint, and (in a column of "
    "their own) decoding particles; nothing is read or written",
    "full space": "processor time of all steps, as experiments/full_space measures it",
}
Measured = tuple[Point, Mapping[str, Observation]]


def new_point(study: Study, scene: StudyScene, kind: str, entry: PointSettings, **columns: Any) -> Point:
    """What a point says of itself before anything is measured."""
    columns |= {"axis": entry.axis, "label": entry.label, "paper": entry.paper, "includes": INCLUDES[kind]}
    return Point(study=study.name, scene=scene.name, kind=kind, **columns)


def measure_if_missing(
    measure: Callable[..., Measured],
    study: Study,
    scene: StudyScene,
    kind: str,
    entry: PointSettings,
    *more: Any,
) -> None:
    """Measure and keep a point that is not there and that no other process is at."""
    file = study.store.file(scene.name, kind, entry.label)
    with file_lock(file) as ours:
        if ours and not file.exists():
            watch = stopwatch()
            study.store.save(*measure(study, scene, entry, *more))
            log.info("%s, %s: %s (%.0f s)", scene.name, kind, entry.label, watch()[0])


# --- Solver: the cases of a scene with changed settings -------------------------------------------------


def measure_solver(study: Study) -> None:
    """The solver's points, the reference of every scene first."""
    workload = Workload()
    with one_core():
        for scene in study.scenes:
            for entry in (scene.reference, *scene.points("solver")):
                measure_if_missing(solver_point, study, scene, "solver", entry, workload)


def solver_point(study: Study, scene: StudyScene, entry: PointSettings, workload: Workload) -> Measured:
    """A point and the runs of its cases; no runs where the solver had to stop."""
    settings = shlex.join([f"scene={scene.settings['scene']}", *entry.set])
    point = new_point(study, scene, "solver", entry, settings=settings, **made_here())
    before = workload.measure()
    rates, processor, observations = [], [], {}
    try:
        for case, overrides in scene.cases.items():
            observations[case], of_stretches, of_processor, particles = timed_run([*overrides, *entry.set])
            rates.append(of_stretches)
            processor.append(of_processor)
            point = replace(point, particles=float(particles))
    except SolverStopped as stop:
        return replace(point, note=f"stopped: {' '.join(str(stop).split())}"), {}
    # One rate for each stretch: the mean over the cases.
    mean_rates = list(np.mean(rates, axis=0))
    costs = cost_fields(mean_rates, [*before, *workload.measure()], float(np.mean(processor)))
    return replace(point, **costs), observations


def timed_run(overrides: list[str]) -> tuple[Observation, list[float], float, int]:
    """One case.

    Returns:
        The run; wall seconds per simulated second of each stretch; processor seconds per simulated second; n.
    """
    scene, cfg = composed_scene(overrides)
    solver = Solver(scene, decided(scene, asked_effects(cfg))[0], precision=cfg.solver.precision)
    observer = Observer(scene, scene.initial_positions())
    wanted = set(observed_frames(scene.frame_count, scene.frame_rate).tolist())
    times = []
    # The clocks run while the solver computes and stand while its frames are looked at. Frame 0 loads the kernels.
    frames = solver.frames()
    for _ in range(scene.frame_count):
        watch = stopwatch()
        frame = next(frames)
        times.append(watch())
        observer.add(frame.time, frame.force, frame.torque, frame.body_pose)
        if frame.index in wanted:
            observer.add_soil(frame.time, frame.position)
    wall, processor = scene.frame_rate * np.array(times[1:]).T
    stretches = [float(part.mean()) for part in np.array_split(wall, STRETCHES)]
    return observer.finish(), stretches, float(processor.mean()), solver.particle_count


# --- Reductions: what r modes leave out of runs that the basis has not seen, and what coding costs ------
# An entry of `study.scenes.<scene>.reduction` has axis, label, `modes` (a list of r) and `centring`, and makes
# one point for each r. One stream over the dataset's training runs serves all entries; held out are its other
# runs.


def reduction_points(scene: StudyScene) -> Iterator[PointSettings]:
    """All points of a scene's entries, with `centring` and one number of `modes` each.

    Raises:
        UserError: An entry lacks its keys, or they make no sense.
    """
    for entry in scene.points("reduction"):
        where = f"study.scenes.{scene.name}.reduction, {entry.label!r}"
        centring, modes = (entry.more.get(key) for key in ("centring", "modes"))
        if centring not in CENTRINGS:
            raise UserError(f"{where}: centring is {centring!r}; allowed: {', '.join(CENTRINGS)}")
        if not isinstance(modes, list) or not all(type(r) is int and r >= 1 for r in modes):
            raise UserError(f"{where}: modes is {modes!r}; it must be a list of whole numbers, 1 or more")
        for r in modes:
            yield replace(entry, label=f"{entry.label}, r {r}", more={"centring": centring, "modes": r})


def measure_reduction(study: Study) -> None:
    """The reduction points; one process makes all of a scene's, which share the stream over the runs."""
    with one_core(last=True):
        for scene in study.scenes:
            missing = [
                p for p in reduction_points(scene) if not study.store.has(scene.name, "reduction", p.label)
            ]
            if missing:
                with file_lock(study.store.file(scene.name, "reduction", "all")) as ours:
                    if ours:
                        measure_reductions_of(study, scene, missing)


def measure_reductions_of(study: Study, scene: StudyScene, missing: list[PointSettings]) -> None:
    """Fit, measure and keep."""
    watch = stopwatch()
    dataset = Dataset.open(training_settings(scene.dataset, ())["dataset"]["path"])
    training, held_out = dataset.runs("train"), [*dataset.runs("validation"), *dataset.runs("test")]
    pca = fit_runs(training, max(p.more["modes"] for p in missing))
    log.info("%s, reduction: fitted on %d runs (%.0f s)", scene.name, len(training), watch()[0])
    # Mean square [m²] about each particle's mean place: what the energy is a share of, for every centring.
    motion = float(reconstruction_curve(held_out, pca.basis("particle_axis", 1))[0])
    workload = Workload()
    for centring in dict.fromkeys(p.more["centring"] for p in missing):
        basis = pca.basis(centring, pca.rank(centring))
        asked = [p for p in missing if p.more["centring"] == centring]
        found = [p for p in asked if p.more["modes"] <= basis.num_modes]
        curve = reconstruction_curve(held_out, basis)
        before = workload.measure()
        times = [coding_times(basis.sliced(p.more["modes"]), held_out[0]) for p in found]
        speed = [*before, *workload.measure()]
        for p, (wall, processor, decoding) in zip(found, times, strict=True):
            r = p.more["modes"]
            mse = float(curve[r])
            changes = [f"reduction.centring={centring}", f"reduction.num_modes={r}"]
            if r > 64:  # kept by default
                changes.append(f"reduction.max_modes={r}")
            point = new_point(
                study,
                scene,
                "reduction",
                p,
                settings=shlex.join([f"dataset={scene.dataset}", *changes]),
                modes=float(r),
                particles=float(len(basis.modes)),
                own_runs=float(len(held_out)),
                own_position_rmse_mm=1e3 * mse**0.5,
                frozen_rmse_mm=1e3 * motion**0.5,
                energy=1.0 - mse / motion,
                training_runs=float(len(training)),
                decoded_wall_s_per_simulated_s=statistics.median(decoding),
                **cost_fields(wall, speed, statistics.median(processor)),
                **made_here(),
            )
            study.store.save(point, {})
        if beyond := [p.more["modes"] for p in asked if p not in found]:
            log.info("%s: r %s left out, the data has %d modes", scene.name, beyond, basis.num_modes)
    log.info("%s, reduction: %d points (%.0f s)", scene.name, len(missing), watch()[0])


def coding_times(basis: Basis, path: Path) -> np.ndarray:
    """Times of the first frames of a run, a frame at a time.

    Returns:
        Wall time of encoding and decoding, processor time of both, and wall time of decoding alone, of each pass
        [s per simulated s], shape (3, passes).
    """
    with Run(path) as run:
        positions, rate = torch.from_numpy(run.positions(slice(0, CODED_FRAMES))), run.frame_rate
    times = []
    for _ in range(REPEATS + 1):
        watch = stopwatch()
        coded = [basis.transform(frame) for frame in positions]
        decoding = stopwatch()
        for latent in coded:
            basis.inverse(latent)
        times.append([*watch(), decoding()[0]])
    return np.array(times[1:]).T * rate / len(positions)


# --- What a surrogate is trained on, made smaller: fewer runs, fewer frames a second --------------------


def with_training_runs(dataset: Dataset, count: int | None, seed: int = 0) -> Dataset:
    """The dataset with so many of its training runs (None: all); a smaller number's runs are among a larger one's.

    Raises:
        UserError: It has fewer.
    """
    names = dataset.split["train"]
    if count is None:
        return dataset
    if not 1 <= count <= len(names):
        raise UserError(f"training_runs is {count}; {dataset.path} has {len(names)}: give 1 to {len(names)}")
    kept = sorted(np.random.default_rng(seed).permutation(len(names))[:count])
    return replace(dataset, split=dataset.split | {"train": [names[number] for number in kept]})


def every_nth_frame(reduced: ReducedDataset, n: int) -> ReducedDataset:
    """The dataset at 1/n of its frame rate: every nth frame, forces as means over the n frames that end there."""

    def thinned(run: ReducedRun) -> ReducedRun:
        kept = {name: getattr(run, name)[::n] for name in ("latent", "time", "pose", "body_points")}
        return replace(run, **kept, force=frame_means(run.force, n), torque=frame_means(run.torque, n))

    if n == 1:
        return reduced
    runs = {split: [thinned(run) for run in reduced.runs(split)] for split in SPLITS}
    return replace(reduced, frame_rate=reduced.frame_rate / n, _runs=runs)


def frame_means(values: np.ndarray, n: int) -> np.ndarray:
    """Means over the n frames that end with every nth one, of forces or torques (T, 3), shape (1 + (T - 1) // n, 3).

    Those are means over a recorded frame each; frame 0 has none before it and stays.
    """
    count = (len(values) - 1) // n
    return np.concatenate([values[:1], values[1 : 1 + count * n].reshape(count, n, 3).mean(axis=1)])


class EveryNthFrame:
    """A `Run` at 1/n of its frame rate, as far as `sgns.evaluate.metrics` reads runs."""

    def __init__(self, run: Run, n: int) -> None:
        self._run, self._frames = run, np.arange(run.frame_count)[::n]
        self.path, self.scene, self.particle_count = run.path, run.scene, run.particle_count
        self.arrangement_hash, self.wall_time_s = run.arrangement_hash, run.wall_time_s
        self.frame_count, self.frame_rate = len(self._frames), run.frame_rate / n
        self.time, self.pose, self.body_points = (
            series[self._frames] for series in (run.time, run.pose, run.body_points)
        )
        self.force, self.torque = frame_means(run.force, n), frame_means(run.torque, n)

    def positions(self, frames: slice = slice(None)) -> np.ndarray:
        """Soil particles [m], shape (t, n, 3)."""
        return self._run.positions(self._frames[frames])


# --- Trainings that take a given processor time, whatever a step of theirs takes ------------------------

PILOT_STEPS = 12  # that are timed to find out how many fit, after as many that warm up
SHORTEST_STEP = 1e-6  # [s]; less no step takes
VALIDATIONS = 4  # how often the validation runs choose the best checkpoint
TRAINING_FORMAT = 1  # of what a folder of a training stands for


@dataclass(frozen=True)
class TimedTraining:
    """A complete training."""

    checkpoint: Path  # The best by the validation runs
    processor_s: float  # Processor time of the training, validation included [s]
    steps: int  # Optimiser steps; 0 where there are none (polynomials)
    # Windows seen, all steps together; of polynomials those of the moments, noise drawn anew counted again
    samples: int


def train_for(
    seconds: float, reduced: ReducedDataset, settings: Mapping[str, Any], folder: Path, seed: int = 0
) -> TimedTraining:
    """Train on this thread for about so much processor time, validation on top, or take what is complete.

    The steps of the optimiser are as many as fit, by the time of a few, and the learning rate falls over them, so that
    every training is a whole one. Polynomials are fitted, however long it takes. `settings` are those of `conf/train`;
    trainings are kept in `folder`, each in a folder named by what it depends on.
    """
    model, training = settings["model"], settings["training"] | {"threads": 1, "resume": False}
    # The folder's name is made of everything that the result depends on.
    basis = (reduced.folder.name, reduced.num_modes, reduced.frame_rate)
    identity = json.dumps([TRAINING_FORMAT, seconds, *basis, model, training, seed], sort_keys=True)
    output = folder / hashlib.blake2b(identity.encode(), digest_size=8).hexdigest()
    record = output / "timed.json"
    if record.exists():
        return read_record(record)
    torch.set_num_threads(1)
    checked = model_settings(model)
    if isinstance(checked, ModelSettings):
        steps = max(VALIDATIONS, round(seconds / seconds_per_step(reduced, checked, training, seed)))
        training |= {
            "max_steps": steps,
            "validate_every": -(-steps // VALIDATIONS),
            "warmup_steps": min(training["warmup_steps"], steps // 10),
        }
        samples = steps * training["batch_size"]
    else:
        steps = 0
        samples = sum(len(run.latent) - 1 for run in reduced.runs("train")) * training["draws"]
    began = time.process_time()
    names = {key: settings[key]["name"] for key in ("preset", "dataset")}
    train(
        reduced,
        num_modes=reduced.num_modes,
        model=model,
        training=training,
        output=output,
        seed=seed,
        provenance=names | {"seconds": seconds},
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
    types = {"processor_s": (int, float), "steps": int, "samples": int}
    if not isinstance(known, dict) or known.keys() != types.keys():
        raise UserError(f"{record} does not say {', '.join(types)}; {advice}")
    for key, allowed in types.items():
        value = known[key]
        if not isinstance(value, allowed) or isinstance(value, bool) or not 0 <= value < math.inf:
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
    times = []
    for step in range(2 * PILOT_STEPS):
        watch = stopwatch()
        losses = module.losses(data.training_windows.batch(step, settings.batch_size, data.noise))
        optimiser.zero_grad()
        sum(settings.loss[name] * value for name, value in losses.items()).backward()
        torch.nn.utils.clip_grad_norm_(module.parameters(), 1.0)
        optimiser.step()
        times.append(watch()[1])
    found = statistics.median(times[PILOT_STEPS:])
    if found < SHORTEST_STEP:
        raise UserError(
            "the processor's clock stands still, so nobody knows how many steps a training may take; repeat the "
            "command when the machine runs undisturbed"
        )
    return found


# --- A surrogate against the solver that made its training runs, on runs that it has not seen -----------


class DecodedRollout:
    """A rollout as far as `sgns.evaluate.metrics` reads runs; frames are decoded when they are asked for."""

    def __init__(self, simulator: Simulator, rollout: Rollout, name: str) -> None:
        self._basis, self._latent = simulator.basis, torch.as_tensor(rollout.latent)
        self.path = Path(f"rollout of {name}")
        self.frame_count, self.particle_count = len(rollout.latent), len(simulator.start_positions)
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

    `every` frames of the runs are one of the simulator's; the mean force of the training runs is a baseline.
    """
    d = int(simulator.history)
    means = training_means(training_paths, d)
    grid = surface_grid(np.asarray(simulator.start_positions, dtype=np.float64))
    found = []
    for path in paths:
        with Run(path) as run, single_thread():
            truth = EveryNthFrame(run, every)
            prediction = DecodedRollout(simulator, roll_out(simulator, truth), path.stem)
            errors = position_errors(truth, prediction, simulator.basis, d, grid)
            body = body_errors(truth, prediction, d)
            found.append(run_scores(path.stem, errors, truth, prediction, d, *means, body))
    return aggregate(found)


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


# --- Surrogates: trained for a given time, rolled out from rest on the cases, timed ---------------------


@dataclass(frozen=True)
class TrainingPlan:
    """Keys of an entry of `study.scenes.<scene>.surrogate` beside axis, label and overrides of `sgns train`.

    They may also be given for all entries of a scene under `training`. An entry that was measured elsewhere has `table`
    and `case` instead: the line `case` of a table of experiments/full_space.
    """

    seconds: float = 60.0  # processor time of the training's steps [s]
    runs: int | None = None  # training runs, of which the basis is made, too; None: all
    every: int = 1  # frames of the dataset in one of the surrogate's
    seed: int = 0  # of weights, noise and order of the samples

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
        values = dict(scene.settings.get("training") or {}) | entry.more
        known = [field.name for field in fields(cls)]
        if unknown := set(values) - set(known):
            allowed = ", ".join([*known, "table with case"])
            raise UserError(f"{where} has the unknown key {min(unknown)!r}; allowed: {allowed}")
        plan = cls(**values)
        number = isinstance(plan.seconds, (int, float)) and not isinstance(plan.seconds, bool)
        if not (number and 0 < plan.seconds < math.inf):
            raise UserError(f"{where}: seconds is {plan.seconds!r}; it must be a number above 0")
        for key, low in (("runs", 1), ("every", 1), ("seed", 0)):
            value = getattr(plan, key)
            if not (is_whole(value) and value >= low) and not (value is None and key == "runs"):
                raise UserError(f"{where}: {key} is {value!r}; it must be a whole number, at least {low}")
        return plan


def measure_surrogates(study: Study) -> None:
    """The surrogates, in their order."""
    workload = Workload()
    with one_core(last=True):
        for scene in study.scenes:
            for entry in scene.points("surrogate"):
                if "table" in entry.more:
                    measure_elsewhere(study, scene, entry)
                    continue
                plan = TrainingPlan.of(scene, entry)
                measure_if_missing(surrogate_point, study, scene, "surrogate", entry, plan, workload)


def surrogate_point(
    study: Study, scene: StudyScene, entry: PointSettings, plan: TrainingPlan, workload: Workload
) -> Measured:
    """A point and its rollouts; no rollouts where one of them left the range of numbers."""
    settings = training_settings(scene.dataset, entry.set)
    whole = Dataset.open(settings["dataset"]["path"])
    dataset = with_training_runs(whole, plan.runs)
    reduced = reduce_dataset(dataset, settings["reduction"], progress=False)
    for case in scene.cases:
        if scene.case_scene(case).arrangement_hash != reduced.arrangement_hash:
            raise UserError(
                f"study.scenes.{scene.name}.cases.{case} has another bed of particles than dataset={scene.dataset}, "
                "so that no surrogate of it can be judged there; use the dataset's scene and bed"
            )
    reduced = every_nth_frame(reduced, plan.every)
    done = train_for(plan.seconds, reduced, settings, study.folder / "trainings", plan.seed)
    simulator = Simulator.load(done.checkpoint)
    before = workload.measure()
    rates, processor, decoded, rollouts = timed_rollouts(simulator, scene)
    costs = cost_fields(rates, [*before, *workload.measure()], processor)
    scores = own_errors(simulator, whole.runs("test"), dataset.runs("train"), plan.every)
    # The steps that fitted, and the seed, for who wants to train the same.
    others = [f"training.max_steps={done.steps}"] * bool(done.steps) + [f"seed={plan.seed}"] * bool(plan.seed)
    point = new_point(
        study,
        scene,
        "surrogate",
        entry,
        settings=shlex.join([f"dataset={scene.dataset}", *entry.set, *others]),
        particles=float(len(simulator.start_positions)),
        modes=float(simulator.num_modes),
        parameters=float(network_costs(done.checkpoint, simulator.card).parameters),
        training_s=done.processor_s,
        training_samples=float(done.samples),
        training_runs=float(len(dataset.runs("train"))),
        note=plan.beyond_overrides,
        decoded_wall_s_per_simulated_s=decoded,
        **own_fields(scores, len(whole.runs("test"))),
        **costs,
        **made_here(),
    )
    observations = {}
    for case, (case_scene, rollout) in rollouts.items():
        if (good := finite_frames(rollout)) < len(rollout.latent):
            notes = (point.note, f"{case}: not finite from frame {good} on")
            return replace(point, note="; ".join(filter(None, notes))), {}
        observations[case] = observed(simulator, case_scene, rollout)
    return point, observations


def training_settings(dataset: str, overrides: tuple[str, ...]) -> dict[str, Any]:
    """`conf/train` with overrides, as plain values."""
    config = composed("train", [f"dataset={dataset}", "output=.", *overrides])
    return OmegaConf.to_container(config, resolve=True)


def timed_rollouts(
    simulator: Simulator, scene: StudyScene
) -> tuple[list[float], float, float, dict[str, tuple[Scene, Rollout]]]:
    """Every case from rest, several times.

    Returns:
        Wall seconds per simulated second of each repeat (mean over the cases); medians of the processor's, and of the
        wall's with all frames decoded; the rollouts.
    """
    scenes = {
        case: composed_scene([*changes, f"scene.frame_rate={simulator.frame_rate}"])[0]
        for case, changes in scene.cases.items()
    }
    paths = {case: (s.body_poses(), s.body_points(), s.to_dict()) for case, s in scenes.items()}
    rollouts: dict[str, tuple[Scene, Rollout]] = {}
    times = []  # of every repeat, case: stepping, processor, with decoding
    for _ in range(REPEATS + 1):
        times.append([])
        for case, (poses, points, values) in paths.items():
            watch = stopwatch()
            rollout = simulator.rollout(poses, points, values=values)
            processor = watch()[1]
            watch = stopwatch()
            for latent in torch.as_tensor(rollout.latent):
                simulator.basis.inverse(latent)
            seconds = np.array([rollout.wall_time_s, processor, rollout.wall_time_s + watch()[0]])
            times[-1].append(seconds * simulator.frame_rate / (len(poses) - 1))
            rollouts[case] = (scenes[case], rollout)
    rates, processor_rates, decoded = np.mean(times[1:], axis=1).T
    return rates.tolist(), float(np.median(processor_rates)), float(np.median(decoded)), rollouts


def observed(simulator: Simulator, scene: Scene, rollout: Rollout) -> Observation:
    """What is kept of a rollout."""
    times = np.arange(len(rollout.latent)) / simulator.frame_rate
    frames = observed_frames(len(times), simulator.frame_rate)
    soil = (simulator.basis.inverse(torch.as_tensor(rollout.latent[frame])).numpy() for frame in frames)
    bed, forces = simulator.start_positions, (rollout.force, rollout.torque)
    return observe_arrays(scene, bed, times, *forces, rollout.poses, frames, soil)


# --- Measured elsewhere: lines of a table of experiments/full_space -------------------------------------

FULL_SPACE_COLUMNS = {  # of a point → of the table
    "wall_s_per_simulated_s": "rollout_s_per_simulated_s",
    "processor_s_per_simulated_s": "rollout_s_per_simulated_s",
    "decoded_wall_s_per_simulated_s": "rollout_s_per_simulated_s",
    "own_runs": "test_runs",
    "own_force_nrmse": "force_nrmse",
    "own_position_rmse_mm": "position_rmse_mm",
    "training_s": "trained_processor_s",
    "training_samples": "trained_steps",  # one window a step
} | {
    name: name
    for name in (
        "repeats",
        "parameters",
        "frozen_rmse_mm",
        "skill_frozen",
        "skill_constant_velocity",
        "mean_force_nrmse",
    )
}


def measure_elsewhere(study: Study, scene: StudyScene, entry: PointSettings) -> None:
    """Take a line of a table of experiments/full_space, anew each time; nothing where the table is not there."""
    file, case = Path(str(entry.more["table"])), str(entry.more.get("case"))
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
    note = f"{case!r} of {file.as_posix()}"
    study.store.save(new_point(study, scene, "full space", entry, note=note, **columns), {})


def full_space_fields(row: Mapping[str, str]) -> dict[str, float]:
    """Columns of a point from a line of the table; what it lacks is not known."""
    found = {name: float(row.get(column) or math.nan) for name, column in FULL_SPACE_COLUMNS.items()}
    return found | {"threads": 1.0}
