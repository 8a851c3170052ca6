"""The README's moving picture: a test run of the demo, simulated above and predicted below, with the draft beside.

    make demo
    python experiments/quick/moving_picture.py

It plays in real time: every third frame of 1/60 s. Writes cut.gif beside this file.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from sgns import Run
from sgns.evaluate.figures import NETWORK, STYLE, TRUTH
from sgns.evaluate.views import Scales, common_scales, draw_view

HERE = Path(__file__).resolve().parent
RUN = "0024_motion-curved_rake-3.8_depth-0.08_speed-0.04.h5"
EVERY = 3
WIDTH, DPI = 6.8, 100  # [inches], [pixels per inch]
VIEW = 3.75  # width of a side view [inches]
COLOURS = 48


def main() -> None:
    rollouts = Path("outputs/demo/evaluation/rollouts")
    with Run(Path("data/quick/runs") / RUN) as truth, Run(rollouts / RUN) as network:
        frames = range(0, min(truth.frame_count, network.frame_count), EVERY)
        scales = common_scales([truth, network], frames[:: len(frames) // 8], truth.positions(slice(0, 1))[0])
        with matplotlib.rc_context(STYLE | {"font.size": 9.0, "axes.titlesize": 9.5}):
            pictures = [picture(truth, network, frame, scales) for frame in frames]
    save(pictures, HERE / "cut.gif", 1000 * EVERY / 60)


def picture(truth: Run, network: Run, frame: int, scales: Scales) -> Image.Image:
    """One frame: the two side views, and the draft up to it."""
    view = VIEW * np.ptp(scales.z_limits) / np.ptp(scales.x_limits)
    height = 2.0 * (view + 0.27) + 0.25
    figure = Figure(figsize=(WIDTH, height), dpi=DPI)
    canvas = FigureCanvasAgg(figure)
    for bottom, title, run in ((view + 0.52, "solver", truth), (0.25, "network", network)):
        axis = figure.add_axes((0.015, bottom / height, VIEW / WIDTH, view / height))
        draw_view(axis, title, run, frame, scales, VIEW)
        axis.set(xticks=[], yticks=[])
        axis.spines[:].set_visible(False)
    figure.text(0.02, 0.09 / height, f"colour: speed of the soil, dark is {scales.speed.vmax:g} m/s")
    axis = figure.add_axes((0.675, 0.13, 0.31, 0.76))
    for run, colour, label in ((truth, TRUTH, "solver"), (network, NETWORK, "network")):
        axis.plot(run.time[: frame + 1], -run.force[: frame + 1, 0], color=colour, label=label)
    highest = max(float((-run.force[:, 0]).max()) for run in (truth, network))
    axis.set(xlim=(0.0, truth.time[-1]), ylim=(-0.05 * highest, 1.25 * highest))
    axis.set(title="draft on the blade [N]", xlabel="time [s]")
    axis.legend(loc="upper left", ncols=2, columnspacing=1.0, handlelength=1.2)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())


def save(pictures: list[Image.Image], file: Path, duration: float) -> None:
    """As a GIF with one palette; Pillow leaves out what does not change from frame to frame."""
    sample = np.vstack([np.asarray(one) for one in pictures[:: max(1, len(pictures) // 6)]])
    palette = Image.fromarray(sample).quantize(COLOURS, dither=Image.Dither.NONE)
    indexed = [one.quantize(palette=palette, dither=Image.Dither.NONE) for one in pictures]
    indexed[0].save(file, save_all=True, append_images=indexed[1:], duration=duration, loop=0)


if __name__ == "__main__":
    main()
