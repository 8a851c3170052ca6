"""Pictures of runs, of errors and of a training, for reports and experiments.

Every function returns a matplotlib figure that no window owns; `png` turns one into bytes. Colours mean the same
everywhere: truth black, network blue, baselines grey.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogFormatter, LogLocator, NullFormatter

from mpm_warp.motions import sinkage
from sgns.data.surface import SurfaceGrid, height_map, particle_spacing
from sgns.evaluate.metrics import (
    NEGLIGIBLE_SHARE,
    ParticleErrors,
    PositionErrors,
    named_forces,
    named_torques,
)
from sgns.model.features import is_wheel

if TYPE_CHECKING:
    from matplotlib.typing import RcKeyType

TRUTH = "#1a1a1a"
NETWORK = "#0072b2"  # blue and vermilion of Okabe and Ito's palette: told apart by every eye
ACCENT = "#d55e00"
BASELINE = "#8c8c8c"
DPI = 200  # pictures are opened in the full size of a screen
# All of a report's pictures are this wide [inches]: on a phone one fills the screen and its words can still be
# read, on a desk and on paper several stand side by side.
PICTURE_WIDTH = 4.8
STYLE: dict[RcKeyType, Any] = {
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
styled = matplotlib.rc_context(STYLE)
"""Draws in the project's style and leaves matplotlib's settings as they were."""


def new_figure(
    width: float,
    height: float,
    layout: Literal["constrained", "compressed"] | None = "constrained",
    dpi: int = DPI,
) -> Figure:
    """An empty figure of a size in inches, drawn without a display."""
    figure = Figure(figsize=(width, height), dpi=dpi, layout=layout)
    FigureCanvasAgg(figure)
    return figure


def charts(count: int, height: float, share_y: bool = False) -> tuple[Figure, Sequence[Axes]]:
    """A figure so many inches high with charts above each other that share their horizontal axis."""
    figure = new_figure(PICTURE_WIDTH, height)
    axes = figure.subplots(count, 1, squeeze=False, sharex=True, sharey=share_y)[:, 0]
    for axis in axes:
        axis.grid(alpha=0.25, linewidth=0.6)
    return figure, list(axes)


def legend_above(figure: Figure, lines: Sequence[Line2D], **more: Any) -> None:
    """One legend for all charts of a figure."""
    figure.legend(handles=lines, loc="outside upper center", fontsize=8.5, **more)


@styled
def png(figure: Figure) -> bytes:
    """A figure as the bytes of a PNG file, the same for the same figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


# --- surface -------------------------------------------------------------------------------------------


@styled
def profile_figure(runs: Mapping[str, Any], frames: Sequence[int], grid: SurfaceGrid) -> Figure:
    """Height of the surface along the middle of the bed, a panel for each of some frames.

    The two rows of columns next to mid-width are averaged. Grey: the first run at rest. As of `Run.surface`, the soil
    reaches half a particle spacing above the highest particle.
    """
    figure, axes = charts(len(frames), 1.45 * len(frames) + 0.8, share_y=True)
    first = next(iter(runs.values()))
    above = 500.0 * particle_spacing(first.positions(0)[0])  # [mm]
    rest = middle_line(first, 0, grid) + above
    for axis, frame in zip(axes, frames, strict=True):
        for name, run in runs.items():
            colour = TRUTH if name.startswith("simulated") else NETWORK
            heights = middle_line(run, frame, grid) + above
            axis.plot(grid.x_centres, heights, color=colour, label=name, marker=".", markersize=4)
            axis.set_title(f"t = {run.time[frame]:.2f} s")
        axis.plot(grid.x_centres, rest, color=BASELINE, linestyle="--", label="before")
    axes[-1].set_xlabel("x [m]")
    figure.supylabel("height z of the surface [mm]", fontsize=10)
    legend_above(figure, axes[0].get_lines(), ncols=len(runs) + 1)
    return figure


def middle_line(run: Any, frame: int, grid: SurfaceGrid) -> np.ndarray:
    """Highest particle along x, mean over the columns next to mid-width that hold particles [mm], shape (nx,)."""
    heights, count = height_map(run.positions(frame)[0], grid), grid.shape[1]
    middle = np.ma.masked_invalid(heights[:, (count - 1) // 2 : count // 2 + 1])
    return 1e3 * middle.mean(axis=1).filled(np.nan)


# --- reduction --------------------------------------------------------------------------------------------


@styled
def energy_figure(energy: np.ndarray, displacement_energy: np.ndarray, num_modes: int) -> Figure:
    """What r = 1 … R modes do not hold of the training data's variance: of the paper's cumulative energy, and of the
    share of the variance about each particle's mean place, shape (R,) each.
    """
    figure, (axis,) = charts(1, 3.4)
    r = np.arange(1, len(energy) + 1)
    for values, label, colour, width in (  # the wide one stays visible where both agree
        (energy, "energy (the paper's)", BASELINE, 5.0),
        (displacement_energy, "displacement energy", NETWORK, 1.6),
    ):
        missing = np.maximum(1.0 - np.asarray(values, dtype=np.float64), 1e-12)
        axis.semilogy(r, missing, color=colour, linewidth=width, label=label)
    plain_log_numbers(axis.yaxis)
    finish_modes(axis, len(energy), num_modes, "1 − energy(r), training runs")
    return figure


@styled
def reconstruction_figure(
    test: np.ndarray, training: np.ndarray, num_modes: int, network_rmse_mm: float
) -> Figure:
    """Reconstruction error for r = 1, 2, 4, … modes.

    `test` is the reduction MSE of the evaluated runs for r = 0 … R [m²], shape (R + 1,), `training` that of the
    training runs for r = 1 … R, shape (R,); the network's own error is drawn as a line for comparison.
    """
    figure, (axis,) = charts(1, 3.4)
    last = len(test) - 1
    shown = sorted({min(2**k, last) for k in range(int(math.log2(max(last, 1))) + 2)})
    fitted = [1e3 * math.sqrt(max(training[r - 1], 0.0)) for r in shown]
    axis.loglog(shown, fitted, color=BASELINE, linestyle="--", marker=".", label="training runs")
    held_out = [1e3 * math.sqrt(test[r]) for r in shown]
    axis.loglog(shown, held_out, color=ACCENT, marker="o", markersize=4, label="test runs")
    if 0.0 < network_rmse_mm < math.inf:
        axis.axhline(network_rmse_mm, color=NETWORK, label="rollout of the network")
    finish_modes(axis, last, num_modes, "reconstruction RMSE [mm]")
    round_numbers(axis.yaxis)
    return figure


def plain_log_numbers(axis: Axis) -> None:
    """Numbers along a logarithmic axis without the formulas that matplotlib would write."""
    axis.set_major_formatter(LogFormatter())
    axis.set_minor_formatter(LogFormatter())


def round_numbers(axis: Axis, most: int | None = None) -> None:
    """0.2 in place of 2 × 10⁻¹, at 1, 2 and 5 of every decade."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=most))
    axis.set_major_formatter(lambda value, _: f"{value:g}")


def finish_modes(axis: Axes, last: int, num_modes: int, label: str) -> None:
    """A logarithmic axis of mode counts with the network's count marked, a label of the other axis, and the legend."""
    axis.set_xscale("log", base=2)
    ticks = [2**k for k in range(int(math.log2(max(last, 1))) + 1)]
    axis.set_xticks(ticks, [str(t) for t in ticks])
    axis.minorticks_off()
    axis.axvline(num_modes, color=TRUTH, linewidth=0.8, linestyle=":")
    place: dict[str, Any] = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points"}
    axis.annotate(f"r = {num_modes}", (num_modes, 1.0), (3, -10), fontsize=9, **place)
    axis.set(xlabel="number of modes r", ylabel=label)
    axis.legend(loc="lower left")


# --- Quantities through time of one run: panels that share their time axis ------------------------------

# A force component below this share of the largest does not fill its panel.
SMALLEST_PANEL = 0.1


@dataclass(frozen=True)
class Curve:
    """A line of a panel."""

    label: str  # for the legend
    time: np.ndarray  # [s], shape (t,)
    values: np.ndarray  # shape (t,)
    colour: str  # of the line
    style: str = "-"  # matplotlib's name of the dashes
    scaled: bool = True  # whether the panel must be large enough for it
    band: np.ndarray | None = None  # half its width around the line, shape (t,)


@dataclass(frozen=True)
class Panel:
    """One quantity through time."""

    label: str  # of the vertical axis, with the unit
    curves: Sequence[Curve]  # the first is drawn lowest
    least_height: float = 0.0  # range that the axis shows at least
    from_zero: bool = False  # whether the axis begins at zero


def compared(
    labels: Sequence[str],
    read: Callable[[Any], np.ndarray],
    truth: Any,
    prediction: Any,
    history: int,
    baseline: np.ndarray | None = None,
    spread: np.ndarray | None = None,
) -> list[Panel]:
    """A panel for each of k values that `read` takes from a `Run`, shape (T, k): the truth (None for a path that was
    never simulated), the prediction after its history, perhaps with the spread (T, k) around it, and perhaps a
    baseline, the training runs' mean (k,).
    """
    time, predicted = prediction.time, read(prediction)
    simulated = None if truth is None else read(truth)
    panels = []
    for column, label in enumerate(labels):
        band = None if spread is None else spread[history:, column]
        curves = [Curve("network", time[history:], predicted[history:, column], NETWORK, band=band)]
        if simulated is not None:
            curves.insert(0, Curve("simulated (MPM)", time, simulated[:, column], TRUTH))
        if baseline is not None:
            level = np.full(len(time), baseline[column])
            curves.insert(0, Curve("training mean", time, level, BASELINE, "--", scaled=False))
        panels.append(Panel(label, curves))
    return panels


def worth_showing(*values: np.ndarray) -> np.ndarray:
    """Which components of forces or torques (T, 3) are not next to none beside the largest, shape (3,)."""
    largest = np.abs(np.concatenate(values)).max(axis=0)
    return largest > NEGLIGIBLE_SHARE * largest.max()


def force_panels(truth: Any, prediction: Any, history: int, mean_force: np.ndarray) -> list[Panel]:
    """Forward, lateral (where there is any worth mentioning) and vertical force; for a wheel also its sinkage.
    Arguments as in `compared`."""
    names, mean = named_forces(prediction.scene, mean_force)
    runs = (truth, prediction, history)

    def read(run: Any) -> np.ndarray:
        return named_forces(run.scene, run.force)[1]

    spread = prediction.force_spread
    # Of a turned wheel's directions, as if the axes' errors had nothing to do with each other.
    if spread is not None:
        spread = np.sqrt(spread**2 @ named_forces(prediction.scene, np.eye(3))[1] ** 2)
    panels = compared([f"{name} [N]" for name in names], read, *runs, mean, spread)
    # A small component is drawn as small as it is beside the largest.
    ranges = [float(np.ptp(curve.values)) for panel in panels for curve in panel.curves if len(curve.values)]
    panels = [replace(panel, least_height=SMALLEST_PANEL * max(ranges, default=0.0)) for panel in panels]
    if not worth_showing(*(read(run) for run in runs[:2] if run is not None))[1]:
        del panels[1]
    if is_wheel(prediction.scene):
        panels += compared(["sinkage [mm]"], lambda run: 1e3 * sinkage(run.scene, run.pose)[:, None], *runs)
    return panels


def torque_panels(truth: Any, prediction: Any, history: int, mean_torque: np.ndarray) -> list[Panel]:
    """Torque about the axes about which there is any worth mentioning. Arguments as in `compared`."""
    names, mean = named_torques(prediction.scene, mean_torque)

    def read(run: Any) -> np.ndarray:
        return named_torques(run.scene, run.torque)[1]

    panels = compared([f"{name} [N m]" for name in names], read, truth, prediction, history, mean)
    shown = worth_showing(*(read(run) for run in (truth, prediction) if run is not None))
    return [panel for panel, worth in zip(panels, shown, strict=True) if worth]


def error_panels(
    errors: PositionErrors, truth: Any, prediction: Any, history: int, mean_force: np.ndarray
) -> list[Panel]:
    """Error of the soil's positions, of the force and, where it was predicted, of the body's place."""
    positions = [
        Curve(label, errors.time, 1e3 * np.sqrt(values), colour, style, scaled)
        for label, values, colour, style, scaled in (
            # A baseline that runs away must not flatten the curves that matter.
            ("constant velocity", errors.constant_velocity, BASELINE, ":", False),
            ("frozen", errors.frozen, BASELINE, "--", True),
            ("PCA alone", errors.reduction, ACCENT, "-", True),
            ("network", errors.total, NETWORK, "-", True),
        )
    ]
    time, force = truth.time[history:], truth.force[history:]
    force_error = [
        Curve("training mean", time, np.linalg.norm(mean_force - force, axis=1), BASELINE, "-."),
        Curve("network", time, np.linalg.norm(prediction.force[history:] - force, axis=1), NETWORK),
    ]
    panels = [
        Panel("position RMSE [mm]", positions, from_zero=True),
        Panel("force error [N]", force_error, from_zero=True),
    ]
    misplaced = 1e3 * np.linalg.norm(prediction.pose[history:, :3] - truth.pose[history:, :3], axis=1)
    if np.any(misplaced):
        curves = [Curve("network", time, misplaced, NETWORK)]
        panels.append(Panel("body misplaced [mm]", curves, from_zero=True))
    return panels


@styled
def history_figure(panels: Sequence[Panel]) -> Figure:
    """Panels above each other, with one legend."""
    figure, axes = charts(len(panels), 1.25 * len(panels) + 0.85)
    lines: dict[str, Line2D] = {}
    for axis, panel in zip(axes, panels, strict=True):
        for curve in panel.curves:
            (line,) = axis.plot(curve.time, curve.values, curve.style, color=curve.colour, label=curve.label)
            lines.setdefault(curve.label, line)
            if curve.band is not None:
                low, high = curve.values - curve.band, curve.values + curve.band
                axis.fill_between(curve.time, low, high, color=curve.colour, alpha=0.25, linewidth=0.0)
        axis.set_ylim(*limits(panel))
        axis.set_ylabel(panel.label, fontsize=9)
    axes[-1].set_xlabel("time [s]")
    figure.align_ylabels(axes)
    first = {"network": 0, "simulated (MPM)": 1}  # the baselines follow
    order = sorted(lines, key=lambda label: first.get(label, 2))
    legend_above(figure, [lines[label] for label in order], ncols=3, columnspacing=1.2, handlelength=1.6)
    return figure


def limits(panel: Panel) -> tuple[float, float]:
    """Range of the vertical axis."""
    drawn = [curve for curve in panel.curves if curve.scaled]
    lines = [curve.values for curve in drawn]
    for curve in drawn:
        lines += [] if curve.band is None else [curve.values - curve.band, curve.values + curve.band]
    scaled = [values[np.isfinite(values)] for values in lines]
    values = np.concatenate([*scaled, [0.0]] if panel.from_zero else scaled)
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
    missing = max(panel.least_height - (high - low), 0.0)
    if high - low + missing <= 0.0:
        missing = 1.0
    room = 0.06 * (high - low + missing)
    if panel.from_zero:
        return 0.0, high + missing + room
    return low - 0.5 * missing - room, high + 0.5 * missing + room


# --- How the position errors are spread over the particles: the paper's "Distribution of … position MSE" -

BINS_PER_DECADE = 4
# An error below a micrometre counts as one [m²]: particles that rest would fill decades with rounding.
SMALLEST = 1e-12


def error_bins(values: Sequence[np.ndarray]) -> np.ndarray:
    """Borders [m²] of bins, equally wide on a logarithmic axis, that hold all of the values."""
    place = BINS_PER_DECADE * np.log10(np.maximum(np.concatenate(values), SMALLEST))
    return 10.0 ** (np.arange(np.floor(place.min()), np.floor(place.max()) + 2.0) / BINS_PER_DECADE)


@styled
def histogram_figure(runs: Sequence[ParticleErrors]) -> Figure:
    """Share of particles by the mean-square error of their position, all runs together; dotted: the medians."""
    reduction, network = (
        np.maximum(np.concatenate(values), SMALLEST)
        for values in ([run.reduction for run in runs], [run.network for run in runs])
    )
    bins = error_bins([reduction, network])
    figure, axes = charts(2, 3.6, share_y=True)
    for axis, label, values, colour in (
        (axes[0], "PCA (reduction)", reduction, ACCENT),
        (axes[1], "network", network, NETWORK),
    ):
        share = np.full(len(values), 100.0 / len(values))
        axis.hist(
            values, bins.tolist(), weights=share, color=colour, alpha=0.85, edgecolor="white", linewidth=0.4
        )
        median = float(np.median(values))
        axis.axvline(median, color="black", linestyle=":", linewidth=1.2)
        axis.set_title(f"{label}: median {median:.1e}, mean {values.mean():.1e} m²", fontsize=9)
        axis.set_ylabel("particles [%]")
        axis.grid(visible=False, axis="x")
    axes[0].set_xscale("log")
    plain_log_numbers(axes[0].xaxis)
    axes[1].set_xlabel("position MSE of a particle [m²]")
    return figure


# --- How a network was trained: loss and skill by step --------------------------------------------------

VALIDATION = {
    "judged/skill": ("position skill", NETWORK),
    "judged/force NRMSE": ("force NRMSE", ACCENT),
    "skill/validation": ("position skill", NETWORK),  # as earlier trainings called them
    "force_nrmse/validation": ("force NRMSE", ACCENT),
}
# Of the losses; what a model predicts decides which there are.
COLOURS = {"total": TRUTH, "force": ACCENT, "torque": BASELINE}
# Skill and NRMSE beyond these say only that a rollout ran away.
LOWEST, HIGHEST = -0.5, 1.5


@styled
def training_figure(log: Mapping[str, np.ndarray]) -> Figure:
    """Training losses above, the rollouts of the validation runs below."""
    figure, (losses, rollouts) = charts(2, 4.4)
    for name in sorted(name for name in log if name.startswith("loss/")):
        label = name.removeprefix("loss/")
        losses.plot(*log[name].T, color=COLOURS.get(label, NETWORK), label=label, linewidth=1.2)
        losses.set_yscale("log")
        round_numbers(losses.yaxis, most=8)
        losses.yaxis.set_minor_formatter(NullFormatter())
    for name, (label, colour) in VALIDATION.items():
        if name in log:
            rollouts.plot(*log[name].T, color=colour, label=label, marker=".")
    values = np.concatenate([[0.0, 1.0], *(log[name][:, 1] for name in VALIDATION if name in log)])
    values = np.clip(values[np.isfinite(values)], LOWEST, HIGHEST)
    rollouts.set_ylim(values.min() - 0.05 * (values.min() < 0.0), values.max() + 0.05)
    for axis, label in ((losses, "loss"), (rollouts, "validation rollouts")):
        axis.set_ylabel(label)
        if axis.lines:
            axis.legend(ncols=2, fontsize=8.5)
    rollouts.set_xlabel("training step")
    return figure
