"""What a trained network takes besides time: memory, parameters, and what its training took."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

from sgns.evaluation.results import Costs
from sgns.learning.summary import SUMMARY, read_summary
from sgns.learning.surrogate import load_surrogate

__all__ = ["forget_peak", "network_costs", "peak_memory"]


def network_costs(checkpoint: Path, card: dict[str, Any]) -> Costs:
    """What a checkpoint and the folder it lies in tell.

    Args:
        checkpoint: file; nothing is known if there is none.
        card: of the simulator that was loaded from it.
    """
    return Costs(**stored(checkpoint), **trained(checkpoint, card))


def stored(checkpoint: Path) -> dict[str, float]:
    """Size of the checkpoint and number of its learned weights; nothing if it is no file."""
    if not checkpoint.is_file():
        return {}
    weights = load_surrogate(checkpoint).dynamics.parameters()
    return {
        "parameters": sum(weight.numel() for weight in weights),
        "checkpoint_bytes": checkpoint.stat().st_size,
    }


def trained(checkpoint: Path, card: dict[str, Any]) -> dict[str, float]:
    """What `training.json` beside the checkpoint says of the training; nothing without it.

    Raises:
        UserError: it is damaged.
    """
    if not os.path.lexists(checkpoint.parent / SUMMARY):
        return {}
    summary = read_summary(checkpoint.parent)
    found = {"training_seconds": float(summary["seconds"])}
    if "steps" in summary:  # polynomials are fitted without any
        found["training_steps"] = summary["steps"]
    batch = card.get("settings", {}).get("training", {}).get("batch_size")
    return found | ({"batch_size": int(batch)} if batch else {})


# --- memory of this process, as Linux counts it -----------------------------------------------------------


def forget_peak() -> None:
    """Start measuring the peak anew; without effect where the system cannot."""
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        pass


def peak_memory() -> float:
    """Largest resident memory of this process since the peak was forgotten [bytes]; NaN if not known."""
    try:
        for line in Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith("VmHWM:"):
                return 1024.0 * float(line.split()[1])
    except OSError:
        pass
    return math.nan
