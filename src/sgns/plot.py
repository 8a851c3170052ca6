"""`sgns plot`: one picture of a run with side views, the surface, and force and torque through time."""

from __future__ import annotations

import io
import logging
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from omegaconf import DictConfig
from PIL import Image

from mpm_warp.motions import sinkage
from sgns.config import UserError
from sgns.data.files import require_new, require_replaceable, whole_file
from sgns.data.run import Run, columns, height_map, particle_spacing
from sgns.evaluate.body_shape import body_silhouette
from sgns.evaluate.figures import (
    NETWORK,
    PICTURE_WIDTH,
    TRUTH,
    Curve,
    Panel,
    history_figure,
    new_figure,
    png,
    styled,
    worth_showing,
)
from sgns.evaluate.metrics import named_forces, named_torques
from sgns.evaluate.views import COLOUR_BAR, common_scales, draw_body, nice, side_views, view_times
from sgns.model.features import is_wheel

log = logging.getLogger(__name__)

# A view of soil is at most so high [inches]: a column is drawn narrower.
HIGHEST_VIEW = 3.0
WORDS_WIDTH = 0.75
"""Of the numbers and the label beside a view [inches]."""
MOST_COLUMNS = 500
"""Along a side of the map."""


def main(cfg: DictConfig) -> None:
    """Draw the run `cfg.run` into the PNG file `cfg.output`."""
    with Run(cfg.run) as run:
        path = picture_place(cfg, ".png")
        page = run_page(run)
    with whole_file(path) as hidden:
        page.save(hidden, format="png")
    log.info("%s: side views, surface, force and torque of %s", path, cfg.run)


def run_page(run: Run) -> Image.Image:
    """Soil on the left, curves on the right, the surface where there is more room, and the run's name above.

    Raises:
        UserError: numbers to be drawn are not finite.
    """
    frames, last = shown_times(run), run.frame_count - 1
    require_finite(run, sorted({0, *frames, last}))
    start = run.positions(0)[0].astype(np.float64)
    scales = common_scales([run], frames, start)
    narrow = HIGHEST_VIEW * np.ptp(scales.x_limits) / np.ptp(scales.z_limits)
    views = [[("near mid-width", run, frame)] for frame in frames]
    soil = side_views(views, scales, width=min(PICTURE_WIDTH - WORDS_WIDTH, narrow))
    sides = [[soil], [history_figure(curves(run))]]
    min(sides, key=lambda figures: figures[0].get_figheight()).append(surface_figure(run, last, start))
    page = joined([joined([picture(figure) for figure in column], down=True) for column in sides], down=False)
    return joined([picture(title_figure(run)), page], down=True)


@styled
def title_figure(run: Run) -> Figure:
    """A line with what the run is."""
    figure = new_figure(2 * PICTURE_WIDTH, 0.4)
    who = "simulated (MPM)" if run.producer == "mpm" else "network"
    name = run.path.name if len(run.path.name) < 60 else f"{run.path.name[:57]}..."
    words = f"{name}: {run.scene.get('kind', 'scene')}, {who}, {run.particle_count} particles, {run.time[-1]:.3g} s"
    figure.text(0.012, 0.5, words, fontsize=11, va="center")
    return figure


@styled
def surface_figure(run: Any, frame: int, start: np.ndarray) -> Figure:
    """Height of the surface at a frame, seen from above, with the body; `start` is the soil at rest [m], (n, 3)."""
    soil, spacing = run.positions(frame)[0], particle_spacing(start)
    low = np.minimum(start.min(axis=0), soil.min(axis=0)) - 0.5 * spacing
    high = np.maximum(start.max(axis=0), soil.max(axis=0)) + 0.5 * spacing
    grid = columns(low, high, max(spacing, float((high - low)[:2].max()) / MOST_COLUMNS))
    heights = 1e3 * (height_map(soil, grid) + 0.5 * spacing)
    # A flat bed looks flat, and a few particles in the air leave the scale as it is.
    top = nice(max(float(np.nanpercentile(np.abs(heights), 99.0)), 2e3 * spacing))
    scale = Normalize(-top, top)
    (left, right), (front, back) = (edges[[0, -1]] for edges in (grid.x_edges, grid.y_edges))
    width = min(PICTURE_WIDTH - WORDS_WIDTH, HIGHEST_VIEW * (right - left) / (back - front))
    figure = new_figure(PICTURE_WIDTH, max(width, 0.5) * (back - front) / (right - left) + 1.5, "compressed")
    axis = figure.subplots()
    extent = (left, right, front, back)
    colours = axis.imshow(heights.T, origin="lower", extent=extent, cmap="PuOr_r", norm=scale)
    draw_body(axis, body_silhouette(run, frame, (0, 1)))
    axis.set(xlim=(left, right), ylim=(front, back), xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axis.set_title(f"surface from above, t = {run.time[frame]:.2f} s")
    label = "height z of the surface [mm]"
    figure.colorbar(colours, ax=axis, label=label, shrink=0.9, ticks=MaxNLocator(5), **COLOUR_BAR)
    return figure


def curves(run: Run) -> list[Panel]:
    """Forces and torques worth mentioning, and the sinkage of a wheel, through time."""
    name, colour = ("simulated (MPM)", TRUTH) if run.producer == "mpm" else ("network", NETWORK)
    forces, torques = named_forces(run.scene, run.force), named_torques(run.scene, run.torque)
    parts = []
    for (names, values), unit in ((forces, "N"), (torques, "N m")):
        shown = np.flatnonzero(worth_showing(values))  # the others are zero by symmetry
        parts += [(f"{names[axis]} [{unit}]", values[:, axis]) for axis in shown]
    if not parts:
        parts = [(f"{forces[0][0]} [N]", forces[1][:, 0])]
    if is_wheel(run.scene):
        parts.append(("sinkage [mm]", 1e3 * sinkage(run.scene, run.pose)))
    # A small component is drawn as small as it is beside the largest force.
    least = 0.1 * float(np.ptp(forces[1], axis=0).max())
    return [
        Panel(label, [Curve(name, run.time, values, colour)], least_height=least if "[N]" in label else 0.0)
        for label, values in parts
    ]


# --- Several figures on one page ------------------------------------------------------------------------


def picture(figure: Figure) -> Image.Image:
    """What is drawn in a figure."""
    return Image.open(io.BytesIO(png(figure))).convert("RGB")


def joined(pictures: list[Image.Image], down: bool) -> Image.Image:
    """Pictures on white, below or beside each other."""
    sizes = np.array([picture.size for picture in pictures])
    along = int(down)
    size = sizes.max(axis=0)
    size[along] = sizes[:, along].sum()
    page = Image.new("RGB", (int(size[0]), int(size[1])), "white")
    place = [0, 0]
    for picture in pictures:
        page.paste(picture, (place[0], place[1]))
        place[along] += picture.size[along]
    return page


# --- For `render`, too: a run that can be drawn, the name of its picture --------------------------------


def picture_place(cfg: DictConfig, suffix: str) -> Path:
    """Where the picture goes: `cfg.output`, else beside the run with its name.

    Raises:
        UserError: it has another suffix, or is there and `cfg.overwrite` is false.
    """
    path = Path(cfg.output or f"{os.path.splitext(cfg.run)[0]}{suffix}")
    require_new(path, cfg.overwrite, "the picture", suffix)
    require_replaceable(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def shown_times(run: Run, count: int = 3) -> list[int]:
    """Frames for side views: fewer than `count` of a run that has fewer."""
    return sorted(set(view_times(run, min(int(run.extra.get("history") or 0), run.frame_count - 1), count)))


def require_finite(run: Run, frames: Iterable[int]) -> None:
    """Refuses a run whose body, or whose soil at some frames, has no place that could be drawn.

    Raises:
        UserError: it names the frame.
    """
    body = np.isfinite(np.hstack([run.pose, run.force, run.torque])).all(axis=1)
    for frame in frames:
        soil = run.positions(frame), run.velocities(frame)
        if not (body[frame] and all(np.isfinite(part).all() for part in soil)):
            raise UserError(
                f"{run.path}: frame {frame} is not finite; `sgns check {run.path}` lists everything"
            )
