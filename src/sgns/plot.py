"""Pictures of one run: `sgns plot` draws a page with side views, the surface, and force and torque through time,
`sgns render` a moving picture or a moment of it, soil from the side and the forward force through time."""

from __future__ import annotations

import io
import logging
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from omegaconf import DictConfig
from PIL import Image
from tqdm import tqdm

from mpm_warp.motions import sinkage
from sgns.config import UserError
from sgns.data.files import require_new, require_replaceable, whole_file
from sgns.data.run import Run
from sgns.data.surface import columns, height_map, particle_spacing
from sgns.evaluate.body_shape import bodies, body_silhouette
from sgns.evaluate.figures import (
    NETWORK,
    PICTURE_WIDTH,
    STYLE,
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
from sgns.evaluate.views import (
    COLOUR_BAR,
    Scales,
    common_scales,
    draw_body,
    draw_view,
    nice,
    side_views,
    view_times,
)
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
    who, _ = MADE_BY[run.producer]
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
    for body in bodies(run):
        draw_body(axis, body_silhouette(body, frame, (0, 1)))
    axis.set(xlim=(left, right), ylim=(front, back), xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axis.set_title(f"surface from above, t = {run.time[frame]:.2f} s")
    label = "height z of the surface [mm]"
    figure.colorbar(colours, ax=axis, label=label, shrink=0.9, ticks=MaxNLocator(5), **COLOUR_BAR)
    return figure


LEAST_ARM = 1e-6
"""A torque with a shorter lever of the largest force is rounding [m]."""


MADE_BY = {
    "mpm": ("simulated (MPM)", TRUTH),
    "rollout": ("network", NETWORK),
    "imported": ("imported", TRUTH),
}
"""Producer of a run → what pictures call it, and the colour of its forces."""


def shown_bodies(run: Run) -> list[tuple[str, str, Any]]:
    """Of each body whose forces are drawn its name, its colour, and what `bodies` has for it."""
    own, *more = bodies(run)
    name, colour = MADE_BY[run.producer]
    further = [(f"others[{i}]", body.colour, body) for i, body in enumerate(more)]
    return further if further and not run.body_point_count else [(name, colour, own), *further]


def curves(run: Run) -> list[Panel]:
    """Forces and torques worth mentioning, the sinkage of a wheel and the height of free bodies, through time."""
    shown = shown_bodies(run)
    forces = [named_forces(run.scene, body.force) for _, _, body in shown]
    torques = [named_torques(run.scene, body.torque) for _, _, body in shown]
    parts: list[tuple[str, list[np.ndarray | None]]] = []
    largest = max(float(np.abs(values).max()) for _, values in forces)
    for named, unit in ((forces, "N"), (torques, "N m")):
        names, every = named[0][0], [values for _, values in named]
        if not max(float(np.abs(values).max()) for values in every) > LEAST_ARM * largest:
            continue
        worth = np.flatnonzero(worth_showing(*every))  # the others are zero by symmetry
        parts += [(f"{names[axis]} [{unit}]", [values[:, axis] for values in every]) for axis in worth]
    if not parts:
        parts = [(f"{forces[0][0][0]} [N]", [values[:, 0] for _, values in forces])]
    if is_wheel(run.scene):
        parts.append(("sinkage [mm]", [1e3 * sinkage(run.scene, run.pose), *([None] * (len(shown) - 1))]))
    if any(body.scene.get("motion") == "free" for _, _, body in shown):
        heights = [
            1e3 * body.pose[:, 2] if body.scene.get("motion") == "free" else None for _, _, body in shown
        ]
        parts.append(("z of centre [mm]", heights))
    # A small component is drawn as small as it is beside the largest force.
    least = 0.1 * max(float(np.ptp(values, axis=0).max()) for _, values in forces)
    return [
        Panel(
            label,
            [
                Curve(name, run.time, values, colour)
                for (name, colour, _), values in zip(shown, every, strict=True)
                if values is not None
            ],
            least_height=least if "[N]" in label else 0.0,
        )
        for label, every in parts
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


# --- A moving picture -----------------------------------------------------------------------------------

RATE = 20
"""Pictures per second at most [Hz]."""
MOST_PICTURES = 200
LONGEST = 0.2
"""Time that a picture stays [s], until some are left out; a long run plays faster than real."""
MOST_BYTES = 3_000_000
"""Of the file; pictures are left out until it is smaller."""
WIDTH, DPI = 6.8, 100  # [inches], [pixels per inch]
VIEW = 3.75  # width of a side view [inches]
HIGHEST_MOVING_VIEW = 4.0  # [inches]
COLOURS = 48


def render(cfg: DictConfig) -> None:
    """Draw the run `cfg.run` into the file `cfg.output`: a moving picture, or as a PNG its last moment of work."""
    with Run(cfg.run) as run:
        path = picture_place(cfg, ".gif", ".mp4", ".png")
        if path.suffix.lower() == ".mp4":
            video()  # before anything is drawn
        who, _ = MADE_BY[run.producer]
        if path.suffix.lower() == ".png":
            frame = shown_times(run)[-1]
            still({who: run}, frame, path)
            log.info("%s: %s at %.3g s", path, cfg.run, run.time[frame])
            return
        speed, end = moving_picture({who: run}, path), run.time[-1]
    pace = "in real time" if speed == 1.0 else f"{speed:.2g} times as fast as real"
    log.info("%s: %.3g s of %s, %s, %.1f MB", path, end, cfg.run, pace, path.stat().st_size / 1e6)


def moving_picture(runs: Mapping[str, Run], path: Path) -> float:
    """Runs below each other, by title, as a GIF or MP4 of bounded size; returns how much faster than real it plays.

    Raises:
        UserError: numbers to be drawn are not finite, or the library for MP4 is missing.
    """
    first = next(iter(runs.values()))
    count = min(run.frame_count for run in runs.values())
    every = max(1, round(first.frame_rate / RATE), math.ceil(count / MOST_PICTURES))
    pictures = drawn_frames(runs, range(0, count, every))
    step = every / first.frame_rate
    shown_for = min(step, LONGEST)
    if path.suffix.lower() == ".mp4":
        write_mp4(pictures, path, 1.0 / shown_for)
    else:
        palette = Image.fromarray(np.vstack(pictures[:: max(1, len(pictures) // 6)])).quantize(COLOURS)
        indexed = [
            Image.fromarray(one).quantize(palette=palette, dither=Image.Dither.NONE) for one in pictures
        ]
        write_gif(indexed, path, 1000.0 * shown_for)
    return step / shown_for


def still(runs: Mapping[str, Run], frame: int, path: Path) -> None:
    """One picture of those as a PNG file.

    Raises:
        UserError: numbers to be drawn are not finite.
    """
    (picture,) = drawn_frames(runs, [frame], 2)
    with whole_file(path) as hidden:
        Image.fromarray(picture).save(hidden, format="png")


def drawn_frames(runs: Mapping[str, Run], frames: Sequence[int], scale: int = 1) -> list[np.ndarray]:
    """Pictures of some frames, (height, width, 3) each; `scale` times as fine.

    Raises:
        UserError: numbers to be drawn are not finite.
    """
    for run in runs.values():
        require_finite(run, frames)
    start = next(iter(runs.values())).positions(0)[0].astype(np.float64)
    scales = common_scales(list(runs.values()), frames[:: max(1, len(frames) // 8)], start)
    with matplotlib.rc_context(STYLE | {"font.size": 9.5, "axes.titlesize": 9.5}):
        shown = tqdm(frames, unit="picture", desc="drawing", disable=None if len(frames) > 1 else True)
        return [drawn(runs, frame, scales, scale * DPI) for frame in shown]


def drawn(runs: Mapping[str, Run], frame: int, scales: Scales, dpi: int = DPI) -> np.ndarray:
    """One picture, shape (height, width, 3): the side views, and the forward force up to the frame."""
    aspect = np.ptp(scales.z_limits) / np.ptp(scales.x_limits)
    width = min(VIEW, HIGHEST_MOVING_VIEW / len(runs) / aspect)
    view = width * aspect
    height = max(len(runs) * (view + 0.27) + 0.25, 2.2)
    figure = new_figure(WIDTH, height, None, dpi=dpi)
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
    """The forward force through time, on the right of a picture; the vertical one where only further bodies are."""
    height = figure.get_figheight()
    axis = figure.add_axes((4.6 / WIDTH, 0.55 / height, 2.05 / WIDTH, (height - 0.9) / height))
    shown = [(title, run, *one) for title, run in runs.items() for one in shown_bodies(run)]
    way = 0 if any(run.body_point_count for run in runs.values()) else 2
    label, values = "", []
    for title, run, name, colour, body in shown:
        if body is run:
            name = title if len(runs) > 1 else "own body"
        names, force = named_forces(run.scene, body.force)
        label = names[way].replace("\n", " ")
        values.append(force[:, way])
        axis.plot(run.time[: frame + 1], values[-1][: frame + 1], color=colour, label=name)
    finite = np.concatenate([some[np.isfinite(some)] for some in values])
    low, high = min(0.0, float(finite.min())), max(0.0, float(finite.max()))
    room = (high - low) or 1.0
    above = 0.13 + 0.12 * math.ceil(0.5 * len(shown)) if len(shown) > 1 else 0.05
    longest = max(float(run.time[-1]) for run in runs.values()) or 1.0
    axis.set(xlim=(0.0, longest), ylim=(low - 0.05 * room, high + above * room))
    axis.set(title=f"{label} [N]", xlabel="time [s]")
    if len(shown) > 1:
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


def video() -> Any:
    """The library that writes videos.

    Raises:
        UserError: it is not installed.
    """
    try:
        import imageio_ffmpeg
    except ImportError:
        raise UserError(
            "an MP4 file needs imageio-ffmpeg: pip install 'sgns[video]', or choose a .gif file"
        ) from None
    return imageio_ffmpeg


def write_mp4(pictures: Sequence[np.ndarray], path: Path, rate: float) -> None:
    """Write pictures (height, width, 3) as an MP4 file, so many a second [Hz]."""
    height, width = (size - size % 2 for size in pictures[0].shape[:2])  # the format takes even sizes
    with whole_file(path) as hidden:
        options = {"fps": rate, "codec": "libx264", "quality": None, "macro_block_size": 2}
        more = ["-crf", "20", "-movflags", "+faststart", "-f", "mp4"]
        writer = video().write_frames(
            str(hidden), (width, height), output_params=more, ffmpeg_log_level="error", **options
        )
        writer.send(None)
        for one in pictures:
            writer.send(np.ascontiguousarray(one[:height, :width]))
        writer.close()


# --- For both: a run that can be drawn, the name of its picture -------------------------------------------


def picture_place(cfg: DictConfig, *suffixes: str) -> Path:
    """Where the picture goes: `cfg.output`, else beside the run with its name and the first of some suffixes.

    Raises:
        UserError: it has another suffix, or is there and `cfg.overwrite` is false.
    """
    path = Path(cfg.output or f"{os.path.splitext(cfg.run)[0]}{suffixes[0]}")
    wanted = path.suffix.lower() if path.suffix.lower() in suffixes else suffixes[0]
    require_new(path, cfg.overwrite, "the picture", wanted)
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
