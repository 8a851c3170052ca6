"""One self-contained HTML page about an evaluation: words, tables, pictures.

The page needs no script and nothing from outside; its words follow from the numbers, good or bad.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from sgns.evaluation.report_figures import ReportFigure, report_figures
from sgns.evaluation.report_words import fixed, force_note, number, soil_note, summary, time_note
from sgns.wholefile import write_whole

if TYPE_CHECKING:
    from sgns.evaluation.results import Evaluation

__all__ = ["render_report", "write_report"]

CSS = """
body { font: 16px/1.5 system-ui, sans-serif; color: #1a1a1a; background: #fff; margin: 0 auto;
       max-width: 62rem; padding: 1rem; }
h1 { font-size: 1.6rem; line-height: 1.2; margin: 0.5rem 0; }
h2 { font-size: 1.2rem; margin: 2rem 0 0.5rem; border-bottom: 1px solid #ccc; }
.numbers { display: flex; flex-wrap: wrap; gap: 0.8rem; margin: 1rem 0; }
.numbers div { flex: 1 1 11rem; border: 1px solid #ccc; border-radius: 6px; padding: 0.6rem 0.8rem; }
.numbers b { display: block; font-size: 1.5rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.88rem; font-variant-numeric: tabular-nums; }
th, td { padding: 0.25rem 0.6rem; border-bottom: 1px solid #ddd; text-align: right; vertical-align: bottom; }
th.text, td.text { text-align: left; white-space: nowrap; }
tr.total td { font-weight: 600; border-top: 2px solid #1a1a1a; }
figure { margin: 1.2rem 0; break-inside: avoid; }
figure img { max-width: 100%; height: auto; }
figcaption, .note { font-size: 0.88rem; color: #444; }
.made td { text-align: left; vertical-align: top; overflow-wrap: anywhere; }
@media print {
  html { font-size: 10pt; } body { max-width: none; font-size: 10pt; } .wide { overflow: visible; }
  table { font-size: 7pt; } td.text { white-space: normal; } figure img { max-height: 11cm; }
  th, td { padding: 0.1rem 0.25rem; } tr { break-inside: avoid; } h2 { break-after: avoid; } }
"""


@dataclass(frozen=True)
class Column:
    """A column of a table: its heading and the numbers, or text, under it."""

    heading: str
    values: Sequence[str]
    text: bool = False


# --- tables -----------------------------------------------------------------------------------------------


def table(columns: Sequence[Column], total_row: bool = True) -> str:
    """An HTML table; the last row is set apart as the total."""
    kinds = [' class="text"' if column.text else "" for column in columns]
    head = "".join(
        f"<th{kind}>{escape(column.heading)}</th>" for column, kind in zip(columns, kinds, strict=True)
    )
    rows = list(zip(*(column.values for column in columns), strict=True))
    body = []
    for index, row in enumerate(rows):
        mark = ' class="total"' if total_row and index == len(rows) - 1 else ""
        cells = "".join(f"<td{kind}>{escape(cell)}</td>" for cell, kind in zip(row, kinds, strict=True))
        body.append(f"<tr{mark}>{cells}</tr>")
    return (
        f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{"".join(body)}</tbody></table></div>'
    )


def run_column(evaluation: Evaluation) -> Column:
    """Names of the runs and of all of them together."""
    return Column("run", [*(run.label for run in evaluation.runs), evaluation.total.name], text=True)


def soil_table(evaluation: Evaluation) -> str:
    """Position and surface errors, a row per run and one for all."""
    scores = [*(run.scores for run in evaluation.runs), evaluation.total]
    words = [run.words for run in evaluation.runs]
    return table(
        [
            run_column(evaluation),
            *([Column("tool", [*words, ""], text=True)] if any(words) else []),
            *(
                Column(heading, [number(s.rmse_mm(key)) for s in scores])
                for heading, key in (
                    ("total RMSE [mm]", "total"),
                    ("network [mm]", "network"),
                    ("reduction [mm]", "reduction"),
                    ("frozen [mm]", "frozen"),
                    ("const. velocity [mm]", "constant_velocity"),
                )
            ),
            Column("skill vs frozen", [fixed(s.skill("frozen")) for s in scores]),
            Column("skill vs const. velocity", [fixed(s.skill("constant_velocity")) for s in scores]),
            Column("surface [mm]", [number(s.rmse_mm("surface")) for s in scores]),
            Column("surface, frozen [mm]", [number(s.rmse_mm("surface_frozen")) for s in scores]),
        ]
    )


def force_table(evaluation: Evaluation) -> str:
    """Force errors of network and mean-force baseline, a row per run and one for all."""
    scores = [*(run.scores for run in evaluation.runs), evaluation.total]
    columns = [
        run_column(evaluation),
        Column("NRMSE", [fixed(s.force.overall_nrmse) for s in scores]),
        Column("NRMSE, mean force", [fixed(s.mean_force.overall_nrmse) for s in scores]),
    ]
    for name, axis in (("draft", 0), ("vertical", 2)):
        columns += [
            Column(f"{name} MAE [N]", [number(float(s.force.mae[axis])) for s in scores]),
            Column(f"{name} NRMSE", [fixed(float(s.force.nrmse[axis])) for s in scores]),
            Column(f"{name} MPE [%]", [fixed(float(s.force.mpe[axis]), 1, sign=True) for s in scores]),
        ]
    columns += [
        Column("lateral MAE [N]", [number(float(s.force.mae[1])) for s in scores]),
        Column("torque NRMSE", [fixed(s.torque.overall_nrmse) for s in scores]),
        Column("torque NRMSE, mean", [fixed(s.mean_torque.overall_nrmse) for s in scores]),
    ]
    return table(columns)


def time_table(evaluation: Evaluation) -> str:
    """Wall time per simulated second of solver and network."""
    timing, solver = evaluation.timing, evaluation.total.solver_rate
    rows = [
        ("material point solver, as recorded in the run files (mean)", solver),
        ("network, steps with force, soil in the subspace", timing.stepping),
        ("network, every frame also decoded to all particles", timing.decoding),
    ]
    return table(
        [
            Column("what", [name for name, _ in rows], text=True),
            Column("wall seconds per simulated second", [number(value) for _, value in rows]),
            Column("solver / this", [number(solver / value) if value > 0.0 else "–" for _, value in rows]),
        ],
        total_row=False,
    )


# --- page -------------------------------------------------------------------------------------------------


def picture(figure: ReportFigure) -> str:
    """A figure with its caption, the picture inside the page."""
    data = base64.b64encode(figure.png).decode("ascii")
    return (
        f'<figure><img alt="{escape(figure.title, quote=True)}" src="data:image/png;base64,{data}">'
        f"<figcaption><b>{escape(figure.title)}.</b> {escape(figure.caption)}</figcaption></figure>"
    )


def speed_box(evaluation: Evaluation) -> tuple[str, str]:
    """How many times faster, or slower, the network is than the solver."""
    ratio = evaluation.total.solver_rate / evaluation.timing.stepping
    if math.isnan(ratio):
        return "–", "speed beside the solver, whose time is not recorded"
    if ratio >= 1.0:
        return f"{number(ratio, 2)} ×", "faster than the solver, one thread"
    return f"{number(1.0 / ratio, 2)} ×", "slower than the solver, one thread"


def headline(evaluation: Evaluation) -> str:
    """The four numbers that matter most."""
    total = evaluation.total
    boxes = (
        (fixed(total.skill("frozen")), "position skill against a bed in which nothing moves"),
        (
            f"{number(total.rmse_mm('total'), 2)} mm",
            f"position error; frozen {number(total.rmse_mm('frozen'), 2)} mm",
        ),
        (
            fixed(total.force.overall_nrmse),
            f"force NRMSE; mean force {fixed(total.mean_force.overall_nrmse)}",
        ),
        speed_box(evaluation),
    )
    return (
        '<div class="numbers">'
        + "".join(f"<div><b>{escape(b)}</b>{escape(t)}</div>" for b, t in boxes)
        + "</div>"
    )


def render_report(evaluation: Evaluation, figures: Sequence[ReportFigure]) -> str:
    """The whole page as HTML.

    Args:
        evaluation: what was measured.
        figures: pictures to include, in order, under the headings that they name.
    """
    title = f"Predicted against simulated soil: {evaluation.dataset}, {evaluation.split} runs"
    made = "".join(
        f"<tr><td>{escape(name)}</td><td>{escape(value)}</td></tr>" for name, value in evaluation.made.items()
    )
    groups = dict.fromkeys(figure.group for figure in figures)
    pictures = "".join(
        f"<h2>{escape(group)}</h2>" + "".join(picture(f) for f in figures if f.group == group)
        for group in groups
    )
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<style>{CSS}</style>
</head>
<body>
<h1>{escape(title)}</h1>
<p>{escape(summary(evaluation))}</p>
{headline(evaluation)}
<h2>Soil</h2>
{soil_table(evaluation)}
<p class="note">{escape(soil_note(evaluation))}</p>
<h2>Force on the tool</h2>
{force_table(evaluation)}
<p class="note">{escape(force_note(evaluation))}</p>
<h2>Time</h2>
{time_table(evaluation)}
<p class="note">{escape(time_note(evaluation))}</p>
{pictures}
<h2>How this was made</h2>
<table class="made">{made}</table>
</body>
</html>
"""


def write_report(evaluation: Evaluation, output: Path) -> Path:
    """Draws the figures into `figures/` and writes `report.html`, complete or not at all.

    Returns:
        Path of the page.
    """
    figures = report_figures(evaluation)
    folder = output / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    for figure in figures:
        (folder / f"{figure.name}.png").write_bytes(figure.png)
    path = output / "report.html"
    write_whole(path, render_report(evaluation, figures))
    return path
