"""Measure the points of a study that are missing: of the solver, of reductions and of surrogates."""

from __future__ import annotations

import logging
import shlex
import statistics
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf

from mpm_warp import Scene, Solver, SolverStopped
from sgns.config import UserError
from sgns.data.dataset import Dataset
from sgns.data.files import file_lock
from sgns.data.run import Run
from sgns.data.surface import surface_grid
from sgns.evaluate.command import training_means
from sgns.evaluate.costs import network_costs, roll_out
from sgns.evaluate.metrics import body_errors, position_errors
from sgns.evaluate.results import Scores, aggregate, run_scores
from sgns.frontier.observation import Observation, Seen, observe
from sgns.frontier.point import Point
from sgns.frontier.study import (
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
from sgns.reduction.basis import Basis, reconstruction_curve
from sgns.reduction.reduce import ReducedDataset, fit_runs, reduce_dataset
from sgns.rollout import finite_frames
from sgns.settings import PointSettings
from sgns.simulate.scene import asked_effects, decided
from sgns.simulator import Simulator
from sgns.state import Rollout
from sgns.train.command import train

log = logging.getLogger(__name__)

STRETCHES = 3  # of each run of the solver, each timed for itself
REPEATS = 5  # timed rollouts of every case, or passes of encoding, after one that warms up
CODED_FRAMES = 16  # of one pass of encoding and decoding
INCLUDES = {
    "solver": "all substeps of the recorded frames; not: compiling kernels, set-up, writing files",
    "reduction": "encoding and decoding every frame; not: reading the frames, fitting the basis",
    "surrogate": "all steps of the network along a whole path, with force and torque; not: loading the checkpoint, and "
    "(in columns of their own) decoding particles and stepping pose by pose; nothing is read or written",
}
Measured = tuple[Point, Mapping[str, Observation]]
Jobs = Iterator[tuple[PointSettings, Callable[[], Measured]]]
"""Each point of an axis, and what measures it."""


def measure(study: Study, axis: str) -> None:
    """Measure and keep the points of an axis that are not there and that no other process is at."""
    workload = Workload()
    with one_core(last=axis != "solver"):
        for scene in study.scenes:
            for entry, measured in JOBS[axis](study, scene, workload):
                file = study.file(scene.name, axis, entry.label)
                with file_lock(file) as ours:
                    if ours and not file.exists():
                        watch = stopwatch()
                        study.save(*measured())
                        log.info("%s, %s: %s (%.0f s)", scene.name, axis, entry.label, watch()[0])


def new_point(study: Study, scene: StudyScene, kind: str, entry: PointSettings, **columns: Any) -> Point:
    """What a point says of itself and of how it is measured."""
    columns |= {"axis": entry.axis, "label": entry.label, "paper": entry.paper, "includes": INCLUDES[kind]}
    return Point(study=study.name, scene=scene.name, kind=kind, **columns | made_here())


# --- Solver: the cases of a scene with changed settings -------------------------------------------------


def solver_jobs(study: Study, scene: StudyScene, workload: Workload) -> Jobs:
    """The points of the solver, the reference first."""
    for entry in (scene.reference, *scene.points("solver")):
        yield entry, partial(solver_point, study, scene, entry, workload)


def solver_point(study: Study, scene: StudyScene, entry: PointSettings, workload: Workload) -> Measured:
    """A point and the runs of its cases; no runs where the solver had to stop."""
    settings = shlex.join([f"scene={scene.settings['scene']}", *entry.set])
    point = new_point(study, scene, "solver", entry, settings=settings)
    before = workload.measure()
    rates, processor, observations = [], [], {}
    try:
        for case, overrides in scene.cases.items():
            made, cfg = composed_scene([*overrides, *entry.set])
            effects = decided(made, asked_effects(cfg))[0]
            solver = Solver(made, effects, precision=cfg.solver.precision)
            times: list[tuple[float, float]] = []
            observations[case] = observe(made, timed_frames(solver, times))
            wall, of_processor = made.frame_rate * np.array(times[1:]).T  # frame 0 loads the kernels
            rates.append([part.mean() for part in np.array_split(wall, STRETCHES)])
            processor.append(of_processor.mean())
            point = replace(point, particles=float(solver.particle_count))
    except SolverStopped as stop:
        return replace(point, note=f"stopped: {' '.join(str(stop).split())}"), {}
    # One rate for each stretch: the mean over the cases.
    mean_rates = np.mean(rates, axis=0).tolist()
    costs = cost_fields(mean_rates, [*before, *workload.measure()], float(np.mean(processor)))
    return replace(point, **costs), observations


def timed_frames(solver: Solver, times: list[tuple[float, float]]) -> Iterator[Seen]:
    """All frames; the clocks run while the solver computes and stand while its frames are looked at."""
    frames = solver.frames()
    for _ in range(solver.scene.frame_count):
        watch = stopwatch()
        frame = next(frames)
        times.append(watch())
        yield frame.time, frame.force, frame.torque, frame.body_pose, frame.position


# --- Reductions: what r modes leave out of runs that the basis has not seen, and what coding costs ------
# An entry of `study.scenes.<scene>.reduction` has axis, label, `modes` (a list of r) and `centring`, and makes
# one point for each r. One stream over the dataset's training runs serves all entries; held out are its other
# runs.


def reduction_points(scene: StudyScene) -> Iterator[PointSettings]:
    """All points of a scene's entries, with one number of `modes` each.

    Raises:
        UserError: An entry lacks its keys, or they make no sense.
    """
    for entry in scene.points("reduction"):
        where = f"study.scenes.{scene.name}.reduction, {entry.label!r}"
        if not entry.modes:
            raise UserError(
                f"{where}: modes is missing; a reduction needs a list of whole numbers, 1 or more"
            )
        for r in entry.modes:
            changes = [f"reduction.centring={entry.centring}", f"reduction.num_modes={r}"]
            if r > 64:  # kept by default
                changes.append(f"reduction.max_modes={r}")
            yield replace(entry, label=f"{entry.label}, r {r}", set=changes, modes=[r])


def reduction_jobs(study: Study, scene: StudyScene, workload: Workload) -> Jobs:
    """The points that are missing and that the data has modes for."""
    asked = [p for p in reduction_points(scene) if not study.file(scene.name, "reduction", p.label).exists()]
    if not asked:
        return
    watch = stopwatch()
    data = training_settings(scene.dataset).dataset
    dataset = Dataset.open(data.path, data.get("where"))
    training, held_out = dataset.runs("train"), [*dataset.runs("validation"), *dataset.runs("test")]
    pca = fit_runs(training, max(p.modes[0] for p in asked))
    log.info("%s, reduction: fitted on %d runs (%.0f s)", scene.name, len(training), watch()[0])
    # Mean square [m²] about each particle's mean place: what the energy is a share of, for every centring.
    motion = float(reconstruction_curve(held_out, pca.basis("particle_axis", 1))[0])
    for centring in dict.fromkeys(p.centring for p in asked):
        basis = pca.basis(centring, pca.rank(centring))
        left_out = reconstruction_curve(held_out, basis)
        for entry in (p for p in asked if p.centring == centring):
            (r,) = entry.modes
            if r > basis.num_modes:
                log.info("%s: r %d left out, the data has %d modes", scene.name, r, basis.num_modes)
                continue
            columns = {
                "settings": shlex.join([f"dataset={scene.dataset}", *entry.set]),
                "modes": float(r),
                "particles": float(len(basis.modes)),
                "own_runs": float(len(held_out)),
                "own_position_rmse_mm": 1e3 * float(left_out[r]) ** 0.5,
                "frozen_rmse_mm": 1e3 * motion**0.5,
                "energy": 1.0 - float(left_out[r]) / motion,
                "training_runs": float(len(training)),
            }
            point = new_point(study, scene, "reduction", entry, **columns)
            yield entry, partial(coded, point, basis.sliced(r), held_out[0], workload)


def coded(point: Point, basis: Basis, path: Path, workload: Workload) -> Measured:
    """A point with the times of encoding and decoding the first frames of a run, a frame at a time."""
    with Run(path) as run:
        positions, rate = torch.from_numpy(run.positions(slice(0, CODED_FRAMES))), run.frame_rate
    before = workload.measure()
    times = []
    for _ in range(REPEATS + 1):
        watch = stopwatch()
        latents = [basis.transform(frame) for frame in positions]
        decoding = stopwatch()
        for latent in latents:
            basis.inverse(latent)
        times.append([*watch(), decoding()[0]])
    wall, processor, decoded = np.array(times[1:]).T * rate / len(positions)
    costs = cost_fields(wall.tolist(), [*before, *workload.measure()], statistics.median(processor))
    return replace(point, **costs, decoded_wall_s_per_simulated_s=statistics.median(decoded)), {}


# --- Surrogates: trained as `sgns train` does it, rolled out from rest on the cases, timed --------------


def surrogate_jobs(study: Study, scene: StudyScene, workload: Workload) -> Jobs:
    """The points of the surrogates, in their order."""
    for entry in scene.points("surrogate"):
        yield entry, partial(surrogate_point, study, scene, entry, workload)


def surrogate_point(study: Study, scene: StudyScene, entry: PointSettings, workload: Workload) -> Measured:
    """A point and its rollouts; no rollouts where one of them left the range of numbers."""
    cfg = training_settings(scene.dataset, *entry.set)
    dataset = Dataset.open(cfg.dataset.path, cfg.dataset.get("where"))
    reduced = reduce_dataset(dataset, cfg.reduction, progress=False)
    rate = f"scene.frame_rate={reduced.frame_rate}"
    scenes = {case: composed_scene([*changes, rate])[0] for case, changes in scene.cases.items()}
    for case, case_scene in scenes.items():
        if case_scene.arrangement_hash != reduced.basis.arrangement_hash:
            raise UserError(
                f"study.scenes.{scene.name}.cases.{case} has another bed of particles than dataset={scene.dataset}, "
                "so that no surrogate of it can be judged there; use the dataset's scene and bed"
            )
    output = study.folder / "trainings" / study.file(scene.name, "surrogate", entry.label).stem
    training_s, samples = timed_training(reduced, cfg, output)
    simulator = Simulator.load(output / "best.ckpt")
    before = workload.measure()
    (wall, processor, decoded, stepped), rollouts = timed_rollouts(simulator, scenes)
    costs = cost_fields(wall.tolist(), [*before, *workload.measure()], statistics.median(processor))
    point = new_point(
        study,
        scene,
        "surrogate",
        entry,
        settings=shlex.join([f"dataset={scene.dataset}", *entry.set]),
        particles=float(len(simulator.start_positions)),
        modes=float(simulator.num_modes),
        parameters=float(network_costs(output / "best.ckpt", simulator.card).parameters),
        training_s=training_s,
        training_samples=float(samples),
        training_runs=float(len(dataset.runs("train"))),
        decoded_wall_s_per_simulated_s=statistics.median(decoded),
        stepped_wall_s_per_simulated_s=statistics.median(stepped),
        **own_fields(own_errors(simulator, dataset), len(dataset.runs("test"))),
        **costs,
    )
    observations = {}
    for case, rollout in rollouts.items():
        if (good := finite_frames(rollout)) < len(rollout.latent):
            return replace(point, note=f"{case}: not finite from frame {good} on"), {}
        times = np.arange(len(rollout.latent)) / simulator.frame_rate
        soil = (simulator.basis.inverse(latent).numpy() for latent in torch.as_tensor(rollout.latent))
        frames = zip(times, rollout.force, rollout.torque, rollout.poses, soil, strict=True)
        observations[case] = observe(scenes[case], frames)
    return point, observations


def training_settings(dataset: str, *overrides: str) -> DictConfig:
    """Settings of `sgns train`."""
    return composed("train", [f"dataset={dataset}", "output=.", *overrides])


def timed_training(reduced: ReducedDataset, cfg: DictConfig, output: Path) -> tuple[float, int]:
    """Train anew, on one thread.

    Returns:
        Processor time, validation included [s], and the windows seen; of polynomials those that are fitted to, noise
        drawn anew counted again.
    """
    settings: Any = OmegaConf.to_container(cfg, resolve=True)
    training = settings["training"] | {"threads": 1, "resume": False}
    watch = stopwatch()
    train(
        reduced,
        num_modes=reduced.num_modes,
        model=settings["model"],
        training=training,
        output=output,
        seed=cfg.seed,
        device=cfg.device,
        start_from=cfg.checkpoint,
        provenance={key: settings[key]["name"] for key in ("preset", "dataset")},
    )
    seconds = round(watch()[1], 1)
    if "max_steps" in training:
        return seconds, training["max_steps"] * training["batch_size"]
    return seconds, training["draws"] * sum(len(run.latent) - 1 for run in reduced.runs("train"))


def timed_rollouts(
    simulator: Simulator, scenes: Mapping[str, Scene]
) -> tuple[np.ndarray, dict[str, Rollout]]:
    """Every case from rest, several times.

    Returns:
        Wall time and processor time of all steps, and wall time with all frames decoded and that of stepping pose by
        pose, of each repeat, mean over the cases [s per simulated s], shape (4, repeats); the rollouts.
    """
    paths = {case: (s.body_poses(), s.body_points(), s.to_dict()) for case, s in scenes.items()}
    rollouts = {}
    times = np.zeros((REPEATS + 1, len(paths), 4))
    for repeat in times:
        for seconds, (case, (poses, points, values)) in zip(repeat, paths.items(), strict=True):
            watch = stopwatch()
            rollouts[case] = rollout = simulator.rollout(poses, points, values=values)
            processor = watch()[1]
            watch = stopwatch()
            for latent in torch.as_tensor(rollout.latent):
                simulator.basis.inverse(latent)
            decoded = rollout.wall_time_s + watch()[0]
            simulator.reset(scenes[case])
            watch = stopwatch()
            for pose in poses[1:]:
                simulator.step(pose)
            seconds[:] = rollout.wall_time_s, processor, decoded, watch()[0]
            seconds *= simulator.frame_rate / (len(poses) - 1)
    return times[1:].mean(axis=1).T, rollouts


def own_errors(simulator: Simulator, dataset: Dataset) -> Scores:
    """Scores against the solver that made the training runs, over the test runs together, each rolled out from its
    first d true frames, as `sgns evaluate` does it."""
    d, basis = int(simulator.history), simulator.basis
    means = training_means(dataset.runs("train"), d)
    grid = surface_grid(np.asarray(simulator.start_positions, dtype=np.float64))
    found = []
    for path in dataset.runs("test"):
        with Run(path) as truth:
            rollout = roll_out(simulator, truth)
            latent = torch.as_tensor(rollout.latent)
            # What the metrics read of a run; frames are decoded when asked for.
            prediction: Any = SimpleNamespace(
                pose=rollout.poses,
                force=rollout.force,
                torque=rollout.torque,
                force_spread=None,
                positions=lambda frames, latent=latent: basis.inverse(latent[frames]).numpy(),
            )
            errors = position_errors(truth, prediction, basis, d, grid)
            body = body_errors(truth, prediction.pose, d)
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


JOBS: dict[str, Callable[[Study, StudyScene, Workload], Jobs]] = {
    "solver": solver_jobs,
    "reduction": reduction_jobs,
    "surrogate": surrogate_jobs,
}
