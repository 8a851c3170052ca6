"""Operating points of the solver: the cases of a scene, computed and timed with changed settings."""

from __future__ import annotations

import logging
import shlex
import time
from dataclasses import replace

import numpy as np

from mpm_warp import Solver, SolverStopped
from sgns.claim import claimed
from sgns.clock import elapsed
from sgns.frontier.observation import Observation, Observer, observed_frames
from sgns.frontier.point import Point
from sgns.frontier.study import PointSettings, Study, StudyScene
from sgns.frontier.timing import Workload, composed_scene, cost_fields, made_here, one_core
from sgns.scene_effects import asked_effects, decided

__all__ = ["measure_solver"]

log = logging.getLogger(__name__)

STRETCHES = 3  # of each run, each timed for itself
INCLUDES = "all substeps of the recorded frames; not: compiling kernels, set-up, writing files"


def measure_solver(study: Study) -> None:
    """Measure the solver's points of a study that are not there yet, the reference of every scene first."""
    with one_core():
        workload: Workload | None = None
        for scene in study.scenes:
            for settings in (scene.reference, *scene.points("solver")):
                file = study.store.file(scene.name, "solver", settings.label)
                with claimed(file) as ours:
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
