"""The whole bed in three dimensions with its tool: the simulated one, the predicted one and their difference."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize, to_rgb
from matplotlib.figure import Figure

from sgns.evaluation.bodies import body_corners
from sgns.evaluation.depth_buffer import Camera, DepthBuffer, hull_triangles
from sgns.evaluation.figures import DPI, NETWORK, PICTURE_WIDTH, TRUTH, new_figure, styled
from sgns.evaluation.sideview import SPEED, STEEL, nice
from sgns.evaluation.surface import particle_spacing

__all__ = ["solid_views"]

# No error looks like the paper; the larger, the darker.
ERROR = LinearSegmentedColormap.from_list("error", ["#f2f2ee", "#9cc3dd", "#3d7fb1", "#22356f", "#0c0c26"])
# A force arrow of the larger force is this share of the picture's width long.
ARROW_SHARE = 0.25
# A tool is shown up to so much above the bed [m].
TOOL_ABOVE = 0.22


@dataclass(frozen=True)
class Colouring:
    """What colours the particles, and how.

    Attributes:
        label: of the colour bar.
        values: shape (n,).
        scale: range of the colours.
        colours: from low to high.
    """

    label: str
    values: np.ndarray
    scale: Normalize
    colours: LinearSegmentedColormap


def solid_views(truth: Any, prediction: Any, frame: int, start: np.ndarray) -> Mapping[str, Figure]:
    """Three pictures of one moment: displacement, simulated and predicted, and the distance between them.

    Args:
        truth: the simulated `Run`.
        prediction: the predicted `Run`.
        frame: to draw.
        start: common start of the particles [m], shape (n, 3).
    """
    runs = {"simulated (MPM)": truth, "network": prediction}
    positions = {title: run.positions(slice(frame, frame + 1))[0] for title, run in runs.items()}
    moved = {title: 1e3 * np.linalg.norm(p - start, axis=1) for title, p in positions.items()}
    error = 1e3 * np.linalg.norm(positions["network"] - positions["simulated (MPM)"], axis=1)
    displacement = upper_scale(moved["simulated (MPM)"])
    strongest = max(float(np.linalg.norm(run.force[frame])) for run in runs.values())
    views = {
        title: (run, positions[title], Colouring("displacement [mm]", moved[title], displacement, SPEED))
        for title, run in runs.items()
    }
    views["network, its error"] = (
        prediction,
        positions["network"],
        Colouring("distance from the simulated place [mm]", error, upper_scale(error), ERROR),
    )
    return {
        title: solid_figure(
            f"{title}, t = {run.time[frame]:.2f} s", run, frame, p, colouring, start, strongest
        )
        for title, (run, p, colouring) in views.items()
    }


def upper_scale(values: np.ndarray) -> Normalize:
    """From zero to about the largest of the values."""
    top = float(np.percentile(values, 99.5))
    return Normalize(0.0, nice(top) if top > 0.0 else 1.0)


@styled
def solid_figure(
    title: str,
    run: Any,
    frame: int,
    positions: np.ndarray,
    colouring: Colouring,
    start: np.ndarray,
    strongest: float,
) -> Figure:
    """Particles as spheres, the body, and the force on it.

    Args:
        title: of the picture.
        run: `Run` that the body and the force are taken from.
        frame: to draw.
        positions: of the particles [m], shape (n, 3).
        colouring: of the particles.
        start: common start of the particles [m], shape (n, 3), which sets the frame of the picture.
        strongest: force [N] that has the longest arrow.
    """
    camera, spacing = Camera(), particle_spacing(start)
    low, high = start.min(axis=0) - spacing, start.max(axis=0) + spacing
    corners = body_corners(run, frame)
    high[2] = np.clip(corners[:, 2].max() + spacing, high[2], high[2] + TOOL_ABOVE)
    box = camera.project(
        np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), -1).reshape(-1, 3)
    )
    left_bottom, right_top = box[:, :2].min(axis=0), box[:, :2].max(axis=0)

    buffer = DepthBuffer(left_bottom, right_top, width=round(DPI * (PICTURE_WIDTH - 0.2)))
    colours = colouring.colours(colouring.scale(colouring.values))[:, :3]
    buffer.spheres(camera.project(positions), 0.55 * spacing, colours)
    buffer.triangles(camera.project(hull_triangles(corners)), np.array(to_rgb(STEEL)))

    height, width = buffer.nearness.shape
    figure = new_figure(PICTURE_WIDTH, PICTURE_WIDTH * height / width + 0.95)
    axis = figure.subplots()
    axis.imshow(np.clip(buffer.colour, 0.0, 1.0), origin="lower", extent=buffer.extent)
    axis.set_axis_off()
    axis.set_title(title)
    draw_directions(axis, camera, left_bottom, right_top)
    draw_force(axis, camera, run, frame, strongest, right_top[0] - left_bottom[0])
    bar = figure.colorbar(
        ScalarMappable(colouring.scale, colouring.colours),
        ax=axis,
        location="bottom",
        shrink=0.9,
        aspect=40,
        pad=0.02,
    )
    bar.set_label(colouring.label)
    return figure


def draw_directions(axis: Axes, camera: Camera, low: np.ndarray, high: np.ndarray) -> None:
    """The three axes in the lower left corner, as lines about a tenth of the picture's width long."""
    length = nice(0.07 * (high[0] - low[0]))
    ends = camera.project(length * np.eye(3))[:, :2]
    origin = low + np.array([0.02, 0.03]) * (high - low) - ends.min(axis=0, initial=0.0)
    for name, end in zip("xyz", ends, strict=True):
        axis.plot(*zip(origin, origin + end, strict=True), color=TRUTH, linewidth=1.2)
        axis.annotate(name, origin + 1.25 * end, fontsize=9, ha="center", va="center", annotation_clip=False)
    axis.annotate(
        f"{100.0 * length:g} cm",
        origin,
        xytext=(0, -4),
        textcoords="offset points",
        fontsize=8,
        ha="center",
        va="top",
    )


def draw_force(axis: Axes, camera: Camera, run: Any, frame: int, strongest: float, width: float) -> None:
    """The force on the body as an arrow from its centre of mass, and its size."""
    force = np.asarray(run.force[frame])
    size = float(np.linalg.norm(force))
    colour = TRUTH if run.producer == "mpm" else NETWORK
    if not 0.0 < size < np.inf:
        return
    foot = camera.project(run.pose[frame, :3])[:2]
    tip = foot + camera.project(force)[:2] * ARROW_SHARE * width / strongest
    arrow = {"arrowstyle": "-|>", "color": colour, "linewidth": 2.0, "shrinkA": 0.0, "shrinkB": 0.0}
    axis.annotate("", xy=tip, xytext=foot, arrowprops=arrow, annotation_clip=False)
    axis.text(
        0.99, 0.97, f"{size:.0f} N", color=colour, fontsize=9, ha="right", va="top", transform=axis.transAxes
    )
