"""Which of the judged runs a checkpoint has already seen: a number for those is no test."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sgns.evaluation.results import Evaluation
    from sgns.simulator import Simulator

__all__ = ["overlap_warning", "seen_before"]


def seen_before(simulator: Simulator, names: Sequence[str]) -> tuple[list[str], list[str]]:
    """Of some runs' names those that the checkpoint was trained on, and those that chose it.

    A checkpoint knows its runs by name only.
    """
    fitted = set(simulator.basis.fitted_on or ())
    judged = set(simulator.card.get("settings", {}).get("validation_runs", ()))
    trained_on = [name for name in names if name in fitted]
    return trained_on, [name for name in names if name in judged - fitted]


def overlap_warning(evaluation: Evaluation) -> str:
    """One sentence if the evaluation is no clean test, else nothing."""
    count = len(evaluation.runs)
    parts = [
        f"{len(names)} of the {count} evaluated runs {verb} ({names[0]}{', …' if len(names) > 1 else ''})"
        for names, verb in (
            (evaluation.trained_on, "bear the names of runs that this checkpoint was trained on"),
            (evaluation.chosen_by, "bear the names of validation runs that chose this checkpoint"),
        )
        if names
    ]
    return f"{'; '.join(parts)}: for those the numbers are no test." if parts else ""
