"""Views of soil, body and force in space: from the side, the whole bed, and the subspace."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from matplotlib.ticker import MaxNLocator

from sgns.data.run import Run, frame_chunks
from sgns.data.surface import particle_spacing
from sgns.evaluate.body_shape import (
    CUBE,
    DepthBuffer,
    FurtherBody,
    bodies,
    body_cut,
    body_silhouette,
    body_triangles,
    is_mesh,
    project,
)
from sgns.evaluate.figures import (
    BASELINE,
    DPI,
    NETWORK,
    PICTURE_WIDTH,
    TRUTH,
    legend_above,
    new_figure,
    styled,
)
from sgns.model.features import distance, markers
from sgns.reduction.basis import Basis

STEEL = "#4d5a66"
BEHIND = "#dde2e6"  # of what is not in the slice that is shown
# Resting soil looks like sand; the faster, the darker: legible without colour as well.
SPEED = LinearSegmentedColormap.from_list("speed", ["#e9dcc3", "#e3b565", "#c9693a", "#8a2a55", "#33103f"])
# No error looks like the paper; the larger, the darker.
ERROR = LinearSegmentedColormap.from_list("error", ["#f2f2ee", "#9cc3dd", "#3d7fb1", "#22356f", "#0c0c26"])
COLOUR_BAR: dict[str, Any] = {"location": "bottom", "aspect": 40, "pad": 0.02}
# A tool is shown up to so much above the bed [m]: the soil is the subject.
TOOL_ABOVE = 0.22

# --- Round scales, force and body ---------------------------------------------------------------------


def nice(value: float) -> float:
    """The next number of 1, 1.5, 2, 3, 4, 5, 6, 8 × 10ᵏ above a positive value."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1, 1.5, 2, 3, 4, 5, 6, 8, 10) if step * power >= value * (1 - 1e-9))


def upper_scale(*values: np.ndarray, least: float = 0.0) -> Normalize:
    """From zero to about the largest of the values, in whichever array it is, or to `least` if that is more."""
    top = max(least, *(float(np.percentile(some, 99.5)) for some in values))
    return Normalize(0.0, nice(top) if top > 0.0 else 1.0)


def draw_force(
    axis: Axes,
    run: Any,
    force: np.ndarray,
    foot: np.ndarray,
    tip: np.ndarray,
    head: str = "-|>",
    clip: bool | None = None,
    line: int = 0,
) -> None:
    """A force [N] as an arrow between two points of the picture, and its size on a line in the corner."""
    colour = run.colour if isinstance(run, FurtherBody) else NETWORK if run.producer == "rollout" else TRUTH
    size = float(np.linalg.norm(force))
    if not 0.0 < size < math.inf:
        return
    arrow = {"arrowstyle": head, "color": colour, "linewidth": 2.0, "shrinkA": 0.0, "shrinkB": 0.0}
    axis.annotate("", xy=tuple(tip), xytext=tuple(foot), zorder=4, arrowprops=arrow, annotation_clip=clip)
    words = f"{size:.0f} N" if size > 9.5 else f"{size:.2g} N"
    axis.annotate(
        words,
        (0.99, 0.97),
        (0.0, -11.0 * line),
        xycoords="axes fraction",
        textcoords="offset points",
        color=colour,
        fontsize=9,
        ha="right",
        va="top",
    )


def draw_body(
    axis: Axes, silhouette: Sequence[np.ndarray], face: str = STEEL, edge: str = "black", zorder: float = 3.0
) -> None:
    """The union of polygons as one shape: their edges below, their faces above."""
    faces: dict[str, Any] = {"facecolors": face, "edgecolors": face, "linewidths": 0.8}
    if all(len(polygon) < 3 for polygon in silhouette):  # seen edge-on
        faces = {"edgecolors": face, "linewidths": 3.0}
    axis.add_collection(
        PolyCollection(silhouette, edgecolors=edge, linewidths=2.2, zorder=zorder), autolim=False
    )
    axis.add_collection(PolyCollection(silhouette, zorder=zorder + 0.1, **faces), autolim=False)


def draw_cut(axis: Axes, sides: np.ndarray) -> None:
    """The cut of a mesh, filled, from its sides (k, 2, 2); see `body_cut`."""
    if not len(sides):
        return
    # A triangle between each side and one point: where the sides go around a place, the triangles add up to not zero.
    fan = np.concatenate([sides, np.broadcast_to(sides[:1, :1], (len(sides), 2, 2))], axis=1)
    codes = np.tile(np.array([Path.MOVETO, Path.LINETO, Path.LINETO, Path.CLOSEPOLY]), len(sides))
    filled = PathPatch(
        Path(fan.reshape(-1, 2), codes), facecolor=STEEL, linewidth=0.0, snap=False, zorder=3.0
    )
    axis.add_artist(filled)
    axis.add_collection(
        LineCollection(list(sides), colors="black", linewidths=1.1, zorder=3.1), autolim=False
    )


# --- A slice near mid-width at some moments of one or more runs -----------------------------------------

# A force arrow of the largest force shown is this share of the picture's width long.
SIDE_ARROW = 0.22
# Below this length [m] the head would hide the arrow.
SHORTEST_ARROW = 0.02


# The colours of the speed reach at least so far [m/s], so that soil at rest looks at rest.
LEAST_SPEED = 0.01
# A view shows at most so many particles: more of them would lie on top of each other.
MOST_PARTICLES = 20_000


def middle_slice(start: np.ndarray) -> np.ndarray:
    """Which particles (n,) of a bed at rest (n, 3) lie near mid-width; `MOST_PARTICLES` of them, drawn at random, if
    there are more."""
    y = start[:, 1]
    chosen = np.abs(y - 0.5 * (y.min() + y.max())) <= 1.5 * particle_spacing(start)
    near = np.flatnonzero(chosen)
    if len(near) > MOST_PARTICLES:
        chosen[near] = False
        chosen[np.random.default_rng(0).choice(near, MOST_PARTICLES, replace=False)] = True
    return chosen


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
    middle: float  # y of mid-width [m]
    speed: Normalize  # range of the colours [m/s]
    arrow: float  # length of a force arrow [m/N]
    x_limits: tuple[float, float]  # of the picture [m]
    z_limits: tuple[float, float]  # of the picture [m]
    disc: float  # diameter of a particle as drawn [m]


def common_scales(runs: Sequence[Any], frames: Sequence[int], start: np.ndarray) -> Scales:
    """Scales for all views of some `Run`s at some frames; the first run sets the colours.

    `start` are the particles at rest [m], shape (n, 3).
    """
    chosen, spacing = middle_slice(start), particle_spacing(start)
    shown = list(itertools.product(runs, frames))
    low, high = start.min(axis=0), start.max(axis=0)
    reach = [
        run.positions(frame)[0, chosen] for run, frame in shown
    ]  # a column flows beyond its place at rest
    left = min(low[0], *(float(soil[:, 0].min()) for soil in reach))
    right = max(high[0], *(float(soil[:, 0].max()) for soil in reach))
    x_limits = (left - 1.5 * spacing, right + 1.5 * spacing)
    tool = max(
        (
            float(part[:, 1].max())
            for run, frame in shown
            for body in bodies(run)
            for part in body_silhouette(body, frame)
        ),
        default=-np.inf,
    )
    highest = max(float(soil[:, 2].max()) for soil in reach)
    top = max(min(tool + spacing, high[2] + TOOL_ABOVE), highest + 2.0 * spacing)
    strongest = max(
        float(np.linalg.norm(body.force[frame, [0, 2]])) for run, frame in shown for body in bodies(run)
    )
    arrow = SIDE_ARROW * (x_limits[1] - x_limits[0]) / strongest if strongest > 0.0 else 0.0
    speed = upper_scale(*(speeds(runs[0], frame, chosen) for frame in frames), least=LEAST_SPEED)
    disc = spacing
    if chosen.sum() == MOST_PARTICLES:  # they take the room of those left out
        disc = max(disc, math.sqrt(3.0 * (high[0] - low[0]) * (high[2] - low[2]) / MOST_PARTICLES))
    middle = 0.5 * float(low[1] + high[1])
    return Scales(chosen, middle, speed, arrow, x_limits, (low[2] - 1.5 * spacing, top), disc)


def speeds(run: Any, frame: int, chosen: np.ndarray) -> np.ndarray:
    """Of the chosen particles [m/s], shape (k,)."""
    return np.linalg.norm(run.velocities(frame)[0, chosen], axis=1)


@styled
def side_views(
    views: Sequence[Sequence[tuple[str, Any, int]]],
    scales: Scales,
    whole_width: float = PICTURE_WIDTH,
    width: float = PICTURE_WIDTH - 0.75,
) -> Figure:
    """Rows of views of soil near mid-width coloured by speed, body and force: title, run and frame of each.

    The picture is `whole_width` wide [inches], each view without its labels `width`.
    """
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
    figure.colorbar(
        ScalarMappable(scales.speed, SPEED),
        ax=list(axes.flat),
        label="speed of the soil [m/s]",
        shrink=0.5 if axes.shape[1] > 1 else 0.9,
        ticks=MaxNLocator(5),
        **COLOUR_BAR,
    )
    return figure


def draw_view(axis: Axes, title: str, run: Any, frame: int, scales: Scales, width: float) -> None:
    """One run at one frame in a view so many inches wide.

    A mesh is cut at mid-width, as the soil is: what is beside the cut is pale, behind the soil.
    """
    inches = width / np.ptp(scales.x_limits)  # per metre
    # Diameter of a particle [points].
    disc = max(1.4, 0.98 * scales.disc * 72.0 * inches)
    speed = speeds(run, frame, scales.chosen)
    order = np.argsort(speed)  # the fast ones on top
    x, _, z = run.positions(frame)[0, scales.chosen][order].T
    axis.scatter(x, z, c=speed[order], s=disc**2, cmap=SPEED, norm=scales.speed, linewidths=0.0)
    for line, body in enumerate(bodies(run)):
        silhouette = body_silhouette(body, frame)
        if is_mesh(body):
            draw_body(axis, silhouette, BEHIND, STEEL, zorder=0.5)
            draw_cut(axis, body_cut(body, frame, scales.middle))
        else:
            draw_body(axis, silhouette)
        force = body.force[frame, [0, 2]]
        size = float(np.linalg.norm(force)) * scales.arrow
        if size > 0.0 and silhouette:
            outline = np.concatenate(silhouette)
            head = "-|>,head_width=0.25,head_length=0.5" if size > SHORTEST_ARROW else "-"
            # From the lowest point, but moved so that the head is in the picture.
            low, high = np.transpose([scales.x_limits, scales.z_limits])
            tip = np.clip(outline[np.argmin(outline[:, 1])] + force * scales.arrow, low, high)
            draw_force(axis, body, force, tip - force * scales.arrow, tip, head=head, clip=False, line=line)
    axis.set(xlim=scales.x_limits, ylim=scales.z_limits, aspect="equal")
    axis.set_title(f"{title}, t = {run.time[frame]:.2f} s")


# --- The whole bed with its tool: simulated, predicted, and their difference ---------------------------

# A force arrow of the larger force is this share of the picture's width long.
SOLID_ARROW = 0.25


def solid_views(truth: Any, prediction: Any, frame: int, start: np.ndarray) -> Mapping[str, Figure]:
    """Three pictures of one moment: displacement, simulated and predicted, and the distance between them.

    `start` are the particles at rest [m], shape (n, 3).
    """
    true, predicted = truth.positions(frame)[0], prediction.positions(frame)[0]
    moved, moved_predicted, error = (
        1e3 * np.linalg.norm(difference, axis=1)
        for difference in (true - start, predicted - start, predicted - true)
    )
    strongest = max(float(np.linalg.norm(run.force[frame])) for run in (truth, prediction))
    displacement = "displacement [mm]", ScalarMappable(upper_scale(moved), SPEED)
    wrong = "distance from the simulated place [mm]", ScalarMappable(upper_scale(error), ERROR)
    return {
        title: solid_figure(title, run, frame, positions, values, *colours, start, strongest)
        for title, run, positions, values, colours in (
            ("simulated (MPM)", truth, true, moved, displacement),
            ("network", prediction, predicted, moved_predicted, displacement),
            ("network, its error", prediction, predicted, error, wrong),
        )
    }


@styled
def solid_figure(
    title: str,
    run: Any,
    frame: int,
    positions: np.ndarray,
    values: np.ndarray,
    label: str,
    colours: ScalarMappable,
    start: np.ndarray,
    strongest: float,
) -> Figure:
    """Particles (n, 3) [m] as spheres coloured by values (n,), and the own body of a run with the force on it.

    The particles at rest, `start`, set the frame of the picture; the force `strongest` [N] has the longest arrow.
    """
    spacing, triangles = particle_spacing(start), body_triangles(run, frame)
    low, high = start.min(axis=0) - spacing, start.max(axis=0) + spacing
    tool = triangles[..., 2].max(initial=-np.inf) + spacing
    high[2] = np.clip(tool, high[2], high[2] + TOOL_ABOVE)
    box = project(np.where(CUBE > 0.0, high, low))[:, :2]
    left_bottom, right_top = box.min(axis=0), box.max(axis=0)
    buffer = DepthBuffer(left_bottom, right_top, width=round(DPI * (PICTURE_WIDTH - 0.2)))
    buffer.spheres(project(positions), 0.55 * spacing, colours.to_rgba(values)[:, :3])
    buffer.triangles(project(triangles), np.array(to_rgb(STEEL)))

    height, width = buffer.nearness.shape
    figure = new_figure(PICTURE_WIDTH, PICTURE_WIDTH * height / width + 0.95)
    axis = figure.subplots()
    axis.imshow(np.clip(buffer.colour, 0.0, 1.0), origin="lower", extent=buffer.extent)
    axis.set_axis_off()
    axis.set_title(f"{title}, t = {run.time[frame]:.2f} s")
    draw_directions(axis, left_bottom, right_top)
    if strongest > 0.0:
        scale = SOLID_ARROW * (right_top[0] - left_bottom[0]) / strongest
        foot = project(run.pose[frame, :3])[:2]
        tip = foot + project(run.force[frame])[:2] * scale
        draw_force(axis, run, run.force[frame], foot, tip, clip=False)
    figure.colorbar(colours, ax=axis, label=label, shrink=0.9, **COLOUR_BAR)
    return figure


def draw_directions(axis: Axes, low: np.ndarray, high: np.ndarray) -> None:
    """The three axes in the lower left corner, as lines about a tenth of the picture's width long."""
    length = nice(0.07 * (high[0] - low[0]))
    ends = project(length * np.eye(3))[:, :2]
    origin = low + np.array([0.02, 0.03]) * (high - low) - ends.min(axis=0, initial=0.0)
    middle: dict[str, Any] = {"ha": "center", "annotation_clip": False}
    for name, end in zip("xyz", ends, strict=True):
        axis.plot(*zip(origin, origin + end, strict=True), color=TRUTH, linewidth=1.2)
        axis.annotate(name, tuple(origin + 1.25 * end), fontsize=9, va="center", **middle)
    words, below = f"{100.0 * length:g} cm", (0, -4)
    axis.annotate(words, tuple(origin), below, textcoords="offset points", fontsize=8, va="top", **middle)


# --- What the network itself steps: the r modes as points in space, with the points of the body ---------
# Letters: T frames, r modes, M body points.

# The longest force arrow is this share of the picture's longest side long.
SUBSPACE_ARROW = 0.3


def latent_path(run: Run, basis: Basis) -> np.ndarray:
    """The modes of a run at every frame [m], shape (T, r, 3)."""
    chunks = frame_chunks(run.particle_count, run.frame_count)
    return torch.cat([basis.transform(run.positions(frames)) for frames in chunks]).numpy()


@styled
def subspace_view(truth: Run, prediction: Run, paths: tuple[np.ndarray, np.ndarray], frame: int) -> Figure:
    """Modes, body points and force at one frame, with the way that the modes have come.

    `paths` are the `latent_path` of the two runs [m], shape (T, r, 3) each.
    """
    figure = new_figure(PICTURE_WIDTH, 4.3)
    axis: Any = figure.add_subplot(projection="3d")
    body = prediction.body_points[frame]
    everything = np.concatenate([part.reshape(-1, 3) for part in (*paths, prediction.body_points)])
    low, high = everything.min(axis=0), everything.max(axis=0)
    width = float((high - low).max())
    for path, colour, filled in ((paths[0], TRUTH, "none"), (paths[1], NETWORK, NETWORK)):
        for mode in range(path.shape[1]):
            axis.plot(*path[: frame + 1, mode].T, color=colour, linewidth=0.8, alpha=0.6)
        look = {"facecolors": filled, "edgecolors": colour, "linewidths": 1.2}
        axis.scatter(*path[frame].T, s=34, depthshade=False, **look)
    axis.scatter(*body.T, s=6, color=BASELINE, marker="s", depthshade=False)
    for mode, place in enumerate(paths[0][frame], start=1):
        axis.text(place[0], place[1], place[2] + 0.03 * width, str(mode), fontsize=8)
    strongest = max(float(np.linalg.norm(run.force, axis=1).max()) for run in (truth, prediction))
    if strongest > 0.0:
        for run, colour in ((truth, TRUTH), (prediction, NETWORK)):
            arrow = SUBSPACE_ARROW * width / strongest * run.force[frame]
            axis.quiver(*body.mean(axis=0), *arrow, color=colour, linewidth=1.4)
    # Modes are no places: a short side is stretched, so that what lies close together can be told apart.
    low, high = low - 0.05 * width, high + 0.05 * width
    longest = float((high - low).max())
    axis.set_box_aspect(np.maximum(high - low, 0.6 * longest), zoom=0.95)
    for name, start, end in zip("xyz", low, high, strict=True):
        getattr(axis, f"set_{name}lim")(start, end)
        getattr(axis, f"set_{name}label")(f"{name} [m]", fontsize=9, labelpad=-1.0)
        getattr(axis, f"{name}axis").set_major_locator(MaxNLocator(4))  # so that numbers stay apart
    axis.tick_params(labelsize=8, pad=0)
    axis.view_init(elev=18, azim=-65)
    axis.set_title(f"t = {prediction.time[frame]:.2f} s")
    marks: dict[str, dict[str, Any]] = {
        "simulated (MPM)": {"color": TRUTH, "marker": "o", "markerfacecolor": "none", "linewidth": 0.8},
        "network": {"color": NETWORK, "marker": "o", "linewidth": 0.8},
        "body": {"color": BASELINE, "marker": "s", "markersize": 3, "linewidth": 0.0},
    }
    legend_above(figure, [Line2D([], [], label=label, **look) for label, look in marks.items()], ncols=3)
    return figure
