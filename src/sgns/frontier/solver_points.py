"""Points of the solver and of reductions."""

from __future__ import annotations

import logging
import shlex
import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from mpm_warp import Solver, SolverStopped
from sgns.clock import elapsed
from sgns.config import UserError
from sgns.data.dataset import Dataset
from sgns.data.files import file_lock
from sgns.data.run import Run
from sgns.frontier.observation import Observation, Observer, observed_frames
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
from sgns.frontier.surrogate_points import training_settings
from sgns.reduction.basis import CENTRINGS, Basis, reconstruction_curve
from sgns.reduction.reduce import fit_runs
from sgns.simulate.scene import asked_effects, decided

log = logging.getLogger(__name__)


# --- Operating points of the solver: the cases of a scene, computed and timed with changed settings -----

STRETCHES = 3  # of each run, each timed for itself
INCLUDES = "all substeps of the recorded frames; not: compiling kernels, set-up, writing files"


def measure_solver(study: Study) -> None:
    """Measure the solver's points of a study that are not there yet, the reference of every scene first."""
    with one_core():
        workload: Workload | None = None
        for scene in study.scenes:
            for settings in (scene.reference, *scene.points("solver")):
                file = study.store.file(scene.name, "solver", settings.label)
                with file_lock(file) as ours:
                    if not ours or file.exists():
                        continue
                    workload = workload or Workload()
                    began = time.perf_counter()
                    study.store.save(*measured(study, scene, settings, workload))
                    took = elapsed(began, time.perf_counter())
                    log.info("%s, solver: %s (%.0f s)", scene.name, settings.label, took)


def measured(
    study: Study, scene: StudyScene, settings: PointSettings, workload: Workload
) -> tuple[Point, dict[str, Observation]]:
    """A point and the runs of its cases; no runs where the solver had to stop."""
    point = Point(
        study=study.name,
        scene=scene.name,
        kind="solver",
        axis=settings.axis,
        label=settings.label,
        settings=shlex.join([f"scene={scene.settings['scene']}", *settings.set]),
        paper=settings.paper,
        includes=INCLUDES,
        **made_here(),
    )
    before = workload.measure()
    walls, processor, observations = [], [], {}
    try:
        for case, overrides in scene.cases.items():
            run = timed_run([*overrides, *settings.set])
            observations[case] = run[0]
            walls.append(run[1])
            processor.append(run[2])
            point = replace(point, particles=float(run[3]))
    except SolverStopped as stop:
        return replace(point, note=f"stopped: {' '.join(str(stop).split())}"), {}
    # One rate for each stretch: the mean over the cases.
    costs = cost_fields(
        list(np.mean(walls, axis=0)), [*before, *workload.measure()], float(np.mean(processor))
    )
    return replace(point, **costs), observations


def timed_run(overrides: list[str]) -> tuple[Observation, list[float], float, int]:
    """One case.

    Returns:
        The run; wall seconds per simulated second of each stretch; processor seconds per simulated second; n.
    """
    scene, cfg = composed_scene(overrides)
    effects, _ = decided(scene, asked_effects(cfg))
    solver = Solver(scene, effects, precision=cfg.solver.precision)
    observer = Observer(scene, scene.initial_positions())
    wanted = set(observed_frames(scene.frame_count, scene.frame_rate).tolist())
    wall, processor = [], []
    # The clocks run while the solver computes and stand while its frames are looked at. Frame 0 loads the kernels.
    frames = solver.frames()
    for _ in range(scene.frame_count):
        start = time.perf_counter(), time.process_time()
        frame = next(frames)
        wall.append(elapsed(start[0], time.perf_counter()))
        processor.append(elapsed(start[1], time.process_time()))
        observer.add(frame.time, frame.force, frame.torque, frame.body_pose)
        if frame.index in wanted:
            observer.add_soil(frame.time, frame.position)
    stretches = np.array_split(np.array(wall[1:]), STRETCHES)
    rates = [float(part.mean() * scene.frame_rate) for part in stretches]
    return observer.finish(), rates, float(np.mean(processor[1:]) * scene.frame_rate), solver.particle_count


# --- Operating points of the reduction: what r modes leave out of runs that the basis has not seen, and wha
# An entry of `study.scenes.<scene>.reduction` has axis, label, `modes` (a list of r) and `centring`, and
# makes one point
# for each r. One stream over the dataset's training runs serves all entries; held out are its other runs.

REPEATS = 5  # timed passes over some frames, after one that warms up
FRAMES = 16  # of one pass
INCLUDES_of_reduction_points = "encoding and decoding every frame; not: reading the frames, fitting the basis"


@dataclass(frozen=True, eq=False)
class Wanted:
    """One point to be measured."""

    entry: PointSettings
    centring: str
    modes: int

    @property
    def label(self) -> str:
        """Of the point."""
        return f"{self.entry.label}, r {self.modes}"


def wanted_of(scene: StudyScene) -> Iterator[Wanted]:
    """All points of a scene's entries.

    Raises:
        UserError: An entry lacks its keys, or they make no sense.
    """
    for entry in scene.points("reduction"):
        where = f"study.scenes.{scene.name}.reduction, {entry.label!r}"
        more = dict(entry.more or {})
        if more.get("centring") not in CENTRINGS:
            raise UserError(f"{where}: centring is {more.get('centring')!r}; allowed: {', '.join(CENTRINGS)}")
        modes = more.get("modes")
        if not isinstance(modes, list) or not all(type(r) is int and r >= 1 for r in modes):
            raise UserError(f"{where}: modes is {modes!r}; it must be a list of whole numbers, 1 or more")
        yield from (Wanted(entry, more["centring"], r) for r in modes)


def measure_reduction(study: Study) -> None:
    """Measure the reduction points of a study that are not there yet."""
    with one_core(last=True):
        for scene in study.scenes:
            wanted = list(wanted_of(scene))
            missing = [w for w in wanted if not study.store.has(scene.name, "reduction", w.label)]
            if not missing:
                continue
            # One process makes all of a scene's: they share the stream over the runs.
            with file_lock(study.store.file(scene.name, "reduction", "all")) as ours:
                if ours:
                    measure_scene(study, scene, missing)


def measure_scene(study: Study, scene: StudyScene, missing: list[Wanted]) -> None:
    """Fit, measure and keep."""
    began = time.perf_counter()
    dataset = Dataset.open(training_settings(scene.dataset, ())["dataset"]["path"])
    training, held_out = dataset.runs("train"), [*dataset.runs("validation"), *dataset.runs("test")]
    pca = fit_runs(training, max(w.modes for w in missing))
    log.info(
        "%s, reduction: fitted on %d runs (%.0f s)",
        scene.name,
        len(training),
        elapsed(began, time.perf_counter()),
    )
    motion = held_out_motion(pca.basis("particle_axis", 1), held_out)
    workload = Workload()
    for centring in dict.fromkeys(w.centring for w in missing):
        basis = pca.basis(centring, pca.rank(centring))
        found = [w for w in missing if w.centring == centring and w.modes <= basis.num_modes]
        curve = reconstruction_curve(held_out, basis)
        before = workload.measure()
        coding = {one: coding_times(basis.sliced(one.modes), held_out[0]) for one in found}
        speed = [*before, *workload.measure()]
        for one, times in coding.items():
            mse = float(curve[one.modes])
            point = described(study, scene, one)
            study.store.save(
                replace(
                    point,
                    particles=float(len(basis.modes)),
                    own_runs=float(len(held_out)),
                    own_position_rmse_mm=1e3 * mse**0.5,
                    frozen_rmse_mm=1e3 * motion**0.5,
                    energy=1.0 - mse / motion,
                    training_runs=float(len(training)),
                    decoded_wall_s_per_simulated_s=statistics.median(times.decoding),
                    **cost_fields(times.both, speed, statistics.median(times.processor)),
                ),
                {},
            )
        if beyond := [w.modes for w in missing if w.centring == centring and w.modes > basis.num_modes]:
            log.info("%s: r %s left out, the data has %d modes", scene.name, beyond, basis.num_modes)
    log.info(
        "%s, reduction: %d points (%.0f s)", scene.name, len(missing), elapsed(began, time.perf_counter())
    )


def described(study: Study, scene: StudyScene, one: Wanted) -> Point:
    """What a point says of itself before anything is measured."""
    changes = [f"reduction.centring={one.centring}", f"reduction.num_modes={one.modes}"]
    if one.modes > 64:  # kept by default
        changes.append(f"reduction.max_modes={one.modes}")
    return Point(
        study=study.name,
        scene=scene.name,
        kind="reduction",
        axis=one.entry.axis,
        label=one.label,
        settings=shlex.join([f"dataset={scene.dataset}", *changes]),
        modes=float(one.modes),
        includes=INCLUDES_of_reduction_points,
        **made_here(),
    )


def held_out_motion(basis: Basis, paths: list[Path]) -> float:
    """Mean square of the held-out runs about each particle's mean place in the training runs [m²]: what the energy is
    a share of, for every centring."""
    return float(reconstruction_curve(paths, basis)[0])


class CodingTimes(NamedTuple):
    """Seconds per simulated second of some passes, a frame at a time.

    Attributes:
        both: wall time of encoding and decoding.
        processor: processor time of both.
        decoding: wall time of decoding.
    """

    both: list[float]
    processor: list[float]
    decoding: list[float]


def coding_times(basis: Basis, path: Path) -> CodingTimes:
    """Times of encoding and decoding the first frames of a run."""
    with Run(path) as run:
        positions, rate = torch.from_numpy(run.positions(slice(0, FRAMES))), run.frame_rate
    times = CodingTimes([], [], [])
    for repeat in range(REPEATS + 1):
        clock, began = time.process_time(), time.perf_counter()
        coded = [basis.transform(frame) for frame in positions]
        between = time.perf_counter()
        for latent in coded:
            basis.inverse(latent)
        end = time.perf_counter()
        if repeat:
            per_second = rate / len(positions)
            times.both.append(elapsed(began, end) * per_second)
            times.processor.append(elapsed(clock, time.process_time()) * per_second)
            times.decoding.append(elapsed(between, end) * per_second)
    return times
