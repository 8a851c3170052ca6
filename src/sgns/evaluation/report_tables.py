"""The tables of a report as HTML."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING

from sgns.evaluation.metrics import FORCE_COMPONENTS
from sgns.evaluation.report_words import fixed, forward_name, number
from sgns.evaluation.scores import Scores

if TYPE_CHECKING:
    from sgns.evaluation.results import Evaluation

__all__ = ["cost_table", "example_table", "force_table", "soil_table"]

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
