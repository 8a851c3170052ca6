"""The numbers of an evaluation as files: `metrics.csv` and `metrics.json`."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sgns.evaluation.results import Evaluation
from sgns.evaluation.scores import Scores
from sgns.wholefile import whole_file, write_whole

__all__ = ["write_csv", "write_json", "write_tables"]


def write_tables(evaluation: Evaluation, output: Path) -> None:
    """`metrics.csv`: a row per run and one for all; `metrics.json`: the same and everything around it."""
    scores = [run.scores for run in evaluation.runs]
    write_csv(output / "metrics.csv", [*scores, evaluation.total])
    timing = evaluation.timing
    write_json(
        output / "metrics.json",
        {
            "dataset": evaluation.dataset,
            "split": evaluation.split,
            "num_modes": evaluation.num_modes,
            "history": evaluation.history,
            "particles": evaluation.particle_count,
            "aggregate": evaluation.total.row(),
            "runs": [score.row() for score in scores],
            "mean_training_force_N": evaluation.mean_force,
            "wall_s_per_simulated_s": {
                "solver": evaluation.total.solver_rate,
                "network_stepping_with_force": timing.stepping,
                "network_with_decoding": timing.decoding,
                "network_threads": 1,
                "network_repeats": timing.repeats,
            },
            "reconstruction_mse_m2": evaluation.curves.held_out,
            "made": evaluation.made,
        },
    )


def write_csv(path: Path, scores: Sequence[Scores]) -> None:
    """One line per `Scores` under a line of column names; a metric without meaning is left empty."""
    rows = [score.row() for score in scores]
    with whole_file(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        for row in rows:
            writer.writerow({key: "" if is_nan(value) else value for key, value in row.items()})


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Nested plain values as JSON that every reader takes: numbers that are not finite become null."""
    write_whole(path, json.dumps(strict(content), indent=2, allow_nan=False) + "\n")


def strict(value: Any) -> Any:
    """The value with every number that is not finite replaced by None."""
    if isinstance(value, Mapping):
        return {str(key): strict(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [strict(item) for item in value]
    if isinstance(value, np.ndarray):
        return strict(value.tolist())
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return value


def is_nan(value: Any) -> bool:
    """Whether a value is the number NaN."""
    return isinstance(value, float) and math.isnan(value)
