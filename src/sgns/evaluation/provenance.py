"""How a result was made: command, checkpoint, versions, machine."""

from __future__ import annotations

import os
import platform
import shlex
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from sgns import __version__

if TYPE_CHECKING:
    from sgns.simulator import Simulator

__all__ = ["cpu_model", "provenance", "usable_cores"]


def cpu_model() -> str:
    """Name of this machine's processor."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine() or "unknown"


def usable_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def command_line() -> str:
    """The `sgns` command that is running with its overrides; empty outside Hydra."""
    from hydra.core.hydra_config import HydraConfig

    if not HydraConfig.initialized():
        return ""
    config = HydraConfig.get()
    return shlex.join(["sgns", str(config.job.config_name), *config.overrides.task])


def provenance(simulator: Simulator, checkpoint: Path) -> dict[str, str]:
    """Name → value, in the order to show; what is not known is left out.

    Args:
        simulator: the trained `Simulator`; its card tells how it was trained.
        checkpoint: file it was loaded from.
    """
    settings = simulator.card.get("settings", {})
    facts = {
        "command": command_line(),
        "checkpoint": str(checkpoint),
        "preset": str(settings.get("preset") or ""),
        "trained on": str(settings.get("dataset") or ""),
        "training steps": str((settings.get("training") or {}).get("max_steps") or ""),
        "modes": str(simulator.num_modes),
        "history frames": str(simulator.history),
        "basis fitted on": f"{len(simulator.basis.fitted_on)} training runs",
        "package": f"sgns {__version__}, torch {torch.__version__}, Python {platform.python_version()}",
        "machine": f"{cpu_model()}, {usable_cores()} cores, {platform.system()}",
        "date": datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC"),
    }
    return {name: value for name, value in facts.items() if value}
