"""`sgns render`: a moving picture of a run, soil from the side and the forward force through time."""

from __future__ import annotations

import io
import logging
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from omegaconf import DictConfig
from PIL import Image
from tqdm import tqdm

from sgns.data.files import whole_file
from sgns.data.run import Run
from sgns.evaluate.figures import NETWORK, STYLE, TRUTH, new_figure
from sgns.evaluate.metrics import named_forces
from sgns.evaluate.views import Scales, common_scales, draw_view
from sgns.plot import picture_place, require_finite

log = logging.getLogger(__name__)

RATE = 20
"""Pictures per second at most [Hz]."""
MOST_PICTURES = 200
LONGEST = 0.2
"""Time that a picture stays [s], until some are left out; a long run plays faster than real."""
MOST_BYTES = 3_000_000
"""Of the file; pictures are left out until it is smaller."""
WIDTH, DPI = 6.8, 100  # [inches], [pixels per inch]
VIEW = 3.75  # width of a side view [inches]
HIGHEST_VIEW = 4.0  # [inches]
COLOURS = 48


def main(cfg: DictConfig) -> None:
    """Draw the run `cfg.run` into the GIF file `cfg.output`."""
    with Run(cfg.run) as run:
        path = picture_place(cfg, ".gif")
        who = "simulated (MPM)" if run.producer == "mpm" else "network"
        speed, end = moving_picture({who: run}, path), run.time[-1]
    pace = "in real time" if speed == 1.0 else f"{speed:.2g} times as fast as real"
    log.info("%s: %.3g s of %s, %s, %.1f MB", path, end, cfg.run, pace, path.stat().st_size / 1e6)


def moving_picture(runs: Mapping[str, Run], path: Path) -> float:
    """Runs below each other, by title, as a GIF of bounded size; returns how much faster than real it plays.

    Raises:
        UserError: numbers to be drawn are not finite.
    """
    first = next(iter(runs.values()))
    count = min(run.frame_count for run in runs.values())
    every = max(1, round(first.frame_rate / RATE), math.ceil(count / MOST_PICTURES))
    frames = range(0, count, every)
    for run in runs.values():
        require_finite(run, frames)
    scales = common_scales(
        list(runs.values()), frames[:: max(1, len(frames) // 8)], first.positions(0)[0].astype(np.float64)
    )
    with matplotlib.rc_context(STYLE | {"font.size": 9.5, "axes.titlesize": 9.5}):
        shown = tqdm(frames, unit="picture", desc="drawing", disable=None)
        pictures = [drawn(runs, frame, scales) for frame in shown]
    palette = Image.fromarray(np.vstack(pictures[:: max(1, len(pictures) // 6)])).quantize(COLOURS)
    indexed = [Image.fromarray(one).quantize(palette=palette, dither=Image.Dither.NONE) for one in pictures]
    step = every / first.frame_rate
    shown_for = min(step, LONGEST)
    write_gif(indexed, path, 1000.0 * shown_for)
    return step / shown_for


def drawn(runs: Mapping[str, Run], frame: int, scales: Scales) -> np.ndarray:
    """One picture, shape (height, width, 3): the side views, and the forward force up to the frame."""
    aspect = np.ptp(scales.z_limits) / np.ptp(scales.x_limits)
    width = min(VIEW, HIGHEST_VIEW / len(runs) / aspect)
    view = width * aspect
    height = max(len(runs) * (view + 0.27) + 0.25, 2.2)
    figure = new_figure(WIDTH, height, None, dpi=DPI)
    for place, (title, run) in enumerate(reversed(list(runs.items()))):
        bottom = 0.25 + place * (view + 0.27)
        axis = figure.add_axes((0.1 / WIDTH, bottom / height, width / WIDTH, view / height))
        draw_view(axis, title, run, frame, scales, width)
        axis.set(xticks=[], yticks=[])
        axis.spines[:].set_visible(False)
    across = np.ptp(scales.x_limits)
    words = f"{across:.2g} m wide; colour: speed of the soil, dark is {scales.speed.vmax:g} m/s"
    figure.text(0.1 / WIDTH, 0.09 / height, words)
    draw_chart(figure, runs, frame)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def draw_chart(figure: Figure, runs: Mapping[str, Run], frame: int) -> None:
    """The forward force through time, on the right of a picture."""
    height = figure.get_figheight()
    axis = figure.add_axes((4.6 / WIDTH, 0.55 / height, 2.05 / WIDTH, (height - 0.9) / height))
    named = {title: named_forces(run.scene, run.force) for title, run in runs.items()}
    label = next(iter(named.values()))[0][0].replace("\n", " ")
    values = {title: force[:, 0] for title, (_, force) in named.items()}
    for title, run in runs.items():
        colour = TRUTH if run.producer == "mpm" else NETWORK
        axis.plot(run.time[: frame + 1], values[title][: frame + 1], color=colour, label=title)
    finite = np.concatenate([some[np.isfinite(some)] for some in values.values()])
    low, high = min(0.0, float(finite.min())), max(0.0, float(finite.max()))
    room = (high - low) or 1.0
    longest = max(float(run.time[-1]) for run in runs.values()) or 1.0
    axis.set(xlim=(0.0, longest), ylim=(low - 0.05 * room, high + (0.25 if len(runs) > 1 else 0.05) * room))
    axis.set(title=f"{label} [N]", xlabel="time [s]")
    if len(runs) > 1:
        axis.legend(loc="upper left", ncols=2, columnspacing=1.0, handlelength=1.2)


def write_gif(pictures: Sequence[Image.Image], path: Path, duration: float) -> None:
    """Write a GIF below `MOST_BYTES`, leaving out every second picture until it is.

    All pictures have one palette, so Pillow leaves out what does not change; each stays for `duration` [ms].
    """
    while True:
        content = io.BytesIO()
        pictures[0].save(content, "GIF", save_all=True, append_images=pictures[1:], duration=duration, loop=0)
        if content.tell() <= MOST_BYTES or len(pictures) < 3:
            break
        pictures, duration = pictures[::2], 2.0 * duration
    with whole_file(path) as hidden:
        hidden.write_bytes(content.getvalue())
