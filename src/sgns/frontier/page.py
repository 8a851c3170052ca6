"""The gathered study as one HTML page that needs nothing from outside, and its figures and table as files."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path

from sgns.data.files import whole_file, write_whole
from sgns.evaluate.report import CSS, html_page, note, picture
from sgns.evaluate.report_figures import ReportFigure
from sgns.frontier.figures import (
    COLUMNS,
    known,
    reduction_figure,
    scene_figure,
    through_time_figure,
    training_figure,
)
from sgns.frontier.point import Point, front, write_points
from sgns.frontier.study import Study, StudyScene

PAGE = "frontier.html"

WIDE = """
.wide figure { min-width: 56rem; }
.wide figcaption { position: sticky; left: 0; max-width: min(46rem, calc(100vw - 2rem)); }
figure { margin-bottom: 1.5rem; }
tr.best td { font-weight: 600; }
"""

TABLE: tuple[tuple[str, Callable[[Point], str]], ...] = (
    ("point", lambda p: ("★ " if p.paper else "") + p.label),
    ("what is varied", lambda p: p.axis),
    ("kind", lambda p: p.kind),
    ("s per s", lambda p: digits(p.cost) + ("*" if p.shared else "")),
    ("ratio", lambda p: digits(p.ratio)),
    ("with all particles, s per s", lambda p: digits(p.decoded_cost)),
    ("force NRMSE", lambda p: digits(p.force_nrmse)),
    ("mean draft, %", lambda p: digits(100.0 * p.draft_mean_error)),
    ("mean vertical, %", lambda p: digits(100.0 * p.vertical_mean_error)),
    ("torque NRMSE", lambda p: digits(p.torque_nrmse)),
    ("soil, mm", lambda p: digits(p.position_rmse_mm)),
    ("surface, mm", lambda p: digits(p.surface_rmse_mm)),
    ("sinkage, mm", lambda p: digits(p.sinkage_error_mm)),
    ("own force NRMSE", lambda p: digits(p.own_force_nrmse)),
    ("own soil, mm", lambda p: digits(p.own_position_rmse_mm)),
    ("skill", lambda p: digits(p.skill_frozen)),
    ("training, s", lambda p: digits(p.training_s)),
    ("displacement energy, %", lambda p: digits(100.0 * p.energy)),
    ("note", lambda p: p.note),
)


def write_study(study: Study, points: Sequence[Point]) -> Path:
    """Writes points.csv, figures/*.png and frontier.html into the study's folder; returns the page."""
    write_points(study.folder / "points.csv", points)
    folder = study.folder / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    parts = []
    for scene in study.scenes:
        chosen = [point for point in points if point.scene == scene.name]
        if not chosen:
            continue
        figures = scene_figures(scene, chosen)
        for figure in figures:
            with whole_file(folder / f"{figure.name}.png") as temporary:
                temporary.write_bytes(figure.png)
        parts.append((scene.name, f"Scene: {scene.name}", scene_content(scene, chosen, figures)))
    parts.append(("made", "How this was made", made(study, points)))
    page = study.folder / PAGE
    write_whole(page, rendered(study, parts))
    return page


def scene_figures(scene: StudyScene, points: Sequence[Point]) -> list[ReportFigure]:
    """The pictures of a scene; those that would be empty are left out."""
    found = []
    for column, words in COLUMNS.items():
        if known(points, column):
            name = f"{scene.name}_{column.removesuffix('_mm')}"
            image = scene_figure(points, column, scene.bands, f"{scene.name}: {words} over time")
            found.append(
                ReportFigure(
                    name,
                    f"{scene.name}: {words}",
                    "Every operating point; a star is one of the paper's. Left of the dashed line is faster than real "
                    "time.",
                    image,
                )
            )
    best = {
        id(p): p for column in ("force_nrmse", "position_rmse_mm") for p in front(points, column, scene.bands)
    }
    through = [p for p in best.values() if not math.isnan(p.force_nrmse_q4)][:14]
    if through:
        image = through_time_figure(through, f"{scene.name}: errors through the run, points of the fronts")
        caption = "Force: in each quarter. Soil: at the end of each quarter, where errors have added up."
        found.append(
            ReportFigure(f"{scene.name}_through_time", f"{scene.name}: error through time", caption, image)
        )
    trained = [p for p in points if p.training_s > 0 and not math.isnan(p.own_force_nrmse)]
    if trained:
        image = training_figure(trained, f"{scene.name}: what training buys")
        caption = (
            "Errors against the solver that made the training runs, on its held-out runs, over training time."
        )
        found.append(
            ReportFigure(
                f"{scene.name}_training", f"{scene.name}: error against training time", caption, image
            )
        )
    reduced = [p for p in points if p.kind == "reduction" and p.own_position_rmse_mm > 0]
    if reduced:
        image = reduction_figure(reduced, f"{scene.name}: what r modes leave out")
        caption = (
            "No simulation: held-out runs projected onto the modes. No surrogate with r modes is better."
        )
        found.append(
            ReportFigure(f"{scene.name}_reduction", f"{scene.name}: reduction alone", caption, image)
        )
    return found


def scene_content(scene: StudyScene, points: Sequence[Point], figures: Sequence[ReportFigure]) -> str:
    """Words, pictures and table of a scene."""
    bands = ", ".join(
        f"{COLUMNS[key].split(',')[0]} {value:g}{' mm' if key.endswith('_mm') else ''}"
        for key, value in scene.bands.items()
    )
    cases = "; ".join(f"{name}: {' '.join(changes)}" for name, changes in scene.settings["cases"].items())
    words = note(
        f"Reference: {scene.reference.label} ({' '.join(scene.reference.set)}). How wrong it may be "
        f"itself (where from: conf/study): {bands or 'not known'}; points below that cannot be told apart. "
        f"Cases that every error is taken over: {cases}. Settings that a label does not name are those of "
        f"scene={scene.settings['scene']}."
    )
    pictures = "".join(f'<div class="wide">{picture(figure)}</div>' for figure in figures)
    return words + pictures + table(scene, points)


def table(scene: StudyScene, points: Sequence[Point]) -> str:
    """All points, those on a front in bold."""
    best = {id(p) for column in COLUMNS for p in front(points, column, scene.bands)}
    shown = [
        (name, cell)
        for number, (name, cell) in enumerate(TABLE)
        if number < 5 or any(cell(p) not in ("", "–") for p in points)
    ]
    head = "".join(f'<th class="{css(name)}">{escape(name)}</th>' for name, _ in shown)
    body = "".join(
        f'<tr class="{"best" if id(p) in best else ""}">'
        + "".join(f'<td class="{css(name)}">{escape(cell(p))}</td>' for name, cell in shown)
        + "</tr>"
        for p in points
    )
    return f'<div class="wide"><table><tr>{head}</tr>{body}</table></div>' + note(
        "Bold: on one of the fronts. “s per s”: wall seconds per simulated second on one core; with *: processor "
        "seconds, because other work shared the core; “ratio”: to the reference workload "
        "measured in the same run; “own”: against the solver that made the training runs, over its test runs; "
        "“skill”: 1 − squared error / that of a bed in which nothing moves. All columns: points.csv."
    )


def css(name: str) -> str:
    return "text" if name in ("point", "what is varied", "kind", "note") else ""


def made(study: Study, points: Sequence[Point]) -> str:
    """Machine, commands, and what the times include."""
    machines = sorted({f"one core of {p.machine}" for p in points if p.machine})
    workloads = [p.workload_wall_s_per_simulated_s for p in points if p.workload_wall_s_per_simulated_s > 0]
    facts = {
        "study": study.name,
        "machine": "; ".join(machines),
        "commands": "; ".join(sorted({p.command for p in points if p.command})),
        "package": "; ".join(sorted({f"{p.version} {p.commit}".strip() for p in points if p.version})),
        "points": str(len(points)),
        "timing": "medians of repeats on one core and one thread, warm: kernels were compiled and files in memory "
        "before the clock started. The solver's repeats are stretches of its runs.",
        "reference workload": f"sgns simulate scene=excavation while the plate cuts, beside every point: "
        f"{digits(min(workloads))} to {digits(max(workloads))} s per simulated s in this study"
        if workloads
        else "",
    }
    for kind in dict.fromkeys(p.kind for p in points):
        for words in dict.fromkeys(p.includes for p in points if p.kind == kind and p.includes):
            facts[f"in the time, {kind}"] = "; ".join(
                filter(None, (facts.get(f"in the time, {kind}"), words))
            )
    rows = "".join(f"<tr><td>{escape(k)}</td><td>{escape(v)}</td></tr>" for k, v in facts.items() if v)
    return f'<table class="made">{rows}</table>'


def rendered(study: Study, parts: Sequence[tuple[str, str, str]]) -> str:
    """The whole page."""
    title = f"What accuracy costs in time: study {study.name}"
    words = (
        "Settings of the solver and surrogates on one scale: the wall time of a simulated second on one core against "
        "the error beside the most accurate run that was affordable. Read off which point is fast enough and good "
        "enough; sgns advise answers the same question on the command line."
    )
    return html_page(title, CSS + WIDE, f"<p>{escape(words)}</p>", parts)


def digits(value: float) -> str:
    """A number to three digits, – where there is none."""
    return "–" if math.isnan(value) else f"{value:.3g}"
