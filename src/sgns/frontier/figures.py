"""Error over time of all points of a scene, with the front that none beats."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from io import BytesIO

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import LogFormatter, LogLocator, NullFormatter

from sgns.frontier.point import Point, effective_error, front, usable

# --- Labels beside the points of a crowded figure: none covers another, a point or the border -----------

DISTANCES = (7, 14, 22, 32, 44, 58, 74, 92, 112, 136, 164, 196, 230, 270, 320, 380, 450)  # [pixels]
ANGLES = 24
NEAR = 9.0  # a label further away than this gets a line to its point [pixels]


def place_labels(
    axes: Axes,
    x: Sequence[float],
    y: Sequence[float],
    texts: Sequence[str],
    size: float = 7.0,
    line: Sequence[tuple[float, float]] = (),
) -> list[np.ndarray]:
    """Write a text beside each point.

    The limits and scales of the axes must not change afterwards. Points whose surroundings are crowded choose last
    but are given the room further away.

    Args:
        axes: drawn with its final limits.
        x: of the points, data coordinates.
        y: likewise.
        texts: one for each point; an empty one is left out.
        size: of the letters [points].
        line: corners of a line that labels keep off, data coordinates.

    Returns:
        The box of each text in pixels: x0, y0, x1, y1.
    """
    figure = axes.figure
    renderer = figure.canvas.get_renderer()
    border = axes.get_window_extent(renderer)
    points = axes.transData.transform(np.column_stack([x, y]).astype(float))
    taken = [np.array([px - 4, py - 4, px + 4, py + 4]) for px, py in points]
    corners = axes.transData.transform(np.array(line, dtype=float)) if len(line) else []
    lines: list[tuple[np.ndarray, np.ndarray]] = list(itertools.pairwise(corners))
    boxes: dict[int, np.ndarray] = {}
    crowd = [np.sum(np.hypot(*(points - point).T) < 60.0) for point in points]
    for index in sorted(range(len(points)), key=lambda i: crowd[i]):
        if not texts[index]:
            continue
        text = axes.text(
            0, 0, texts[index], fontsize=size, transform=None, va="center", ha="center", zorder=6
        )
        text.set_path_effects([withStroke(linewidth=2.0, foreground="white")])
        extent = text.get_window_extent(renderer)
        half = np.array([extent.width / 2 + 2, extent.height / 2 + 1])
        centre = best_place(points[index], half, border, taken, lines)
        text.set_position(tuple(centre))
        box = np.concatenate([centre - half, centre + half])
        taken.append(box)
        boxes[index] = box
        nearest = np.clip(points[index], centre - half, centre + half)
        if math.dist(nearest, points[index]) > NEAR:
            ends = axes.transData.inverted().transform([points[index], nearest])
            axes.plot(*ends.T, "-", color="0.45", lw=0.6, zorder=3, scalex=False, scaley=False)
            lines.append((points[index], nearest))
    return [boxes[index] for index in sorted(boxes)]


def best_place(
    point: np.ndarray,
    half: np.ndarray,
    border: object,
    taken: Sequence[np.ndarray],
    lines: Sequence[tuple[np.ndarray, np.ndarray]],
) -> np.ndarray:
    """Middle of the box that is nearest to the point and covers nothing; of those that do the least bad one.

    Args:
        point: [pixels], shape (2,).
        half: half the width and height of the box, margin included [pixels].
        border: window extent of the axes, which the box must not leave.
        taken: boxes that must not be covered.
        lines: from points to labels; a box on one is avoided where there is another place.
    """
    others = np.array(taken)
    best, least = point, math.inf
    for distance in DISTANCES:
        for step in range(ANGLES):
            # Beside the point first: 0, then alternately up and down.
            angle = math.pi * (step + 1) // 2 * (-1) ** step * 2.0 / ANGLES if step else 0.0
            way = np.array([math.cos(angle), math.sin(angle)])
            centre = (
                point + way * distance + half * np.sign(np.round(way, 6)) * np.minimum(1.0, 2 * np.abs(way))
            )
            low, high = centre - half, centre + half
            if (low < [border.x0 + 2, border.y0 + 2]).any() or (high > [border.x1 - 2, border.y1 - 2]).any():
                continue
            overlap = np.minimum(high, others[:, 2:]) - np.maximum(low, others[:, :2])
            covered = np.prod(np.maximum(overlap, 0.0), axis=1).sum()
            crossed = sum(crosses(low, high, *line) for line in lines)
            if not covered and not crossed:
                return centre
            bad = covered + 30.0 * crossed + 0.05 * distance
            if bad < least:
                best, least = centre, bad
    return best


def crosses(low: np.ndarray, high: np.ndarray, start: np.ndarray, end: np.ndarray) -> bool:
    """Whether the line from start to end meets the box."""
    count = 2 + int(math.dist(start, end) / 4)
    between = start + np.linspace(0.0, 1.0, count)[:, None] * (end - start)
    return bool(((between > low) & (between < high)).all(axis=1).any())


# --- Error over time of all points of a scene, with the front that none beats ---------------------------

COLUMNS = {
    "force_nrmse": "force, NRMSE [-]",
    "position_rmse_mm": "displacement of the soil, RMSE [mm]",
    "surface_rmse_mm": "surface at the end, RMSE [mm]",
    "sinkage_error_mm": "sinkage, mean absolute error [mm]",
}
STYLES = {
    "solver": ("o", "#0072b2"),
    "surrogate": ("^", "#d55e00"),
    "full space": ("s", "#009e73"),
    "reduction": ("D", "#cc79a7"),
}
DPI = 110
plain_text = rc_context({"text.parse_math": False})
"""For figures that show labels from anybody's table, in which $ is no formula."""


def known(points: Sequence[Point], column: str) -> list[Point]:
    """Usable points whose error is known."""
    return [point for point in points if usable(point) and not math.isnan(getattr(point, column))]


@plain_text
def scene_figure(points: Sequence[Point], column: str, bands: Mapping[str, float], title: str) -> bytes:
    """Error over wall time per simulated second, as PNG.

    Args:
        points: of one scene.
        column: which error.
        bands: how wrong the reference may be, by column.
        title: over the figure.
    """
    shown = known(points, column)
    figure = Figure(figsize=(13, 8.5), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set(xscale="log", yscale="log", title=title)
    plain_numbers(axes)
    axes.set_xlabel(
        "seconds of one core per simulated second: wall time, median of repeats (bar: fastest to slowest); "
        "without bar: processor time, the core was shared"
    )
    axes.set_ylabel(f"{COLUMNS[column]}, against the most accurate run (bar: best to worst case)")
    references = [p for p in points if p.axis == "reference" and not math.isnan(p.cost)]
    draw_points(axes, shown, column)
    band = bands.get(column, 0.0)
    set_limits(axes, [*shown, *references], column, band)
    axes.axvline(1.0, color="k", ls="--", lw=1, zorder=1)
    low, high = axes.get_ylim()
    axes.text(1.0, high, " real time ", ha="right", va="top", rotation=90, fontsize=8)
    if band:
        axes.axhspan(low, band, color="0.92", zorder=0)
        axes.text(
            axes.get_xlim()[0],
            band,
            "  below: within the reference's own error",
            fontsize=8,
            va="top",
            color="0.35",
        )
    best = front(points, column, bands)
    line = corners([(p.cost, effective_error(p, column, bands)) for p in best])
    axes.plot(*zip(*line, strict=True), "k-", lw=1.2, zorder=2, label="front: nothing faster is as good")
    labelled = [(p.cost, getattr(p, column), f"★ {p.label}" if p.paper else p.label) for p in shown]
    for point in references:
        axes.axvline(point.cost, color="0.5", ls=":", lw=1)
        labelled.append((point.cost, max(band, low * 1.3), f"reference: {point.label}"))
    axes.legend(loc="lower left", fontsize=8)
    settle(figure)
    place_labels(axes, *zip(*labelled, strict=True), line=line)
    return png(figure)


def corners(best: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Corners of the stairs through points of increasing time and decreasing error."""
    found = list(best[:1])
    for (_, before), (time, error) in itertools.pairwise(best):
        found += [(time, before), (time, error)]
    return found


def draw_points(axes: Axes, points: Sequence[Point], column: str) -> None:
    """Markers by kind with their bars; the paper's own points are stars."""
    for kind, (marker, colour) in STYLES.items():
        for paper in (False, True):
            chosen = [p for p in points if p.kind == kind and p.paper == paper]
            if not chosen:
                continue
            x = [p.cost for p in chosen]
            y = [getattr(p, column) for p in chosen]
            bars = {"xerr": [spread(p, "wall_s_per_simulated_s") for p in chosen]}
            if hasattr(chosen[0], f"{column}_low"):
                bars["yerr"] = [spread(p, column) for p in chosen]
            axes.errorbar(
                x,
                y,
                **{key: list(zip(*values, strict=True)) for key, values in bars.items()},
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


def plain_numbers(axes: Axes) -> None:
    """0.2 in place of 2 × 10⁻¹, at 1, 2 and 5 of every decade of y."""
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_minor_formatter(NullFormatter())
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.xaxis.set_minor_formatter(LogFormatter())


def settle(figure: Figure) -> None:
    """Axes where they stay, so that labels can be placed in pixels."""
    figure.canvas.draw()
    figure.set_layout_engine("none")


def spread(point: Point, column: str) -> tuple[float, float]:
    """How far the bar reaches below and above; nothing where it is not known."""
    if column == "wall_s_per_simulated_s" and point.shared:
        return 0.0, 0.0
    middle, low, high = (getattr(point, f"{column}{end}") for end in ("", "_low", "_high"))
    below, above = middle - low, high - middle
    return (0.0 if math.isnan(below) else max(below, 0.0), 0.0 if math.isnan(above) else max(above, 0.0))


def set_limits(axes: Axes, points: Sequence[Point], column: str, band: float) -> None:
    """Room for labels around all points and the band."""
    x = [p.cost for p in points] + [1.0]
    y = [getattr(p, column) for p in points if getattr(p, column) > 0.0] + ([band] if band else [])
    axes.set_xlim(min(x) / 2.5, max(x) * 3.0)
    axes.set_ylim(min(y) / 1.8, max(y) * 1.5)


@plain_text
def through_time_figure(points: Sequence[Point], title: str) -> bytes:
    """Errors of force and displacement at the quarters of the run, as PNG."""
    figure = Figure(figsize=(11, 4.5), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=10)
    panels = figure.subplots(1, 2)
    for axes, column in zip(panels, ("force_nrmse", "position_rmse_mm"), strict=True):
        for number, point in enumerate(points):
            values = [getattr(point, f"{column}_q{quarter}") for quarter in (1, 2, 3, 4)]
            marker = STYLES[point.kind][0]
            axes.plot((1, 2, 3, 4), values, f"{marker}-", color=f"C{number % 10}", ms=5, label=point.label)
        axes.set(xticks=(1, 2, 3, 4), xlabel="quarter of the run", ylabel=COLUMNS[column], yscale="log")
        plain_numbers(axes)
        axes.grid(alpha=0.3)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right upper", fontsize=7)
    return png(figure)


@plain_text
def reduction_figure(points: Sequence[Point], title: str) -> bytes:
    """What r modes leave out of held-out runs, over the time of encoding and decoding, as PNG; a line per centring."""
    figure = Figure(figsize=(11, 5.5), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot(xscale="log", yscale="log", title=title)
    plain_numbers(axes)
    axes.set(
        xlabel="encoding and decoding every frame, seconds of one core per simulated second",
        ylabel="particle positions, RMSE on held-out runs [mm]",
    )
    for number, axis in enumerate(dict.fromkeys(p.axis for p in points)):
        line = sorted((p for p in points if p.axis == axis), key=lambda p: p.modes)
        x, y = [p.cost for p in line], [p.own_position_rmse_mm for p in line]
        axes.plot(x, y, "D-", color=f"C{number}", ms=4, lw=1, label=axis)
    frozen = [p.frozen_rmse_mm for p in points if p.frozen_rmse_mm > 0]
    if frozen:
        axes.axhline(frozen[0], color="0.5", ls=":", lw=1, label="nothing moves")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, title="numbers: r")
    settle(figure)
    axes.autoscale(False)
    place_labels(
        axes,
        [p.cost for p in points],
        [p.own_position_rmse_mm for p in points],
        [f"{p.modes:g}" for p in points],
    )
    return png(figure)


@plain_text
def training_figure(points: Sequence[Point], title: str) -> bytes:
    """What training time buys: errors against the solver that made the runs, over processor time, as PNG."""
    figure = Figure(figsize=(13, 5.5), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=10)
    panels = figure.subplots(1, 2)
    columns = {"own_force_nrmse": "mean_force_nrmse", "own_position_rmse_mm": "frozen_rmse_mm"}
    labels = []
    for axes, (column, baseline) in zip(panels, columns.items(), strict=True):
        shown = [p for p in points if p.training_s > 0 and getattr(p, column) > 0]
        if not shown:
            continue
        x, y = [p.training_s for p in shown], [getattr(p, column) for p in shown]
        axes.set(xscale="log", yscale="log", xlabel="training, processor seconds")
        plain_numbers(axes)
        axes.set_ylabel("force, NRMSE [-]" if "force" in column else "particle positions, RMSE [mm]")
        axes.plot(x, y, "^", color=STYLES["surrogate"][1], ms=5)
        line = [getattr(p, baseline) for p in shown if getattr(p, baseline) > 0]
        if line:
            axes.axhline(line[0], color="0.5", ls=":", lw=1)
            name = "the mean force of the training runs" if "force" in column else "nothing moves"
            axes.text(min(x) / 1.4, line[0], f" {name}", fontsize=7, va="bottom", color="0.35")
        axes.set_xlim(min(x) / 1.5, max(x) * 3.0)
        axes.set_ylim(min(y) / 1.5, max([*y, *line]) * 1.5)
        labels.append((axes, x, y, [p.label for p in shown]))
    settle(figure)
    for label in labels:
        place_labels(*label, size=6.0)
    return png(figure)


def png(figure: Figure) -> bytes:
    """The picture."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()
