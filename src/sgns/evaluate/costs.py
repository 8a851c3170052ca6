"""What a network costs besides time, and how and where that was measured."""

from __future__ import annotations

import itertools
import logging
import math
import os
import platform
import shlex
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import fields, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mpm_warp import Effects, Scene, SceneError, Solver, SolverStopped
from mpm_warp.limits import usable_cores
from sgns import __version__
from sgns.data.run import Run
from sgns.evaluate.full_space import FullSpaceDynamics, FullSpaceRun, FullSpaceWindows, box_surface, losses
from sgns.evaluate.results import Costs, FullSpaceCost
from sgns.model.checkpoint import SUMMARY, load_surrogate, read_summary
from sgns.numbers import elapsed
from sgns.rollout import single_thread
from sgns.settings import ModelSettings
from sgns.simulator import Simulator

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
        scene = Scene.from_dict(run.scene, run.mesh)
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


# --- What the same network would cost on every particle: the paper's comparison, measured on this machine
# Costs do not depend on what a network has learned, so an untrained one is timed.

_BATCH = 2  # windows of a training step, the paper's
_REACH = 4 / 3  # radius of the neighbourhood in particle spacings: 6 neighbours in a bed at rest


def full_space_cost(path: Path, settings: ModelSettings, repeats: int) -> FullSpaceCost:
    """Time and memory of a step, with the tool half-way along a run; medians of repeats after one to warm up.

    The network's body has nodes on its surface whatever `body_nodes` says.
    """
    with Run(path) as run:
        spacing = float(np.prod(run.scene["bed"]["size"]) / run.particle_count) ** (1 / 3)
        blade = run.scene.get("blade")
    # Nodes of a blade as close together as particles, so that none slips between them; of other bodies as recorded.
    nodes = None
    if blade is not None:
        nodes = box_surface(np.array([blade["thickness"], blade["width"], blade["length"]]) / 2, spacing)
    one_run = FullSpaceRun(path, nodes)
    dynamics = FullSpaceDynamics(replace(settings, body_nodes="points"), _REACH * spacing, one_run.bin_size)
    windows = FullSpaceWindows([one_run], dynamics.history)
    window = windows.window(len(windows) // 2)
    still = torch.zeros(3, dtype=torch.float64)

    def training_step() -> None:
        dynamics.zero_grad()
        acceleration, force = losses(dynamics, windows.batch(0, _BATCH, still))
        (acceleration + force).backward()

    with single_thread():
        with torch.inference_mode():
            frame = wall_time(lambda: dynamics.advance(window.history, window.body), repeats)
        forget_peak()
        step = wall_time(training_step, repeats)
    return FullSpaceCost(
        parameters=sum(weight.numel() for weight in dynamics.parameters()),
        training_step=step,
        batch_size=_BATCH,
        rollout=frame * one_run.frame_rate,
        peak_bytes=peak_memory(),
    )


def wall_time(action: Callable[[], object], repeats: int) -> float:
    """Median after one call to warm up [s]."""
    action()
    found = []
    for _ in range(repeats):
        began = time.perf_counter()
        action()
        found.append(elapsed(began, time.perf_counter()))
    return statistics.median(found)
