"""One self-contained HTML page about an evaluation: words, tables, pictures.

The page needs no script and nothing from outside; its words follow from the numbers, good or bad.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from sgns.data.files import whole_file, write_whole
from sgns.evaluate.report_figures import FigureGroup, ReportFigure, report_figures
from sgns.evaluate.results import overlap_warning
from sgns.evaluate.tables import cost_table, example_table, force_table, soil_table
from sgns.evaluate.words import cost_note, example_note, fixed, force_note, number, soil_note, summary

if TYPE_CHECKING:
    from sgns.evaluate.results import Evaluation


CSS = """
body { font: 16px/1.5 system-ui, sans-serif; color: #1a1a1a; background: #fff; margin: 0 auto;
       max-width: 76rem; padding: 1rem; }
h1 { font-size: 1.6rem; line-height: 1.2; margin: 0.5rem 0; }
h2 { font-size: 1.2rem; margin: 2rem 0 0.5rem; border-bottom: 1px solid #ccc; }
p, .note, figcaption { max-width: 46rem; overflow-wrap: anywhere; }
nav { font-size: 0.88rem; line-height: 2; }
nav a { margin-right: 1rem; white-space: nowrap; color: #0a4f8a; }
.warning { border-left: 4px solid #d55e00; padding: 0.4rem 0.8rem; background: #fdf3ec; }
.numbers { display: flex; flex-wrap: wrap; gap: 0.8rem; margin: 1rem 0; }
.numbers div { flex: 1 1 9rem; border: 1px solid #ccc; border-radius: 6px; padding: 0.6rem 0.8rem; }
.numbers b { display: block; font-size: 1.5rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.88rem; font-variant-numeric: tabular-nums; }
th, td { padding: 0.25rem 0.6rem; border-bottom: 1px solid #ddd; text-align: right; vertical-align: bottom; }
th { font-weight: 600; }
th.group { text-align: center; border-bottom: none; padding-bottom: 0; }
th.text, td.text { text-align: left; }
.wide td.text:first-child { position: sticky; left: 0; background: #fff; min-width: 4rem; }
.wide td.text:last-child { white-space: nowrap; }
.costs td.text { min-width: 8.5rem; }
tr.total td { font-weight: 600; border-top: 2px solid #1a1a1a; }
.pictures { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(17rem, 100%), 1fr)); gap: 1rem; }
figure { margin: 0; break-inside: avoid; }
figure img { width: 100%; height: auto; }
figcaption, .note { font-size: 0.88rem; color: #444; }
.made td { text-align: left; vertical-align: top; overflow-wrap: anywhere; }
@page { margin: 14mm; }
@media print {
  html { font-size: 9pt; } body { max-width: none; padding: 0; font-size: 9pt; } nav { display: none; }
  p, .note, figcaption { max-width: none; } table { font-size: 6.5pt; }
  .wide { overflow: visible; break-inside: avoid; }
  th, td { padding: 0.1rem 0.2rem; } .wide td.text:last-child { white-space: normal; }
  .numbers div { flex-basis: 8rem; } .pictures { grid-template-columns: repeat(2, 1fr); gap: 5mm; }
  tr { break-inside: avoid; } h2, h2 + .note { break-after: avoid; } }
"""
# --- page -------------------------------------------------------------------------------------------------


def picture(figure: ReportFigure) -> str:
    """A figure with its caption, the picture inside the page."""
    data = base64.b64encode(figure.png).decode("ascii")
    return (
        f'<figure><img alt="{escape(figure.title, quote=True)}" src="data:image/png;base64,{data}">'
        f"<figcaption><b>{escape(figure.title)}.</b> {escape(figure.caption)}</figcaption></figure>"
    )


def section(anchor: str, heading: str, content: str) -> str:
    """A heading that the page's contents can point at, and what stands under it."""
    return f'<h2 id="{anchor}">{escape(heading)}</h2>\n{content}'


def note(text: str) -> str:
    """A paragraph of explanation."""
    return f'<p class="note">{escape(text)}</p>'


def sections(evaluation: Evaluation, groups: Sequence[FigureGroup]) -> list[tuple[str, str]]:
    """Headings and contents of the page, in order."""
    made = "".join(
        f"<tr><td>{escape(name)}</td><td>{escape(value)}</td></tr>" for name, value in evaluation.made.items()
    )
    return [
        ("Soil", soil_table(evaluation) + note(soil_note(evaluation))),
        ("Force on the tool", force_table(evaluation) + note(force_note(evaluation))),
        ("Test examples", example_table(evaluation) + note(example_note())),
        ("Time and memory", cost_table(evaluation) + note(cost_note(evaluation))),
        *(
            (
                group.heading,
                note(group.note) + f'<div class="pictures">{"".join(map(picture, group.figures))}</div>',
            )
            for group in groups
        ),
        ("How this was made", f'<table class="made">{made}</table>'),
    ]


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


def html_page(title: str, style: str, introduction: str, parts: Sequence[tuple[str, str, str]]) -> str:
    """A whole page.

    Args:
        title: of the page.
        style: its style sheet.
        introduction: HTML between title and contents.
        parts: anchor, heading and HTML of each section.
    """
    contents = "".join(f'<a href="#{anchor}">{escape(heading)}</a> ' for anchor, heading, _ in parts)
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<style>{style}</style>
</head>
<body>
<h1>{escape(title)}</h1>
{introduction}
<nav>{contents}</nav>
{chr(10).join(section(*part) for part in parts)}
</body>
</html>
"""


def render_report(evaluation: Evaluation, groups: Sequence[FigureGroup]) -> str:
    """The whole page as HTML.

    Args:
        evaluation: what was measured.
        groups: pictures to include, in order, after the tables.
    """
    title = f"Predicted against simulated soil: {evaluation.dataset}, {evaluation.split} runs"
    warning = overlap_warning(evaluation)
    introduction = (
        f"<p>{escape(summary(evaluation))}</p>\n",
        f'<p class="warning">{escape(warning)}</p>\n' if warning else "",
        headline(evaluation),
    )
    parts = [(f"s{count}", *part) for count, part in enumerate(sections(evaluation, groups), start=1)]
    return html_page(title, CSS, "".join(introduction), parts)


def write_report(evaluation: Evaluation, output: Path) -> Path:
    """Draws the figures into `figures/` and writes `report.html`; every file is complete or not there at all.

    Returns:
        Path of the page.
    """
    groups = report_figures(evaluation)
    folder = output / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    for group in groups:
        for figure in group.figures:
            with whole_file(folder / f"{figure.name}.png") as temporary:
                temporary.write_bytes(figure.png)
    path = output / "report.html"
    write_whole(path, render_report(evaluation, groups))
    return path
