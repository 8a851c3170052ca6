"""What a network costs besides time, and how and where that was measured."""

from __future__ import annotations

import itertools
import logging
import math
import os
import platform
import shlex
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
from sgns import __version__
from sgns.data.run import Run
from sgns.evaluate.results import Costs
from sgns.model.checkpoint import SUMMARY, load_surrogate, read_summary
from sgns.numbers import elapsed
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
