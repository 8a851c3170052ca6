"""The tables of an evaluation: in the report, and as files."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sgns.data.files import whole_file, write_whole
from sgns.evaluate.metrics import FORCE_COMPONENTS
from sgns.evaluate.results import Evaluation, Scores
from sgns.evaluate.words import fixed, forward_name, number

# --- The numbers of an evaluation as files: `metrics.csv`, `examples.csv` and `metrics.json` ------------


def write_tables(evaluation: Evaluation, output: Path) -> None:
    """Writes the files.

    `metrics.csv`: a row per run and one for all; `examples.csv`: the columns of the paper's table of test
    examples with the baselines beside; `metrics.json`: the first and everything around it.
    """
    scores = [run.scores for run in evaluation.runs]
    write_csv(output / "metrics.csv", [score.row() for score in (*scores, evaluation.total)])
    write_csv(output / "examples.csv", [example_row(score) for score in (*scores, evaluation.total)])
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
                "network_stepping_with_force": timing.rollout,
                "network_with_decoding": timing.decoded,
                "network_threads": 1,
                "network_repeats": timing.repeats,
            },
            "peak_memory_bytes": {
                "network_stepping_with_force": timing.rollout_bytes,
                "network_with_decoding": timing.decoded_bytes,
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


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """One line per row under a line of column names; a metric without meaning is left empty."""
    with whole_file(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        for row in rows:
            writer.writerow({key: "" if value != value else value for key, value in row.items()})


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Nested plain values as JSON that every reader takes: numbers that are not finite become null."""
    write_whole(path, json.dumps(plain(content), indent=2, allow_nan=False) + "\n")


def plain(value: Any) -> Any:
    """Mappings, sequences, arrays and numbers as JSON knows them, with None for numbers that are not finite."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


# --- The tables of a report -----------------------------------------------------------------------------

GUESSES = {"frozen": "frozen", "const. velocity": "constant_velocity"}


@dataclass(frozen=True)
class Column:
    """A column of a table: its heading and the numbers, or text, under it."""

    heading: str  # of this column
    values: Sequence[str]  # a cell per row
    text: bool = False  # whether it holds words
    group: str = ""  # a heading that it shares with its neighbours


def run_columns(evaluation: Evaluation, *columns: tuple[str, str, Callable[[Scores], str]]) -> list[Column]:
    """A row per run and one for all: their names, then columns by group, heading and what a cell holds."""
    scores = [*(run.scores for run in evaluation.runs), evaluation.total]
    names = [*(run.label for run in evaluation.runs), evaluation.total.name]
    return [
        Column("run", names, text=True),
        *(Column(heading, [cell(s) for s in scores], group=group) for group, heading, cell in columns),
    ]


def rmse(key: str) -> Callable[[Scores], str]:
    """A root-mean-square error [mm]."""
    return lambda s: number(s.rmse_mm(key))


def nrmse(vector: str) -> Callable[[Scores], str]:
    """The error of a whole force or torque."""
    return lambda s: fixed(getattr(s, vector).overall_nrmse)


def soil_columns(evaluation: Evaluation) -> list[Column]:
    """Position and surface errors."""
    errors = {"total": "total", "network": "network", "reduction": "reduction"} | GUESSES
    columns = run_columns(
        evaluation,
        *(("position RMSE [mm]", heading, rmse(key)) for heading, key in errors.items()),
        *(("skill", f"vs {name}", lambda s, key=key: fixed(s.skill(key))) for name, key in GUESSES.items()),
        ("surface RMSE [mm]", "network", rmse("surface")),
        ("surface RMSE [mm]", "frozen", rmse("surface_frozen")),
    )
    words = [run.words for run in evaluation.runs]
    return [*columns, *([Column("tool", [*words, ""], text=True)] if any(words) else [])]


def force_columns(evaluation: Evaluation) -> list[Column]:
    """Force errors of network and mean-force baseline."""
    components = ((forward_name(evaluation), 0), ("vertical", 2), ("lateral", 1))
    by_component = [
        column
        for name, axis in components
        for column in (
            (name, "MAE [N]", lambda s, axis=axis: number(float(s.force.mae[axis]))),
            (name, "NRMSE", lambda s, axis=axis: fixed(float(s.force.nrmse[axis]))),
        )
    ]
    of_body = []
    if any(run.wheel for run in evaluation.runs):
        of_body.append(("", "sinkage MAE [mm]", lambda s: number(1e3 * s.sinkage_mae)))
    if any(s.body_mse > 0.0 for s in (*(run.scores for run in evaluation.runs), evaluation.total)):
        of_body.append(("", "body misplaced, RMS [mm]", lambda s: number(1e3 * math.sqrt(s.body_mse))))
    return run_columns(
        evaluation,
        ("force NRMSE", "network", nrmse("force")),
        ("force NRMSE", "mean force", nrmse("mean_force")),
        *by_component,
        ("torque NRMSE", "network", nrmse("torque")),
        ("torque NRMSE", "mean torque", nrmse("mean_torque")),
        *of_body,
    )


def example_columns(evaluation: Evaluation) -> list[Column]:
    """The paper's table of test examples, with baselines and unsigned errors beside its columns."""
    errors = {"network": "network", "total": "total"} | GUESSES
    names = {"draft": forward_name(evaluation), "vertical": "vertical", "lateral": "lateral"}

    def percentages(component: str, vector: str, sizes: str) -> Callable[[Scores], str]:
        """Signed MPE of a run; for all of them the mean of its size, between bars."""
        axis = FORCE_COMPONENTS[component]

        def cell(s: Scores) -> str:
            if s is not evaluation.total:
                return fixed(float(getattr(s, vector).mpe[axis]), 1, sign=True)
            size = getattr(s, sizes)[component]
            return f"|{fixed(size, 1)}|" if math.isfinite(size) else fixed(size)

        return cell

    return run_columns(
        evaluation,
        *(
            ("position MSE [10⁻⁴ m²]", heading, lambda s, key=key: number(1e4 * s.mse[key]))
            for heading, key in errors.items()
        ),
        *(("force MPE [%]", name, percentages(key, "force", "absolute_mpe")) for key, name in names.items()),
        *(
            ("mean force: MPE [%]", names[key], percentages(key, "mean_force", "mean_force_absolute_mpe"))
            for key in ("draft", "vertical")
        ),
        ("force NRMSE", "network", nrmse("force")),
        ("force NRMSE", "mean force", nrmse("mean_force")),
    )


def cost_columns(evaluation: Evaluation) -> list[Column]:
    """Time and memory of solver, network and, if measured, the network on every particle: a column each."""
    timing, costs, full = evaluation.timing, evaluation.costs, evaluation.full_space
    solver, n = evaluation.total.solver_rate, evaluation.particle_count
    names = ["solver (MPM)", "network", "network, particles decoded"] + ["full space, untrained"] * bool(full)
    rows = {
        "wall seconds per simulated second": (solver, timing.rollout, timing.decoded, full and full.rollout),
        "solver's time / this": (
            *(1.0, solver / timing.rollout, solver / timing.decoded),
            full and solver / full.rollout,
        ),
        "training, wall seconds per step": (None, costs.seconds_per_step, None, full and full.training_step),
        "training, wall seconds in all": (None, costs.training_seconds, None, None),
        "numbers that describe the soil at a moment": (6 * n, 3 * evaluation.num_modes, 3 * n, 3 * n),
        "learned parameters": (None, costs.parameters, None, full and full.parameters),
        "checkpoint [MB]": (None, 1e-6 * costs.checkpoint_bytes, None, None),
        "peak memory of the process [MB]": (
            *(math.nan, 1e-6 * timing.rollout_bytes, 1e-6 * timing.decoded_bytes),
            full and 1e-6 * full.peak_bytes,
        ),
    }
    columns = zip(names, zip(*rows.values(), strict=True), strict=False)
    return [
        Column("", list(rows), text=True),
        *(Column(name, [quantity(value) for value in values]) for name, values in columns),
    ]


def quantity(value: float | None) -> str:
    """A number as people write it; whole ones with all their digits; nothing for None."""
    if value is None:
        return ""
    return f"{value:,}".replace(",", " ") if isinstance(value, int) else number(value)
