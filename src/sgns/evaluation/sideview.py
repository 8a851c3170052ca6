"""Side view of soil, body and force: a slice near mid-width at some moments of one or more runs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PathCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from sgns.evaluation.figures import NETWORK, TRUTH, new_figure, styled
from sgns.evaluation.surface import particle_spacing
from sgns.poses import in_world_frame

__all__ = ["body_outline", "middle_slice", "side_views", "view_times"]

STEEL = "#4d5a66"

# Resting soil looks like sand; the faster, the darker: legible without colour as well.
SPEED = LinearSegmentedColormap.from_list("speed", ["#e9dcc3", "#e3b565", "#c9693a", "#8a2a55", "#33103f"])

# A force arrow of the largest force shown is this share of the picture's width long.
ARROW_SHARE = 0.22
# Below this length [m] the head would hide the arrow.
SHORTEST_ARROW = 0.02


def body_outline(run: Any, frame: int) -> np.ndarray:
    """Outline of the body seen from the side [m], shape (k, 2) in x and z.

    The box of the scene's blade, the circle of its wheel, else the hull of the body's points.
    """
    if "diameter" in run.scene:
        angle = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
        radius = 0.5 * float(run.scene["diameter"])
        return run.pose[frame, [0, 2]] + radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    blade = run.scene.get("blade")
    if isinstance(blade, Mapping):
        half = 0.5 * np.array([blade["thickness"], blade["width"], blade["length"]], dtype=np.float64)
        signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        points = in_world_frame(run.pose[[frame]], signs * half)[0]
    else:
        points = np.asarray(run.body_points[frame])
    return hull(points[:, [0, 2]])


def hull(points: np.ndarray) -> np.ndarray:
    """Convex hull of points (k, 2), counter-clockwise (Andrew's monotone chain)."""
    ordered = np.unique(np.round(points, 9), axis=0)
    if len(ordered) < 3:
        return ordered

    def half(side: np.ndarray) -> list[np.ndarray]:
        chain: list[np.ndarray] = []
        for point in side:
            while len(chain) > 1:
                a, b = chain[-1] - chain[-2], point - chain[-2]
                if a[0] * b[1] - a[1] * b[0] > 0.0:
                    break
                chain.pop()
            chain.append(point)
        return chain[:-1]

    return np.array(half(ordered) + half(ordered[::-1]))


def middle_slice(start: np.ndarray) -> np.ndarray:
    """Which particles (n,) of a bed at rest (n, 3) lie near mid-width."""
    y = start[:, 1]
    thickness = 1.5 * particle_spacing(start)
    return np.abs(y - 0.5 * (y.min() + y.max())) <= thickness


def view_times(run: Any, history: int, count: int = 3) -> list[int]:
    """Frames to show: spread over the time in which the body moves, the last a little before it stops."""
    moving = np.linalg.norm(np.diff(run.pose[:, :3], axis=0), axis=1)
    still = moving <= 1e-3 * max(float(moving.max(initial=0.0)), 1e-12)
    last = run.frame_count - 1 if still.all() else int(np.flatnonzero(~still)[-1]) + 1
    first = min(history, last)
    return [round(first + (last - first) * 0.9 * (k + 1) / count) for k in range(count)]


@styled
def side_views(runs: Mapping[str, Any], frames: Sequence[int], start: np.ndarray) -> Figure:
    """Soil near mid-width coloured by speed, body and force, at some frames (rows) of runs (columns).

    Args:
        runs: title → `Run`; all runs share scales of colour and force.
        frames: frames to draw.
        start: common start of the particles [m], shape (n, 3): which of them are near mid-width.
    """
    chosen = middle_slice(start)
    positions = {(t, f): run.positions(slice(f, f + 1))[0][chosen] for t, run in runs.items() for f in frames}
    speeds = {
        (t, f): np.linalg.norm(run.velocities(slice(f, f + 1))[0][chosen], axis=1)
        for t, run in runs.items()
        for f in frames
    }
    first_title = next(iter(runs))
    top = max(float(np.percentile(speeds[first_title, f], 99.5)) for f in frames)
    speed_scale = Normalize(0.0, nice(top) if top > 0.0 else 1.0)
    outlines = {(t, f): body_outline(run, f) for t, run in runs.items() for f in frames}

    low, high = start.min(axis=0), start.max(axis=0)
    spacing = particle_spacing(start)
    x_limits = (low[0] - 1.5 * spacing, high[0] + 1.5 * spacing)
    reach = float(max(np.max(p[:, 2]) for p in positions.values()))
    tool = float(max(np.max(outline[:, 1]) for outline in outlines.values()))
    # A tall tool is cut off: the soil is the subject.
    z_limits = (low[2] - 1.5 * spacing, max(min(tool + spacing, high[2] + 0.22), reach + 2 * spacing))
    strongest = max(
        float(np.max(np.linalg.norm(run.force[list(frames)][:, [0, 2]], axis=1))) for run in runs.values()
    )
    arrow = ARROW_SHARE * (x_limits[1] - x_limits[0]) / strongest if strongest > 0.0 else 0.0

    columns, rows = len(runs), len(frames)
    panel, axes_width = (5.4, 4.95) if columns > 1 else (7.2, 6.15)  # [inches]
    aspect = (z_limits[1] - z_limits[0]) / (x_limits[1] - x_limits[0])
    # Discs about as wide as the room that each particle has.
    size = max(1.4, 0.98 * spacing * 72.0 * axes_width / (x_limits[1] - x_limits[0]))
    figure = new_figure(columns * panel, rows * (axes_width * aspect + 0.38) + 1.0, "compressed")
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for column, (title, run) in enumerate(runs.items()):
        for row, frame in enumerate(frames):
            axis = axes[row, column]
            draw_soil(axis, positions[title, frame], speeds[title, frame], speed_scale, size)
            draw_body(axis, outlines[title, frame])
            draw_force(axis, run, frame, arrow)
            axis.set_xlim(*x_limits)
            axis.set_ylim(*z_limits)
            axis.set_aspect("equal")
            axis.set_title(f"{title}, t = {run.time[frame]:.2f} s")
            if column == 0:
                axis.set_ylabel("z [m]")
            if row == rows - 1:
                axis.set_xlabel("x [m]")
    bar = figure.colorbar(
        ScalarMappable(speed_scale, SPEED),
        ax=list(axes.ravel()),
        location="bottom",
        shrink=0.5,
        aspect=40,
        pad=0.02,
    )
    bar.set_label("speed of the soil [m/s]      arrow: force by the soil on the tool")
    return figure


def draw_soil(
    axis: Axes, positions: np.ndarray, speed: np.ndarray, scale: Normalize, size: float
) -> PathCollection:
    """Particles (k, 3) as discs of a diameter in points, coloured by speed (k,)."""
    order = np.argsort(speed)  # the fast ones on top
    return axis.scatter(
        positions[order, 0],
        positions[order, 2],
        c=speed[order],
        s=size**2,
        cmap=SPEED,
        norm=scale,
        linewidths=0.0,
    )


def draw_body(axis: Axes, outline: np.ndarray) -> None:
    """The body's outline: a filled shape, or a line if it is seen edge-on."""
    if len(outline) >= 3:
        axis.add_patch(
            Polygon(outline, closed=True, facecolor=STEEL, edgecolor="black", linewidth=0.8, zorder=3)
        )
    else:
        axis.plot(outline[:, 0], outline[:, 1], color=STEEL, linewidth=3.0, zorder=3)


def draw_force(axis: Axes, run: Any, frame: int, scale: float) -> None:
    """An arrow from the body's lowest point along the force, with its size."""
    force = np.asarray(run.force[frame])[[0, 2]]
    size = float(np.linalg.norm(force))
    if not math.isfinite(size) or size * scale <= 0.0:
        return
    colour = TRUTH if run.producer == "mpm" else NETWORK
    foot = body_outline(run, frame)
    foot = foot[np.argmin(foot[:, 1])]
    tip = foot + force * scale
    head = "-|>,head_width=0.25,head_length=0.5" if size * scale > SHORTEST_ARROW else "-"
    axis.annotate(
        "",
        xy=tip,
        xytext=foot,
        zorder=4,
        arrowprops={
            "arrowstyle": head,
            "color": colour,
            "linewidth": 2.0,
            "shrinkA": 0.0,
            "shrinkB": 0.0,
        },
    )
    axis.text(
        0.99, 0.97, f"{size:.0f} N", color=colour, fontsize=9, ha="right", va="top", transform=axis.transAxes
    )


def nice(value: float) -> float:
    """The next number of 1, 1.5, 2, 3, 4, 5, 6, 8 × 10ᵏ above a positive value."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1, 1.5, 2, 3, 4, 5, 6, 8, 10) if step * power >= value * (1 - 1e-9))
