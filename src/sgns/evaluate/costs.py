"""What a network costs: time, memory and training, the solver's time beside it, and where that was measured."""

from __future__ import annotations

import copy
import itertools
import logging
import math
import os
import platform
import shlex
import statistics
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import fields
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import torch

from mpm_warp import Effects, Scene, SceneError, Solver, SolverStopped
from mpm_warp.limits import usable_cores
from mpm_warp.poses import in_body_frame
from sgns import __version__
from sgns.data.run import Run
from sgns.evaluate.results import Costs, NetworkTiming
from sgns.model.checkpoint import SUMMARY, load_surrogate, read_summary
from sgns.numbers import elapsed
from sgns.rollout import single_thread
from sgns.simulator import Simulator
from sgns.state import Rollout

log = logging.getLogger(__name__)

# --- How a result was made: command, checkpoint, versions, machine --------------------------------------


def cpu_model() -> str:
    """Name of this machine's processor."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine() or "unknown"


def command_line() -> str:
    """The `sgns` command that is running with its overrides; empty outside Hydra."""
    from hydra.core.hydra_config import HydraConfig

    if not HydraConfig.initialized():
        return ""
    config = HydraConfig.get()
    return shlex.join(["sgns", str(config.job.config_name), *config.overrides.task])


def provenance(simulator: Simulator, checkpoint: Path) -> dict[str, str]:
    """Name → value, in the order to show; what is not known is left out."""
    settings = simulator.card.get("settings", {})
    facts = {
        "command": command_line(),
        "checkpoint": str(checkpoint),
        "preset": str(settings.get("preset") or ""),
        "trained on": str(settings.get("dataset") or ""),
        "training steps": str((settings.get("training") or {}).get("max_steps") or ""),
        "modes": str(simulator.num_modes),
        "history frames": str(simulator.history),
        "basis fitted on": f"{len(simulator.basis.fitted_on or ())} training runs",
        "package": f"sgns {__version__}, torch {torch.__version__}, Python {platform.python_version()}",
        "machine": f"{cpu_model()}, {usable_cores()} cores, {platform.system()}",
        "date": datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC"),
    }
    return {name: value for name, value in facts.items() if value}


# --- What a trained network takes besides time: memory, parameters, and what its training took ----------


def network_costs(checkpoint: Path, card: dict[str, Any]) -> Costs:
    """What a checkpoint, its simulator's card and the folder it lies in tell; nothing is known if there is no file.

    Raises:
        UserError: `training.json` beside the checkpoint is damaged.
    """
    found: dict[str, float] = {}
    if checkpoint.is_file():
        weights = load_surrogate(checkpoint).dynamics.parameters()
        found["parameters"] = sum(weight.numel() for weight in weights)
        found["checkpoint_bytes"] = checkpoint.stat().st_size
    if os.path.lexists(checkpoint.parent / SUMMARY):
        summary = read_summary(checkpoint.parent)
        found["training_seconds"] = float(summary["seconds"])
        if "steps" in summary:  # polynomials are fitted without any
            found["training_steps"] = summary["steps"]
        if batch := card.get("settings", {}).get("training", {}).get("batch_size"):
            found["batch_size"] = int(batch)
    return Costs(**found)


def forget_peak() -> None:
    """Start measuring the peak of this process's memory anew; without effect where the system cannot."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def peak_memory() -> float:
    """Largest resident memory since the peak was forgotten, as Linux counts it [bytes]; NaN if not known."""
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith("VmHWM:"):
                return 1024.0 * float(line.split()[1])
    return math.nan


# --- The solver on a run's scene, beside the network ------------------------------------------------------

SOLVER_FRAMES = 3  # of one stretch


def solver_rates(run: Run) -> Iterator[float]:
    """Wall seconds per simulated second of the solver, of one stretch of a run's scene after the other.

    On one core, without compiling kernels and without writing; on no core of a GPU. Ends with the scene, and is empty
    where the file does not hold all that is needed to compute it again.
    """
    try:
        scene = Scene.from_dict(run.scene, *run.meshes)
        known = {one.name for one in fields(Effects)}
        effects = Effects.from_dict({name: e["on"] for name, e in run.effects.items() if name in known})
        frames = Solver(scene, effects, precision=run.extra["precision"]).frames()
        for _ in range(2):  # the first frame loads kernels, the second is the first that computes
            next(frames)
        while True:
            began = time.perf_counter()
            if sum(1 for _ in itertools.islice(frames, SOLVER_FRAMES)) < SOLVER_FRAMES:
                return
            yield elapsed(began, time.perf_counter()) * scene.frame_rate / SOLVER_FRAMES
    except (SceneError, SolverStopped, KeyError, TypeError, StopIteration) as error:
        log.info("the solver cannot be timed on %s: %s", run.path.name, error)


# --- Times of a network along a run, in turn with the solver -------------------------------------------


def roll_out(simulator: Simulator, run: Run) -> Rollout:
    """The network along a run's tool path, from the run's first d true frames."""
    points = in_body_frame(run.pose[0], run.body_points[0])
    given = simulator.basis.transform(run.positions(slice(0, simulator.history)))
    return simulator.rollout(run.pose, points, latent_history=given, values=run.scene)


def time_network(simulator: Simulator, path: Path, repeats: int) -> NetworkTiming:
    """Times rollouts, steps and, in turn with them, the solver along one run's tool path, after one that warms up."""
    times: list[tuple[float, ...]] = []
    solved: list[float] = []
    with Run(path) as run, single_thread():
        simulated = (run.frame_count - simulator.history) / run.frame_rate
        solver = solver_rates(run)
        for _ in range(repeats + 1):
            forget_peak()
            rollout = roll_out(simulator, run)
            peak = peak_memory()
            forget_peak()
            began = time.perf_counter()
            for latent in torch.as_tensor(rollout.latent):
                simulator.basis.inverse(latent)
            per_second = float(rollout.wall_time_s) / simulated
            decoded = per_second + elapsed(began, time.perf_counter()) / simulated
            if not times:  # before there is a solver
                peaks = {"rollout_bytes": peak, "decoded_bytes": peak_memory()}
            times.append((per_second, decoded, step_time(simulator, run)))
            solved += itertools.islice(solver, 1)
        rolled, decoded, stepped = (statistics.median(kind) for kind in zip(*times[1:], strict=True))
        solver_time = statistics.median(solved or [math.nan])
        return NetworkTiming(rolled, decoded, stepped, solver_time, repeats, path.stem, **peaks)


def step_time(simulator: Simulator, run: Run) -> float:
    """Wall seconds per simulated second of `Simulator.step` along a run's tool path, pose by pose."""
    stepped = copy.copy(simulator)
    stepped.reset(run.pose, values=run.scene)
    began = time.perf_counter()
    for pose in run.pose[1:]:
        stepped.step(pose)
    return elapsed(began, time.perf_counter()) * run.frame_rate / (run.frame_count - 1)
