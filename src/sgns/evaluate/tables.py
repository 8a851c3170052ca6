"""The tables of an evaluation: in the report, and as files."""

from __future__ import annotations

import csv
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sgns.data.files import whole_file, write_whole
from sgns.evaluate.metrics import FORCE_COMPONENTS
from sgns.evaluate.results import Evaluation, Scores
from sgns.evaluate.words import fixed, forward_name, number

if TYPE_CHECKING:
    from sgns.evaluate.results import Evaluation


# --- The numbers of an evaluation as files: `metrics.csv`, `examples.csv` and `metrics.json` ------------


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


# --- The tables of a report as HTML ---------------------------------------------------------------------

COST_ROWS = (
    "wall seconds per simulated second",
    "solver's time / this",
    "training, wall seconds per step",
    "training, wall seconds in all",
    "numbers that describe the soil at a moment",
    "learned parameters",
    "checkpoint [MB]",
    "peak memory of the process [MB]",
)


@dataclass(frozen=True)
class Column:
    """A column of a table: its heading and the numbers, or text, under it.

    Attributes:
        heading: of this column.
        values: a cell per row.
        text: whether it holds words.
        group: a heading that it shares with its neighbours.
    """

    heading: str
    values: Sequence[str]
    text: bool = False
    group: str = ""


def table(columns: Sequence[Column], total_row: bool = True, style: str = "") -> str:
    """An HTML table; the last row is set apart as the total, `style` is a class of the page's style sheet."""
    rows = list(zip(*(column.values for column in columns), strict=True))
    body = []
    for index, row in enumerate(rows):
        mark = ' class="total"' if total_row and index == len(rows) - 1 else ""
        cells = "".join(
            f"<td{kind(column)}>{escape(cell)}</td>" for cell, column in zip(row, columns, strict=True)
        )
        body.append(f"<tr{mark}>{cells}</tr>")
    return (
        f'<div class="wide"><table class="{style}"><thead>{heading_rows(columns)}</thead>'
        f"<tbody>{''.join(body)}</tbody></table></div>"
    )


def heading_rows(columns: Sequence[Column]) -> str:
    """A row of headings, under a row of shared ones if there are any."""
    row = "<tr>" + "".join(f"<th{kind(column)}>{escape(column.heading)}</th>" for column in columns) + "</tr>"
    if not any(column.group for column in columns):
        return row
    shared = "".join(
        f'<th class="group" colspan="{len(list(same))}">{escape(name)}</th>'
        for name, same in itertools.groupby(columns, key=lambda column: column.group)
    )
    return f"<tr>{shared}</tr>{row}"


def kind(column: Column) -> str:
    """HTML attribute of a column's cells."""
    return ' class="text"' if column.text else ""


def all_scores(evaluation: Evaluation) -> list[Scores]:
    """Of every run and of all of them together."""
    return [*(run.scores for run in evaluation.runs), evaluation.total]


def run_column(evaluation: Evaluation) -> Column:
    """Names of the runs and of all of them together."""
    return Column("run", [*(run.label for run in evaluation.runs), evaluation.total.name], text=True)


def soil_table(evaluation: Evaluation) -> str:
    """Position and surface errors, a row per run and one for all."""
    scores = all_scores(evaluation)
    words = [run.words for run in evaluation.runs]
    groups = {
        "position RMSE [mm]": (
            ("total", "total"),
            ("network", "network"),
            ("reduction", "reduction"),
            ("frozen", "frozen"),
            ("const. velocity", "constant_velocity"),
        ),
        "surface RMSE [mm]": (("network", "surface"), ("frozen", "surface_frozen")),
    }
    errors = {
        group: [
            Column(heading, [number(s.rmse_mm(key)) for s in scores], group=group) for heading, key in columns
        ]
        for group, columns in groups.items()
    }
    skills = [
        Column(f"vs {name}", [fixed(s.skill(key)) for s in scores], group="skill")
        for name, key in (("frozen", "frozen"), ("const. velocity", "constant_velocity"))
    ]
    return table(
        [
            run_column(evaluation),
            *errors["position RMSE [mm]"],
            *skills,
            *errors["surface RMSE [mm]"],
            *([Column("tool", [*words, ""], text=True)] if any(words) else []),
        ]
    )


def force_table(evaluation: Evaluation) -> str:
    """Force errors of network and mean-force baseline, a row per run and one for all."""
    scores = all_scores(evaluation)
    columns = [
        run_column(evaluation),
        Column("network", [fixed(s.force.overall_nrmse) for s in scores], group="force NRMSE"),
        Column("mean force", [fixed(s.mean_force.overall_nrmse) for s in scores], group="force NRMSE"),
    ]
    for name, axis in ((forward_name(evaluation), 0), ("vertical", 2), ("lateral", 1)):
        columns += [
            Column("MAE [N]", [number(float(s.force.mae[axis])) for s in scores], group=name),
            Column("NRMSE", [fixed(float(s.force.nrmse[axis])) for s in scores], group=name),
        ]
    columns += [
        Column("network", [fixed(s.torque.overall_nrmse) for s in scores], group="torque NRMSE"),
        Column("mean torque", [fixed(s.mean_torque.overall_nrmse) for s in scores], group="torque NRMSE"),
    ]
    if any(run.wheel for run in evaluation.runs):
        columns.append(Column("sinkage MAE [mm]", [number(1e3 * s.sinkage_mae) for s in scores]))
    if any(s.body_mse > 0.0 for s in scores):
        misplaced = [number(1e3 * math.sqrt(s.body_mse)) for s in scores]
        columns.append(Column("body misplaced, RMS [mm]", misplaced))
    return table(columns)


def example_table(evaluation: Evaluation) -> str:
    """The paper's table of test examples, with baselines and unsigned errors beside its columns."""
    scores = all_scores(evaluation)
    names = {"draft": forward_name(evaluation), "vertical": "vertical", "lateral": "lateral"}
    columns = [
        run_column(evaluation),
        *(
            Column(heading, [number(1e4 * s.mse[key]) for s in scores], group="position MSE [10⁻⁴ m²]")
            for heading, key in (
                ("network", "network"),
                ("total", "total"),
                ("frozen", "frozen"),
                ("const. velocity", "constant_velocity"),
            )
        ),
        *(
            Column(name, percentages(evaluation, key, "force", "absolute_mpe"), group="force MPE [%]")
            for key, name in names.items()
        ),
        *(
            Column(
                names[key],
                percentages(evaluation, key, "mean_force", "mean_force_absolute_mpe"),
                group="mean force: MPE [%]",
            )
            for key in ("draft", "vertical")
        ),
        Column("network", [fixed(s.force.overall_nrmse) for s in scores], group="force NRMSE"),
        Column("mean force", [fixed(s.mean_force.overall_nrmse) for s in scores], group="force NRMSE"),
    ]
    return table(columns)


def percentages(evaluation: Evaluation, component: str, errors: str, sizes: str) -> list[str]:
    """Signed MPE of every run, and the mean of its size over all of them between bars."""
    axis = FORCE_COMPONENTS[component]
    signed = [fixed(float(getattr(run.scores, errors).mpe[axis]), 1, sign=True) for run in evaluation.runs]
    size = getattr(evaluation.total, sizes)[component]
    return [*signed, f"|{fixed(size, 1)}|" if math.isfinite(size) else fixed(size)]


def cost_table(evaluation: Evaluation) -> str:
    """Time and memory of solver, network and, if measured, the network on every particle: a column each."""
    timing, costs, n = evaluation.timing, evaluation.costs, evaluation.particle_count
    solver = evaluation.total.solver_rate
    columns = {
        "solver (MPM)": (solver, 1.0, None, None, 6 * n, None, None, math.nan),
        "network": (
            timing.stepping,
            solver / timing.stepping,
            costs.seconds_per_step,
            costs.training_seconds,
            3 * evaluation.num_modes,
            costs.parameters,
            1e-6 * costs.checkpoint_bytes,
            1e-6 * timing.stepping_bytes,
        ),
        "network, particles decoded": (
            timing.decoding,
            solver / timing.decoding,
            None,
            None,
            3 * n,
            None,
            None,
            1e-6 * timing.decoding_bytes,
        ),
    }
    if full := evaluation.full_space:
        columns["full space, untrained"] = (
            full.rollout,
            solver / full.rollout,
            full.training_step,
            None,
            3 * n,
            full.parameters,
            None,
            1e-6 * full.peak_bytes,
        )
    return table(
        [
            Column("", COST_ROWS, text=True),
            *(Column(heading, [quantity(value) for value in values]) for heading, values in columns.items()),
        ],
        total_row=False,
        style="costs",
    )


def quantity(value: float | None) -> str:
    """A number as people write it; whole ones with all their digits; nothing for None."""
    if value is None:
        return ""
    return f"{value:,}".replace(",", " ") if isinstance(value, int) else number(value)
