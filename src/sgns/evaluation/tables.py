"""The numbers of an evaluation as files: `metrics.csv`, `examples.csv` and `metrics.json`."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from sgns.evaluation.metrics import FORCE_COMPONENTS
from sgns.evaluation.results import Evaluation
from sgns.evaluation.scores import Scores
from sgns.wholefile import whole_file, write_whole

__all__ = ["example_row", "write_csv", "write_json", "write_tables"]


def write_tables(evaluation: Evaluation, output: Path) -> None:
    """Writes the files.

    `metrics.csv`: a row per run and one for all; `examples.csv`: the columns of the paper's table of test
    examples with the baselines beside; `metrics.json`: the first and everything around it.
    """
    scores = [run.scores for run in evaluation.runs]
    write_csv(output / "metrics.csv", [*scores, evaluation.total])
    write_rows(output / "examples.csv", [example_row(score) for score in (*scores, evaluation.total)])
    timing, costs = evaluation.timing, evaluation.costs
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
            "peak_memory_bytes": {
                "network_stepping_with_force": timing.stepping_bytes,
                "network_with_decoding": timing.decoding_bytes,
            },
            "network": {
                "parameters": costs.parameters,
                "checkpoint_bytes": costs.checkpoint_bytes,
                "training_steps": costs.training_steps,
                "training_wall_s": costs.training_seconds,
                "training_wall_s_per_step": costs.seconds_per_step,
                "training_batch_size": costs.batch_size,
            },
            "full_space": asdict(evaluation.full_space) if evaluation.full_space else None,
            "evaluated_runs_trained_on": list(evaluation.trained_on),
            "evaluated_runs_that_chose_the_checkpoint": list(evaluation.chosen_by),
            "reconstruction_mse_m2": evaluation.curves.held_out,
            "made": evaluation.made,
        },
    )


def example_row(scores: Scores) -> dict[str, Any]:
    """One row of the table of test examples: MSE of positions, signed MPE of the force, and baselines.

    The signed MPE of several runs together is that of the pooled means, in which runs cancel; beside it the mean
    of |MPE| over runs, in which they do not.
    """
    row: dict[str, Any] = {"run": scores.name}
    row |= {
        f"mse_{name}_m2": scores.mse[name] for name in ("network", "total", "frozen", "constant_velocity")
    }
    for prefix, errors, sizes in (
        ("", scores.force, scores.absolute_mpe),
        ("mean_force_", scores.mean_force, scores.mean_force_absolute_mpe),
    ):
        for name, axis in FORCE_COMPONENTS.items():
            row[f"{prefix}{name}_mpe_percent"] = float(errors.mpe[axis])
            row[f"{prefix}{name}_abs_mpe_percent"] = sizes[name]
        row[f"{prefix}nrmse"] = errors.overall_nrmse
    return row


def write_csv(path: Path, scores: Sequence[Scores]) -> None:
    """All metrics: one line per `Scores`."""
    write_rows(path, [score.row() for score in scores])


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """One line per row under a line of column names; a metric without meaning is left empty."""
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
