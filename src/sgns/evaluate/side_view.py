"""Side view of soil, body and force."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.ticker import MaxNLocator
from scipy.spatial import ConvexHull, QhullError

from mpm_warp.poses import in_world_frame
from sgns.evaluate.figures import NETWORK, PICTURE_WIDTH, TRUTH, new_figure, styled
from sgns.evaluate.metrics import is_wheel, particle_spacing
from sgns.model.features import distance, markers

STEEL = "#4d5a66"
# Resting soil looks like sand; the faster, the darker: legible without colour as well.
SPEED = LinearSegmentedColormap.from_list("speed", ["#e9dcc3", "#e3b565", "#c9693a", "#8a2a55", "#33103f"])
# A force arrow of the largest force shown is this share of the picture's width long.
ARROW_SHARE = 0.22
# Below this length [m] the head would hide the arrow.
SHORTEST_ARROW = 0.02

# --- The body of a recorded scene -----------------------------------------------------------------------


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
    """Corners of the convex hull of points (k, 2), counter-clockwise; the two ends if they lie on a line."""
    try:
        return points[ConvexHull(points).vertices]
    except QhullError:
        return np.unique(np.round(points, 9), axis=0)[[0, -1]]


# --- A slice near mid-width at some moments of one or more runs -----------------------------------------


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


class Scales(NamedTuple):
    """What makes several side views comparable."""

    chosen: np.ndarray  # which particles lie near mid-width, shape (n,)
    speed: Normalize  # range of the colours [m/s]
    arrow: float  # length of a force arrow [m/N]
    x_limits: tuple[float, float]  # of the picture [m]
    z_limits: tuple[float, float]  # of the picture [m]
    spacing: float  # between particles [m]


def common_scales(runs: Sequence[Any], frames: Sequence[int], start: np.ndarray) -> Scales:
    """Scales for all views of some `Run`s at some frames; the first run sets the colours.

    `start` are the particles at rest [m], shape (n, 3).
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
    """Soil near mid-width coloured by speed, body and force, at some frames (rows) of runs by title (columns).

    All share scales of colour and force; `start` are the particles at rest [m], shape (n, 3).
    """
    panel, width = (5.4, 4.95) if len(runs) > 1 else (7.2, 6.15)  # [inches], with and without labels
    scales = common_scales(list(runs.values()), frames, start)
    views = [[(title, run, frame) for title, run in runs.items()] for frame in frames]
    return draw_views(views, scales, len(runs) * panel, width)


@styled
def side_view(runs: Mapping[str, Any], frame: int, scales: Scales) -> Figure:
    """The same at one frame, the runs above each other in one narrow picture."""
    views = [[(title, run, frame)] for title, run in runs.items()]
    return draw_views(views, scales, PICTURE_WIDTH, PICTURE_WIDTH - 0.75)


def draw_views(
    views: Sequence[Sequence[tuple[str, Any, int]]], scales: Scales, whole_width: float, width: float
) -> Figure:
    """Rows of views (title, run, frame) in a picture so many inches wide, each view without its labels `width`."""
    inches = width / np.ptp(scales.x_limits)  # per metre
    height = len(views) * (inches * np.ptp(scales.z_limits) + 0.38) + 1.0
    figure = new_figure(whole_width, height, "compressed")
    axes = figure.subplots(len(views), len(views[0]), squeeze=False, sharex=True, sharey=True)
    for axis, (title, run, frame) in zip(axes.flat, itertools.chain(*views), strict=True):
        draw_view(axis, title, run, frame, scales, width)
    for axis in axes[:, 0]:
        axis.set_ylabel("z [m]")
    for axis in axes[-1]:
        axis.set_xlabel("x [m]")
    bar = figure.colorbar(
        ScalarMappable(scales.speed, SPEED),
        ax=list(axes.flat),
        location="bottom",
        shrink=0.5 if axes.shape[1] > 1 else 0.9,
        aspect=40,
        pad=0.02,
        ticks=MaxNLocator(5),
    )
    bar.set_label("speed of the soil [m/s]")
    return figure


def draw_view(axis: Axes, title: str, run: Any, frame: int, scales: Scales, width: float) -> None:
    """One run at one frame in a view so many inches wide."""
    inches = width / np.ptp(scales.x_limits)  # per metre
    disc = max(
        1.4, 0.98 * scales.spacing * 72.0 * inches
    )  # diameter of a particle [points]: the room that it has
    positions = slice_positions(run, frame, scales.chosen)
    speed = slice_speed(run, frame, scales.chosen)
    order = np.argsort(speed)  # the fast ones on top
    x, _, z = positions[order].T
    axis.scatter(x, z, c=speed[order], s=disc**2, cmap=SPEED, norm=scales.speed, linewidths=0.0)
    outline = body_outline(run, frame)
    if len(outline) >= 3:
        axis.add_patch(Polygon(outline, facecolor=STEEL, edgecolor="black", linewidth=0.8, zorder=3))
    else:  # seen edge-on
        axis.plot(*outline.T, color=STEEL, linewidth=3.0, zorder=3)
    force = run.force[frame, [0, 2]]
    size = float(np.linalg.norm(force)) * scales.arrow
    if size > 0.0:
        head = "-|>,head_width=0.25,head_length=0.5" if size > SHORTEST_ARROW else "-"
        foot = outline[np.argmin(outline[:, 1])]
        draw_force(axis, run, force, foot, foot + force * scales.arrow, head)
    axis.set(xlim=scales.x_limits, ylim=scales.z_limits, aspect="equal")
    axis.set_title(f"{title}, t = {run.time[frame]:.2f} s")


def draw_force(
    axis: Axes,
    run: Any,
    force: np.ndarray,
    foot: np.ndarray,
    tip: np.ndarray,
    head: str = "-|>",
    clip: bool | None = None,
) -> None:
    """A force [N] as an arrow between two points of the picture, and its size in the corner."""
    colour = TRUTH if run.producer == "mpm" else NETWORK
    size = float(np.linalg.norm(force))
    if not 0.0 < size < math.inf:
        return
    arrow = {"arrowstyle": head, "color": colour, "linewidth": 2.0, "shrinkA": 0.0, "shrinkB": 0.0}
    axis.annotate("", xy=tip, xytext=foot, zorder=4, arrowprops=arrow, annotation_clip=clip)
    corner = {"ha": "right", "va": "top", "transform": axis.transAxes}
    axis.text(0.99, 0.97, f"{size:.0f} N", color=colour, fontsize=9, **corner)


def nice(value: float) -> float:
    """The next number of 1, 1.5, 2, 3, 4, 5, 6, 8 × 10ᵏ above a positive value."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1, 1.5, 2, 3, 4, 5, 6, 8, 10) if step * power >= value * (1 - 1e-9))
