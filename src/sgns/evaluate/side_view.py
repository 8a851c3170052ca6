"""Side view of soil, body and force."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PathCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.ticker import MaxNLocator

from mpm_warp.poses import in_world_frame
from sgns.evaluate.figures import NETWORK, PICTURE_WIDTH, TRUTH, new_figure, styled
from sgns.evaluate.metrics import is_wheel, particle_spacing
from sgns.model.features import distance, markers

# --- The body of a recorded scene: its kind, its corners, and how its force is reported -----------------
# Scenes are plain data of a run file, of any kind.


def body_corners(run: Any, frame: int) -> np.ndarray:
    """Points [m] whose convex hull is the body at a frame, shape (k, 3), world frame.

    The corners of the scene's blade, points along the rims of its wheel, the vertices of the mesh that the run holds,
    else the recorded body points.
    """
    scene = run.scene
    blade = scene.get("blade")
    if is_wheel(scene) and "width" in scene:
        angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
        radius, half_width = 0.5 * float(scene["diameter"]), 0.5 * float(scene["width"])
        rim = np.stack([radius * np.cos(angle), np.full(24, half_width), radius * np.sin(angle)], axis=-1)
        corners = np.concatenate([rim, rim * [1.0, -1.0, 1.0]])
    elif isinstance(blade, Mapping):
        half = 0.5 * np.array([blade["thickness"], blade["width"], blade["length"]], dtype=np.float64)
        corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3) * half
    elif run.mesh is not None:
        corners = run.mesh[0]
    else:
        return np.asarray(run.body_points[frame])
    return in_world_frame(run.pose[[frame]], corners)[0]


# --- Side view of soil, body and force: a slice near mid-width at some moments of one or more runs ------

STEEL = "#4d5a66"
# Resting soil looks like sand; the faster, the darker: legible without colour as well.
SPEED = LinearSegmentedColormap.from_list("speed", ["#e9dcc3", "#e3b565", "#c9693a", "#8a2a55", "#33103f"])
# A force arrow of the largest force shown is this share of the picture's width long.
ARROW_SHARE = 0.22
# Below this length [m] the head would hide the arrow.
SHORTEST_ARROW = 0.02


def body_outline(run: Any, frame: int) -> np.ndarray:
    """Outline of the body seen from the side [m], shape (k, 2) in x and z.

    The circle of the scene's wheel, else the hull of the body's corners.
    """
    if is_wheel(run.scene):
        angle = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
        radius = 0.5 * float(run.scene["diameter"])
        return run.pose[frame, [0, 2]] + radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return hull(body_corners(run, frame)[:, [0, 2]])


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
    path = markers(run.pose, run.body_points)  # which show a turn as well
    moving = distance(path[1:], path[:-1])
    still = moving <= 1e-3 * max(float(moving.max(initial=0.0)), 1e-12)
    last = run.frame_count - 1 if still.all() else int(np.flatnonzero(~still)[-1]) + 1
    first = min(history, last)
    return [round(first + (last - first) * 0.9 * (k + 1) / count) for k in range(count)]


@dataclass(frozen=True)
class Scales:
    """What makes several side views comparable.

    Attributes:
        chosen: which particles lie near mid-width, shape (n,).
        speed: range of the colours [m/s].
        arrow: length of a force arrow [m/N].
        x_limits: of the picture [m].
        z_limits: of the picture [m].
        spacing: between particles [m].
    """

    chosen: np.ndarray
    speed: Normalize
    arrow: float
    x_limits: tuple[float, float]
    z_limits: tuple[float, float]
    spacing: float

    @property
    def aspect(self) -> float:
        """Height of a view over its width."""
        return (self.z_limits[1] - self.z_limits[0]) / (self.x_limits[1] - self.x_limits[0])

    def disc(self, width: float) -> float:
        """Diameter [points] of a particle's disc in a view so many inches wide: the room that it has."""
        return max(1.4, 0.98 * self.spacing * 72.0 * width / (self.x_limits[1] - self.x_limits[0]))


def common_scales(runs: Sequence[Any], frames: Sequence[int], start: np.ndarray) -> Scales:
    """Scales for all views of some runs at some frames; the first run sets the colours.

    Args:
        runs: `Run`s.
        frames: frames that will be drawn.
        start: common start of the particles [m], shape (n, 3).
    """
    chosen, spacing = middle_slice(start), particle_spacing(start)
    fastest = max(float(np.percentile(slice_speed(runs[0], frame, chosen), 99.5)) for frame in frames)
    low, high = start.min(axis=0), start.max(axis=0)
    x_limits = (low[0] - 1.5 * spacing, high[0] + 1.5 * spacing)
    reach = max(float(np.max(slice_positions(run, f, chosen)[:, 2])) for run in runs for f in frames)
    tool = max(float(np.max(body_outline(run, f)[:, 1])) for run in runs for f in frames)
    # A tall tool is cut off: the soil is the subject.
    top = max(min(tool + spacing, high[2] + 0.22), reach + 2.0 * spacing)
    strongest = max(float(np.max(np.linalg.norm(run.force[list(frames)][:, [0, 2]], axis=1))) for run in runs)
    arrow = ARROW_SHARE * (x_limits[1] - x_limits[0]) / strongest if strongest > 0.0 else 0.0
    speed = Normalize(0.0, nice(fastest) if fastest > 0.0 else 1.0)
    return Scales(chosen, speed, arrow, x_limits, (low[2] - 1.5 * spacing, top), spacing)


def slice_positions(run: Any, frame: int, chosen: np.ndarray) -> np.ndarray:
    """Positions [m] of the chosen particles, shape (k, 3)."""
    return run.positions(slice(frame, frame + 1))[0][chosen]


def slice_speed(run: Any, frame: int, chosen: np.ndarray) -> np.ndarray:
    """Speeds [m/s] of the chosen particles, shape (k,)."""
    return np.linalg.norm(run.velocities(slice(frame, frame + 1))[0][chosen], axis=1)


@styled
def side_views(runs: Mapping[str, Any], frames: Sequence[int], start: np.ndarray) -> Figure:
    """Soil near mid-width coloured by speed, body and force, at some frames (rows) of runs (columns).

    Args:
        runs: title → `Run`; all runs share scales of colour and force.
        frames: frames to draw.
        start: common start of the particles [m], shape (n, 3): which of them are near mid-width.
    """
    panel, width = (5.4, 4.95) if len(runs) > 1 else (7.2, 6.15)  # [inches], with and without labels
    scales = common_scales(list(runs.values()), frames, start)
    figure = new_figure(len(runs) * panel, len(frames) * (width * scales.aspect + 0.38) + 1.0, "compressed")
    axes = figure.subplots(len(frames), len(runs), squeeze=False, sharex=True, sharey=True)
    for row, frame in zip(axes, frames, strict=True):
        for axis, (title, run) in zip(row, runs.items(), strict=True):
            draw_view(axis, title, run, frame, scales, width)
    finish(figure, axes, scales)
    return figure


@styled
def side_view(runs: Mapping[str, Any], frame: int, scales: Scales) -> Figure:
    """The same at one frame, the runs above each other in one narrow picture.

    Args:
        runs: title → `Run`.
        frame: frame to draw.
        scales: of this and other pictures.
    """
    width = PICTURE_WIDTH - 0.75
    figure = new_figure(PICTURE_WIDTH, len(runs) * (width * scales.aspect + 0.38) + 1.0, "compressed")
    axes = figure.subplots(len(runs), 1, squeeze=False, sharex=True, sharey=True)
    for axis, (title, run) in zip(axes[:, 0], runs.items(), strict=True):
        draw_view(axis, title, run, frame, scales, width)
    finish(figure, axes, scales)
    return figure


def draw_view(axis: Axes, title: str, run: Any, frame: int, scales: Scales, width: float) -> None:
    """One run at one frame in a view so many inches wide."""
    positions = slice_positions(run, frame, scales.chosen)
    speed = slice_speed(run, frame, scales.chosen)
    draw_soil(axis, positions, speed, scales.speed, scales.disc(width))
    draw_body(axis, body_outline(run, frame))
    draw_force(axis, run, frame, scales.arrow)
    axis.set_xlim(*scales.x_limits)
    axis.set_ylim(*scales.z_limits)
    axis.set_aspect("equal")
    axis.set_title(f"{title}, t = {run.time[frame]:.2f} s")


def finish(figure: Figure, axes: np.ndarray, scales: Scales) -> None:
    """Names of the outer axes and the colour bar."""
    for axis in axes[:, 0]:
        axis.set_ylabel("z [m]")
    for axis in axes[-1]:
        axis.set_xlabel("x [m]")
    bar = figure.colorbar(
        ScalarMappable(scales.speed, SPEED),
        ax=list(axes.ravel()),
        location="bottom",
        shrink=0.5 if axes.shape[1] > 1 else 0.9,
        aspect=40,
        pad=0.02,
        ticks=MaxNLocator(5),
    )
    bar.set_label("speed of the soil [m/s]")


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
