"""Pictures of runs and of errors, for reports and experiments.

Every function returns a matplotlib figure that no window owns; `png` turns one into bytes. Colours mean the
same everywhere: truth black, network blue, baselines grey.
"""

from __future__ import annotations

import functools
import io
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ParamSpec, TypeVar

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogFormatter, LogLocator

from sgns.evaluation.surface import SurfaceGrid, height_map

__all__ = ["energy_figure", "png", "profile_figure", "reconstruction_figure"]

TRUTH = "#1a1a1a"
NETWORK = "#0072b2"  # blue and vermilion of Okabe and Ito's palette: told apart by every eye
ACCENT = "#d55e00"
BASELINE = "#8c8c8c"

DPI = 130
# All of a report's pictures are this wide [inches]: on a phone one fills the screen and its words can still be
# read, on a desk and on paper several stand side by side.
PICTURE_WIDTH = 4.8
STYLE: dict[str, Any] = {
    "font.size": 10.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10.0,
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "legend.fontsize": 9.0,
    "lines.linewidth": 1.6,
    "text.parse_math": False,  # names of runs may hold anything
}


P = ParamSpec("P")
R = TypeVar("R")


def styled(draw: Callable[P, R]) -> Callable[P, R]:
    """Draws in the project's style and leaves matplotlib's settings as they were."""

    @functools.wraps(draw)
    def inside(*args: P.args, **kwargs: P.kwargs) -> R:
        with matplotlib.rc_context(STYLE):
            return draw(*args, **kwargs)

    return inside


def new_figure(width: float, height: float, layout: str = "constrained") -> Figure:
    """An empty figure of a size in inches, drawn without a display."""
    figure = Figure(figsize=(width, height), dpi=DPI, layout=layout)
    FigureCanvasAgg(figure)
    return figure


@styled
def png(figure: Figure) -> bytes:
    """A figure as the bytes of a PNG file, the same for the same figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


# --- surface -------------------------------------------------------------------------------------------


@styled
def profile_figure(runs: Mapping[str, Any], frames: Sequence[int], grid: SurfaceGrid) -> Figure:
    """Height of the surface along the middle of the bed, at some frames.

    Args:
        runs: `Run`s by name; `truth` is drawn black, `network` blue.
        frames: one panel each.
        grid: columns of the height map; the two rows of columns next to mid-width are averaged.
    """
    figure = new_figure(PICTURE_WIDTH, 1.45 * len(frames) + 0.8)
    axes = figure.subplots(len(frames), 1, squeeze=False, sharex=True, sharey=True)[:, 0]
    count = grid.shape[1]
    middle = slice((count - 1) // 2, count // 2 + 1)
    rest: np.ndarray | None = None
    for axis, frame in zip(axes, frames, strict=True):
        for name, run in runs.items():
            if rest is None:
                rest = middle_line(run, 0, grid, middle)
            colour = TRUTH if name.startswith("simulated") else NETWORK
            heights = middle_line(run, frame, grid, middle)
            axis.plot(grid.x_centres, heights, color=colour, label=name, marker=".", markersize=4)
            axis.set_title(f"t = {run.time[frame]:.2f} s")
        axis.plot(grid.x_centres, rest, color=BASELINE, linestyle="--", label="before")
        axis.grid(alpha=0.25, linewidth=0.6)
    axes[-1].set_xlabel("x [m]")
    figure.supylabel("highest particle [mm]", fontsize=10)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(handles), fontsize=8.5)
    return figure


def middle_line(run: Any, frame: int, grid: SurfaceGrid, middle: slice) -> np.ndarray:
    """Surface height along x, mean over the columns of a slice [mm], shape (nx,)."""
    heights = height_map(run.positions(slice(frame, frame + 1))[0], grid)[:, middle]
    filled = np.isfinite(heights)
    total = np.where(filled, heights, 0.0).sum(axis=1)
    return 1e3 * np.divide(
        total, filled.sum(axis=1), out=np.full(len(total), np.nan), where=filled.any(axis=1)
    )


# --- reduction --------------------------------------------------------------------------------------------


@styled
def energy_figure(energy: np.ndarray, displacement_energy: np.ndarray, num_modes: int) -> Figure:
    """What the modes do not hold of the training data's variance.

    Args:
        energy: the paper's cumulative energy for r = 1 … R, shape (R,).
        displacement_energy: share of the variance about each particle's mean place, shape (R,).
        num_modes: modes that the network uses.
    """
    figure = new_figure(PICTURE_WIDTH, 3.4)
    axis = figure.subplots()
    r = np.arange(1, len(energy) + 1)
    for values, label, colour, width in (  # the wide one stays visible where both agree
        (energy, "energy (the paper's)", BASELINE, 5.0),
        (displacement_energy, "displacement energy", NETWORK, 1.6),
    ):
        missing = np.maximum(1.0 - np.asarray(values, dtype=np.float64), 1e-12)
        axis.semilogy(r, missing, color=colour, linewidth=width, label=label)
    plain_log_numbers(axis.yaxis)
    log_modes(axis, len(energy), num_modes)
    axis.set_ylabel("1 − energy(r), training runs")
    axis.legend(loc="lower left")
    return figure


@styled
def reconstruction_figure(
    test: np.ndarray,
    training: np.ndarray | None,
    num_modes: int,
    network_rmse_mm: float | None = None,
    label: str = "test runs",
) -> Figure:
    """Reconstruction error for r = 1, 2, 4, … modes.

    Args:
        test: reduction MSE of the evaluated runs for r = 0 … R [m²], shape (R + 1,).
        training: the same on the training runs for r = 1 … R, shape (R,).
        num_modes: modes that the network uses.
        network_rmse_mm: the network's own error, drawn as a line for comparison.
        label: name of the evaluated runs.
    """
    figure = new_figure(PICTURE_WIDTH, 3.4)
    axis = figure.subplots()
    last = len(test) - 1
    shown = sorted({min(2**k, last) for k in range(int(math.log2(max(last, 1))) + 2)})
    if training is not None:
        fitted = [1e3 * math.sqrt(max(training[r - 1], 0.0)) for r in shown]
        axis.loglog(shown, fitted, color=BASELINE, linestyle="--", marker=".", label="training runs")
    axis.loglog(
        shown,
        [1e3 * math.sqrt(test[r]) for r in shown],
        color=ACCENT,
        marker="o",
        markersize=4,
        label=label,
    )
    if network_rmse_mm is not None and math.isfinite(network_rmse_mm) and network_rmse_mm > 0.0:
        axis.axhline(network_rmse_mm, color=NETWORK, label="rollout of the network")
    log_modes(axis, last, num_modes)
    axis.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_ylabel("reconstruction RMSE [mm]")
    axis.legend(loc="lower left")
    return figure


def plain_log_numbers(axis: Axis) -> None:
    """Numbers along a logarithmic axis without the formulas that matplotlib would write."""
    axis.set_major_formatter(LogFormatter())
    axis.set_minor_formatter(LogFormatter())


def log_modes(axis: Axes, last: int, num_modes: int) -> None:
    """A logarithmic axis of mode counts with the network's count marked."""
    axis.set_xscale("log", base=2)
    ticks = [2**k for k in range(int(math.log2(max(last, 1))) + 1)]
    axis.set_xticks(ticks, [str(t) for t in ticks])
    axis.minorticks_off()
    axis.axvline(num_modes, color=TRUTH, linewidth=0.8, linestyle=":")
    axis.annotate(
        f"r = {num_modes}",
        (num_modes, 1.0),
        xycoords=("data", "axes fraction"),
        xytext=(3, -10),
        textcoords="offset points",
        fontsize=9,
    )
    axis.set_xlabel("number of modes r")
    axis.grid(alpha=0.25, linewidth=0.6)
