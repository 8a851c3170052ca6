"""`sgns frontier`: measure what accuracy costs in time, and gather it into a table, figures and a page."""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import LogFormatter, NullFormatter
from omegaconf import DictConfig, OmegaConf

from sgns.config import UserError
from sgns.data.files import file_lock, require_replaceable, write_whole
from sgns.evaluate.figures import new_figure, png, round_numbers
from sgns.evaluate.report import PAGES, ReportFigure, write_figures
from sgns.frontier.observation import Observation, compare, errors
from sgns.frontier.point import ERRORS, Point, effective_error, front, usable, write_points
from sgns.frontier.study import AXES, Study, StudyScene, composed, composed_scene

log = logging.getLogger(__name__)

PAGE = "frontier.html"
MOST_THROUGH_TIME = 14  # points of the fronts whose errors through the run are drawn


def main(cfg: DictConfig) -> None:
    """The command."""
    study = Study.from_settings(OmegaConf.to_container(cfg.study, resolve=True), Path(cfg.output))
    axes = {"all": AXES, "none": ()}.get(cfg.axis, (cfg.axis,))
    folder = study.folder
    measured = (*(folder / "points").glob("*.json"), *(folder / "observations").glob("*.npz"))
    require_replaceable(
        *(folder / name for name in ("study.yaml", "points.csv", PAGE)),
        *(folder / "figures").glob("*.png"),
        *(file for file in measured if not file.is_file()),  # those that are there are read only
    )
    if axes:
        for scene in study.scenes:  # what is wrong there is said now, not after hours
            composed("reduce", [f"dataset={scene.dataset}"])
            for overrides in scene.cases.values():
                composed_scene(overrides)
        with file_lock(folder / "study.yaml", wait=True):  # what it says is read and added to
            study.record()
        from sgns.frontier.measure import measure  # training takes seconds to import

        for axis in axes:
            measure(study, axis)
        if not any(study.file(s.name, "solver", s.reference.label).exists() for s in study.scenes):
            # Another process is still at it; what was measured here is kept.
            log.info("no reference is there yet, so nothing can be judged; later: sgns frontier axis=none")
            return
    with file_lock(folder / PAGE, wait=True):  # of several that gather at once the last sees all points
        page = write_study(study, points_with_errors(study))
    log.info("%s and the table and figures beside it", page)


def points_with_errors(study: Study) -> list[Point]:
    """All points of a study with their errors against the reference of their scene, fastest last.

    Raises:
        UserError: no reference has been measured.
    """
    found: list[Point] = []
    measured = study.points()
    for scene in study.scenes:
        points = [(point, cases) for point, cases in measured if point.scene == scene.name]
        label = scene.reference.label
        reference = next((p for p, _ in points if (p.kind, p.label) == ("solver", label)), None)
        if reference:
            runs = {case: study.observation(reference, case) for case in scene.cases}
            compared = [with_errors(study, scene, point, cases, runs) for point, cases in points]
            found += sorted(compared, key=lambda p: (-math.inf if math.isnan(p.cost) else -p.cost, p.label))
        elif points:
            log.warning(
                "%s: the reference (%s) is not there yet, so nothing can be judged; sgns frontier axis=solver",
                scene.name,
                label,
            )
    if not found:
        raise UserError(
            f"{study.folder} holds no points with a reference; measure some: sgns frontier "
            f"study={study.name} output={study.folder}"
        )
    return found


def with_errors(
    study: Study, scene: StudyScene, point: Point, cases: Iterable[str], reference: Mapping[str, Observation]
) -> Point:
    """A point with its errors; without any if it is the reference or did not finish."""
    runs = {case: study.observation(point, case) for case in cases if case in reference}
    if point.axis == "reference" or not runs or point.note.startswith("stopped"):
        return point
    if not all(run.finite for run in runs.values()):
        return replace(point, note=point.note or "left the range: not finite")
    compared = [compare(run, reference[case]) for case, run in runs.items()]
    columns: dict[str, Any] = errors(compared, free_body=scene.free_body)
    return replace(point, **columns)


# --- The gathered study as a table, figures, and one HTML page that needs nothing from outside ----------

TABLE = (  # heading, column of `Point`, what it is multiplied with
    ("with all particles, s per s", "decoded_cost", 1.0),
    ("pose by pose, s per s", "stepped_cost", 1.0),
    ("force NRMSE", "force_nrmse", 1.0),
    ("mean draft, %", "draft_mean_error", 100.0),
    ("mean vertical, %", "vertical_mean_error", 100.0),
    ("torque NRMSE", "torque_nrmse", 1.0),
    ("soil, mm", "position_rmse_mm", 1.0),
    ("surface, mm", "surface_rmse_mm", 1.0),
    ("sinkage, mm", "sinkage_error_mm", 1.0),
    ("own force NRMSE", "own_force_nrmse", 1.0),
    ("own soil, mm", "own_position_rmse_mm", 1.0),
    ("skill", "skill_frozen", 1.0),
    ("training, s", "training_s", 1.0),
    ("displacement energy, %", "energy", 100.0),
)


def write_study(study: Study, points: Sequence[Point]) -> Path:
    """Writes points.csv, figures/*.png and frontier.html into the study's folder; returns the page."""
    write_points(study.folder / "points.csv", points)
    scenes = []
    for scene in study.scenes:
        if chosen := [point for point in points if point.scene == scene.name]:
            figures = scene_figures(scene, chosen)
            write_figures(figures, study.folder / "figures")
            scenes.append((scene, figures, *scene_table(scene, chosen)))
    page = study.folder / PAGE
    text = PAGES.get_template("frontier/page.html.j2").render(
        title=f"What accuracy costs in time: study {study.name}",
        contents=[*((s[0].name, f"Scene: {s[0].name}") for s in scenes), ("made", "How this was made")],
        scenes=scenes,
        made=made(study, points),
        errors=ERRORS,
    )
    write_whole(page, text)
    return page


def scene_figures(scene: StudyScene, points: Sequence[Point]) -> list[ReportFigure]:
    """The pictures of a scene; those that would be empty are left out."""
    name = scene.name
    drawn = [
        (
            column.removesuffix("_mm"),
            words,
            "Every operating point; a star is one of the paper's. Left of the dashed line is faster than real time.",
            scene_figure(points, column, scene.bands, f"{name}: {words} over time"),
        )
        for column, words in ERRORS.items()
        if known(points, column)
    ]
    best = on_fronts(scene, points, ("force_nrmse", "position_rmse_mm"))
    if through_time := [p for p in best if not math.isnan(p.force_nrmse_q4)][:MOST_THROUGH_TIME]:
        caption = "Force: in each quarter. Soil: at the end of each quarter, where errors have added up."
        image = through_time_figure(through_time, f"{name}: errors through the run, points of the fronts")
        drawn.append(("through_time", "error through time", caption, image))
    if trained := [p for p in points if p.training_s > 0 and not math.isnan(p.own_force_nrmse)]:
        caption = (
            "Errors against the solver that made the training runs, on its held-out runs, over training time."
        )
        image = training_figure(trained, f"{name}: what training buys")
        drawn.append(("training", "error against training time", caption, image))
    if reduced := [p for p in points if p.kind == "reduction" and p.own_position_rmse_mm > 0]:
        caption = (
            "No simulation: held-out runs projected onto the modes. No surrogate with r modes is better."
        )
        image = reduction_figure(reduced, f"{name}: what r modes leave out")
        drawn.append(("reduction", "reduction alone", caption, image))
    return [
        ReportFigure(f"{name}_{suffix}", f"{name}: {words}", caption, image)
        for suffix, words, caption, image in drawn
    ]


def on_fronts(scene: StudyScene, points: Sequence[Point], columns: Iterable[str]) -> list[Point]:
    """The points that are on the front of one of these errors, each once."""
    found = [point for column in columns for point in front(points, column, scene.bands)]
    return list(dict.fromkeys(found))


def scene_table(scene: StudyScene, points: Sequence[Point]) -> tuple[list[str], list[tuple[bool, list[str]]]]:
    """Headings, and for each point whether it is on a front, and its cells; columns that say nothing are left out."""
    columns = {
        "point": [("★ " if p.paper else "") + p.label for p in points],
        "what is varied": [p.axis for p in points],
        "kind": [p.kind for p in points],
        "s per s": [digits(p.cost) + ("*" if p.shared else "") for p in points],
        "ratio": [digits(p.ratio) for p in points],
    }
    more = {heading: [digits(factor * getattr(p, name)) for p in points] for heading, name, factor in TABLE}
    for heading, cells in (more | {"note": [p.note for p in points]}).items():
        if any(cell not in ("", "–") for cell in cells):
            columns[heading] = cells
    best = on_fronts(scene, points, ERRORS)
    rows = zip(*columns.values(), strict=True)
    return list(columns), [(p in best, list(row)) for p, row in zip(points, rows, strict=True)]


def made(study: Study, points: Sequence[Point]) -> dict[str, str]:
    """Machine, commands, and what the times include."""

    def all_of(values: Iterable[str]) -> str:
        return "; ".join(dict.fromkeys(filter(None, values)))

    workloads = [p.workload_wall_s_per_simulated_s for p in points if p.workload_wall_s_per_simulated_s > 0]
    facts = {
        "study": study.name,
        "machine": all_of(sorted(f"one core of {p.machine}" for p in points if p.machine)),
        "commands": all_of(sorted(p.command for p in points)),
        "package": all_of(sorted(f"{p.version} {p.commit}".strip() for p in points if p.version)),
        "points": str(len(points)),
        "timing": "medians of repeats on one core and one thread, warm: kernels were compiled and files in memory "
        "before the clock started. The solver's repeats are stretches of its runs.",
        "reference workload": f"sgns simulate scene=excavation while the plate cuts, beside every point: "
        f"{digits(min(workloads))} to {digits(max(workloads))} s per simulated s in this study"
        if workloads
        else "",
    }
    for kind in dict.fromkeys(p.kind for p in points):
        facts[f"in the time, {kind}"] = all_of(p.includes for p in points if p.kind == kind)
    return {name: value for name, value in facts.items() if value}


def digits(value: float) -> str:
    """A number to three digits, – where there is none."""
    return "–" if math.isnan(value) else f"{value:.3g}"


# --- Figures: error over time of all points of a scene, with the front that none beats -------------------

STYLES = {
    "solver": ("o", "#0072b2"),
    "surrogate": ("^", "#d55e00"),
    "full space": ("s", "#009e73"),
    "reduction": ("D", "#cc79a7"),
}
DPI = 110
QUARTERS = (1, 2, 3, 4)
plain_text = rc_context({"text.parse_math": False})
"""For figures that show labels from anybody's table, in which $ is no formula."""


def known(points: Sequence[Point], column: str) -> list[Point]:
    """Usable points whose error is known."""
    return [point for point in points if usable(point) and not math.isnan(getattr(point, column))]


def column_of(points: Sequence[Point], column: str) -> list[float]:
    """Values of a column of some points."""
    return [getattr(point, column) for point in points]


@plain_text
def scene_figure(points: Sequence[Point], column: str, bands: Mapping[str, float], title: str) -> bytes:
    """Error of a column over wall time per simulated second of a scene's points, as PNG.

    `bands` say how wrong the reference may be, by column.
    """
    shown = known(points, column)
    references = [p for p in points if p.axis == "reference" and not math.isnan(p.cost)]
    band = bands.get(column, 0.0)
    figure = new_figure(13, 8.5, dpi=DPI)
    axes = logarithmic(figure.add_subplot(title=title))
    axes.set_xlabel(
        "seconds of one core per simulated second: wall time, median of repeats (bar: fastest to slowest); "
        "without bar: processor time, the core was shared"
    )
    axes.set_ylabel(f"{ERRORS[column]}, against the most accurate run (bar: best to worst case)")
    draw_points(axes, shown, column)
    # Room for labels around all points and the band.
    times = [1.0, *column_of([*shown, *references], "cost")]
    errors = [e for e in [*column_of([*shown, *references], column), band] if e > 0.0]
    axes.set(xlim=(min(times) / 2.5, max(times) * 3.0), ylim=(min(errors) / 1.8, max(errors) * 1.5))
    axes.axvline(1.0, color="k", ls="--", lw=1, zorder=1)
    low, high = axes.get_ylim()
    axes.text(1.0, high, " real time ", ha="right", va="top", rotation=90, fontsize=8)
    if band:
        axes.axhspan(low, band, color="0.92", zorder=0)
        words = "  below: within the reference's own error"
        axes.text(axes.get_xlim()[0], band, words, fontsize=8, va="top", color="0.35")
    best = [(p.cost, effective_error(p, column, bands)) for p in front(points, column, bands)]
    stairs = best[:1]
    for (_, before), (time, error) in itertools.pairwise(best):
        stairs += [(time, before), (time, error)]
    axes.plot(*zip(*stairs, strict=True), "k-", lw=1.2, zorder=2, label="front: nothing faster is as good")
    labels = [(p.cost, getattr(p, column), f"★ {p.label}" if p.paper else p.label) for p in shown]
    for point in references:
        axes.axvline(point.cost, color="0.5", ls=":", lw=1)
        labels.append((point.cost, max(band, low * 1.3), f"reference: {point.label}"))
    axes.legend(loc="lower left", fontsize=8)
    fix_layout(figure)
    place_labels(axes, labels, line=stairs)
    return png(figure)


def draw_points(axes: Axes, points: Sequence[Point], column: str) -> None:
    """Markers by kind with their bars; the paper's own points are stars."""
    for (kind, (marker, colour)), paper in itertools.product(STYLES.items(), (False, True)):
        chosen = [p for p in points if p.kind == kind and p.paper == paper]
        if not chosen:
            continue
        has_cases = hasattr(chosen[0], f"{column}_low")
        axes.errorbar(
            column_of(chosen, "cost"),
            column_of(chosen, column),
            xerr=bars(chosen, "wall_s_per_simulated_s") * [not p.shared for p in chosen],
            yerr=bars(chosen, column) if has_cases else None,
            fmt="*" if paper else marker,
            ms=15 if paper else 6,
            color=colour,
            ecolor=(colour, 0.35),
            elinewidth=0.5,
            zorder=4,
            mec="k" if paper else "white",
            mew=0.8 if paper else 0.4,
            label=f"{kind}, the paper's" if paper else kind,
        )


def bars(points: Sequence[Point], column: str) -> np.ndarray:
    """How far bars reach below and above, shape (2, points); nothing where it is not known."""
    middle, low, high = (np.array(column_of(points, f"{column}{end}")) for end in ("", "_low", "_high"))
    return np.fmax([middle - low, high - middle], 0.0)


@plain_text
def through_time_figure(points: Sequence[Point], title: str) -> bytes:
    """Errors of force and displacement at the quarters of the run, as PNG."""
    figure = new_figure(11, 4.5, dpi=DPI)
    figure.suptitle(title, fontsize=10)
    panels = figure.subplots(1, 2)
    for axes, column in zip(panels, ("force_nrmse", "position_rmse_mm"), strict=True):
        for number, point in enumerate(points):
            values = [getattr(point, f"{column}_q{quarter}") for quarter in QUARTERS]
            marker = STYLES[point.kind][0]
            axes.plot(QUARTERS, values, f"{marker}-", color=f"C{number % 10}", ms=5, label=point.label)
        logarithmic(axes, x=False).set(xticks=QUARTERS, xlabel="quarter of the run", ylabel=ERRORS[column])
        axes.grid(alpha=0.3)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right upper", fontsize=7)
    return png(figure)


@plain_text
def reduction_figure(points: Sequence[Point], title: str) -> bytes:
    """What r modes leave out of held-out runs, over the time of encoding and decoding, as PNG; a line per centring."""
    figure = new_figure(11, 5.5, dpi=DPI)
    axes = logarithmic(figure.add_subplot(title=title))
    axes.set(
        xlabel="encoding and decoding every frame, seconds of one core per simulated second",
        ylabel="particle positions, RMSE on held-out runs [mm]",
    )
    for number, axis in enumerate(dict.fromkeys(p.axis for p in points)):
        line = sorted((p for p in points if p.axis == axis), key=lambda p: p.modes)
        x, y = column_of(line, "cost"), column_of(line, "own_position_rmse_mm")
        axes.plot(x, y, "D-", color=f"C{number}", ms=4, lw=1, label=axis)
    if frozen := [p.frozen_rmse_mm for p in points if p.frozen_rmse_mm > 0]:
        axes.axhline(frozen[0], color="0.5", ls=":", lw=1, label="nothing moves")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, title="numbers: r")
    fix_layout(figure)
    axes.autoscale(False)
    place_labels(axes, [(p.cost, p.own_position_rmse_mm, f"{p.modes:g}") for p in points])
    return png(figure)


@plain_text
def training_figure(points: Sequence[Point], title: str) -> bytes:
    """What training time buys: errors against the solver that made the runs, over processor time, as PNG."""
    figure = new_figure(13, 5.5, dpi=DPI)
    figure.suptitle(title, fontsize=10)
    panels = figure.subplots(1, 2)
    force = "own_force_nrmse", "force, NRMSE [-]", "mean_force_nrmse", "the mean force of the training runs"
    soil = "own_position_rmse_mm", "particle positions, RMSE [mm]", "frozen_rmse_mm", "nothing moves"
    labels = []
    for axes, (column, words, baseline, baseline_words) in zip(panels, (force, soil), strict=True):
        shown = [p for p in points if p.training_s > 0 and getattr(p, column) > 0]
        if not shown:
            continue
        x, y = column_of(shown, "training_s"), column_of(shown, column)
        logarithmic(axes).set(xlabel="training, processor seconds", ylabel=words)
        axes.plot(x, y, "^", color=STYLES["surrogate"][1], ms=5)
        line = [value for value in column_of(shown, baseline) if value > 0]
        if line:
            axes.axhline(line[0], color="0.5", ls=":", lw=1)
            axes.text(min(x) / 1.4, line[0], f" {baseline_words}", fontsize=7, va="bottom", color="0.35")
        axes.set(xlim=(min(x) / 1.5, max(x) * 3.0), ylim=(min(y) / 1.5, max([*y, *line]) * 1.5))
        labels.append((axes, [(p.training_s, getattr(p, column), p.label) for p in shown]))
    fix_layout(figure)
    for axes, of_points in labels:
        place_labels(axes, of_points, size=6.0)
    return png(figure)


def logarithmic(axes: Axes, x: bool = True) -> Axes:
    """Logarithmic axes with 0.2 in place of 2 × 10⁻¹, at 1, 2 and 5 of every decade of y."""
    axes.set(xscale="log" if x else "linear", yscale="log")
    round_numbers(axes.yaxis)
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    if x:
        axes.xaxis.set_minor_formatter(LogFormatter())
    return axes


# --- Labels beside the points of a crowded figure -------------------------------------------------------

DISTANCES = np.array(
    [7, 14, 22, 32, 44, 58, 74, 92, 112, 136, 164, 196, 230, 270, 320, 380, 450.0]
)  # [pixels]
ANGLES = np.array([(step + 1) // 2 * (-1) ** step * math.pi / 12 for step in range(24)])
"""Beside the point first, then alternately up and down."""
NEAR = 9.0  # a label further away than this gets a line to its point [pixels]


def fix_layout(figure: Figure) -> None:
    """Axes where they stay, so that labels can be placed in pixels."""
    figure.canvas.draw()
    figure.set_layout_engine("none")


def place_labels(
    axes: Axes,
    labels: Sequence[tuple[float, float, str]],
    size: float = 7.0,
    line: Sequence[tuple[float, float]] = (),
) -> np.ndarray:
    """Write a text beside each point (x, y, text), where it covers no other, no point and no line and stays within the
    border.

    The limits and scales of the axes must not change afterwards. Points whose surroundings are crowded choose last
    but are given the room further away. Points and the corners of a line to keep off are in data coordinates; empty
    texts are left out.

    Returns:
        The box of each text in pixels: x0, y0, x1, y1; shape (texts, 4).
    """
    border = np.array(axes.get_window_extent().get_points())
    points = axes.transData.transform([label[:2] for label in labels])
    corners = axes.transData.transform(line) if line else points[:0]
    # Boxes to keep off: of points, of labels, and without a size along lines.
    taken = [np.hstack([points - 4.0, points + 4.0]), *map(along, corners[:-1], corners[1:])]
    ways = np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])
    boxes: dict[int, np.ndarray] = {}
    crowd = np.hypot(*(points[:, None] - points).T).T < 60.0
    for index in np.argsort(crowd.sum(axis=1), kind="stable"):
        if not (words := labels[index][2]):
            continue
        text = axes.text(0, 0, words, fontsize=size, transform=None, va="center", ha="center", zorder=6)
        text.set_path_effects([withStroke(linewidth=2.0, foreground="white")])
        half = np.array(text.get_window_extent().size) / 2 + (2, 1)
        shift = half * np.sign(np.round(ways, 6)) * np.minimum(1.0, 2 * np.abs(ways))
        centres = (points[index] + DISTANCES[:, None, None] * ways + shift).reshape(-1, 2)
        low, high = centres - half, centres + half
        others = np.concatenate(taken)
        hits = ((low[:, None] < others[:, 2:]) & (high[:, None] > others[:, :2])).all(axis=2).sum(axis=1)
        inside = ((low >= border[0] + 2) & (high <= border[1] - 2)).all(axis=1)
        # The nearest that covers nothing; where there is none, the one that covers the fewest.
        centre = centres[np.argmin(np.where(inside, hits, len(others)))]
        text.set_position(tuple(centre))
        boxes[index] = np.concatenate([centre - half, centre + half])
        taken.append(boxes[index][None])
        nearest = np.clip(points[index], centre - half, centre + half)
        if math.dist(nearest, points[index]) > NEAR:
            ends = axes.transData.inverted().transform([points[index], nearest])
            axes.plot(*ends.T, "-", color="0.45", lw=0.6, zorder=3, scalex=False, scaley=False)
            taken.append(along(points[index], nearest))
    return np.array([boxes[index] for index in sorted(boxes)])


def along(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Boxes without a size from start to end, every 4 pixels, shape (k, 4)."""
    return np.tile(np.linspace(start, end, 2 + int(math.dist(start, end) / 4)), 2)
