"""Operating points of surrogates: trained for a given time, rolled out from rest on the cases, timed.

An entry of `study.scenes.<scene>.surrogate` has axis, label and overrides of `sgns train`, and these keys, which may
also be given for all entries of a scene under `training`:

    seconds          processor time of the training's steps [s]
    runs             training runs, of which the basis is made, too; null: all
    every            frames of the dataset in one of the surrogate's
    seed             of weights, noise and order of the samples
    table, case      an entry that was measured elsewhere: the line `case` of a table of experiments/full_space
"""

from __future__ import annotations

import logging
import math
import shlex
import statistics
import time
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra import compose, initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf

from mpm_warp import Scene
from sgns.campaign import Dataset
from sgns.claim import claimed
from sgns.clock import elapsed
from sgns.errors import UserError
from sgns.evaluation.costs import network_costs
from sgns.evaluation.scores import Scores
from sgns.frontier.observation import Observation, observe_arrays, observed_frames
from sgns.frontier.own_errors import own_errors
from sgns.frontier.point import Point
from sgns.frontier.study import PointSettings, Study, StudyScene
from sgns.frontier.timed_training import TimedTraining, train_for
from sgns.frontier.timing import Workload, composed_scene, cost_fields, made_here, one_core
from sgns.frontier.training_sets import every_nth_frame, with_training_runs
from sgns.reduction.reduced import reduce_dataset
from sgns.rollout import finite_frames
from sgns.simulator import Simulator
from sgns.smallfile import read_table
from sgns.states import Rollout

__all__ = ["TrainingPlan", "measure_surrogates"]

log = logging.getLogger(__name__)

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
