"""Pictures of runs, of errors and of a training, for reports and experiments."""

from __future__ import annotations

import io
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogFormatter, LogLocator, MaxNLocator, NullFormatter
from mpl_toolkits.mplot3d import Axes3D
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from mpm_warp.inputs import open_file
from mpm_warp.scenes import sinkage
from sgns.config import UserError
from sgns.data.run import Run, frame_chunks
from sgns.evaluate.metrics import (
    NEGLIGIBLE_SHARE,
    ParticleErrors,
    PositionErrors,
    SurfaceGrid,
    forward_force,
    height_map,
    is_wheel,
)
from sgns.reduction.basis import Basis

# --- Pictures of runs and of errors, for reports and experiments ----------------------------------------
# Every function returns a matplotlib figure that no window owns; `png` turns one into bytes. Colours mean the
# same everywhere: truth black, network blue, baselines grey.

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
styled = matplotlib.rc_context(STYLE)
"""Draws in the project's style and leaves matplotlib's settings as they were."""


def new_figure(width: float, height: float, layout: str = "constrained", dpi: int = DPI) -> Figure:
    """An empty figure of a size in inches, drawn without a display."""
    figure = Figure(figsize=(width, height), dpi=dpi, layout=layout)
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
    """Height of the surface along the middle of the bed, a panel for each of some frames.

    The two rows of columns next to mid-width are averaged.
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
    """What r = 1 … R modes do not hold of the training data's variance: of the paper's cumulative energy, and of the
    share of the variance about each particle's mean place, shape (R,) each.
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

    `test` is the reduction MSE of the evaluated runs for r = 0 … R [m²], shape (R + 1,), `training` that of the
    training runs for r = 1 … R, shape (R,); the network's own error is drawn as a line for comparison.
    """
    figure = new_figure(PICTURE_WIDTH, 3.4)
    axis = figure.subplots()
    last = len(test) - 1
    shown = sorted({min(2**k, last) for k in range(int(math.log2(max(last, 1))) + 2)})
    if training is not None:
        fitted = [1e3 * math.sqrt(max(training[r - 1], 0.0)) for r in shown]
        axis.loglog(shown, fitted, color=BASELINE, linestyle="--", marker=".", label="training runs")
    axis.loglog(
        shown, [1e3 * math.sqrt(test[r]) for r in shown], color=ACCENT, marker="o", markersize=4, label=label
    )
    if network_rmse_mm is not None and math.isfinite(network_rmse_mm) and network_rmse_mm > 0.0:
        axis.axhline(network_rmse_mm, color=NETWORK, label="rollout of the network")
    log_modes(axis, last, num_modes)
    round_numbers(axis.yaxis)
    axis.set_ylabel("reconstruction RMSE [mm]")
    axis.legend(loc="lower left")
    return figure


def plain_log_numbers(axis: Axis) -> None:
    """Numbers along a logarithmic axis without the formulas that matplotlib would write."""
    axis.set_major_formatter(LogFormatter())
    axis.set_minor_formatter(LogFormatter())


def round_numbers(axis: Axis, most: int | None = None) -> None:
    """0.2 in place of 2 × 10⁻¹, at 1, 2 and 5 of every decade."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=most))
    axis.set_major_formatter(lambda value, _: f"{value:g}")


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


@dataclass(frozen=True)
class Panel:
    """One quantity through time."""

    label: str  # of the vertical axis, with the unit
    curves: Sequence[Curve]  # the first is drawn lowest
    least_height: float = 0.0  # range that the axis shows at least
    from_zero: bool = False  # whether the axis begins at zero


def compared(
    label: str,
    read: Callable[[Any], np.ndarray],
    truth: Any,
    prediction: Any,
    history: int,
    baseline: float | None = None,
) -> Panel:
    """A panel with the truth (None for a path that was never simulated), the prediction after its history, and
    perhaps a constant baseline, the training runs' mean; `read` takes the values (T,) from a `Run`.
    """
    time = prediction.time
    curves = [Curve("network", time[history:], read(prediction)[history:], NETWORK)]
    if truth is not None:
        curves.insert(0, Curve("simulated (MPM)", time, read(truth), TRUTH))
    if baseline is not None:
        level = np.full(len(time), baseline)
        curves.insert(0, Curve("training mean", time, level, BASELINE, "--", scaled=False))
    return Panel(label, curves)


def force_panels(truth: Any, prediction: Any, history: int, mean_force: np.ndarray) -> list[Panel]:
    """Forward, lateral and vertical force; for a wheel also its sinkage. Arguments as in `compared`."""
    forward, sign = forward_force(prediction.scene)
    runs = (truth, prediction, history)
    panels = [
        compared(f"{name} [N]", lambda run, i=i, s=s: s * run.force[:, i], *runs, s * float(mean_force[i]))
        for i, name, s in ((0, forward, sign), (1, "lateral Fy", 1.0), (2, "vertical Fz", 1.0))
    ]
    # A small component is drawn as small as it is beside the largest.
    ranges = [float(np.ptp(curve.values)) for panel in panels for curve in panel.curves if len(curve.values)]
    panels = [replace(panel, least_height=SMALLEST_PANEL * max(ranges, default=0.0)) for panel in panels]
    if is_wheel(prediction.scene):
        panels.append(compared("sinkage [mm]", lambda run: 1e3 * sinkage(run.scene, run.pose), *runs))
    return panels


def torque_panels(truth: Any, prediction: Any, history: int, mean_torque: np.ndarray) -> list[Panel]:
    """Torque about the axes about which there is any worth mentioning. Arguments as in `compared`."""
    runs = [run for run in (truth, prediction) if run is not None]
    largest = np.max([np.abs(run.torque).max(axis=0) for run in runs], axis=0)
    return [
        compared(
            f"{name} [N m]",
            lambda run, axis=axis: run.torque[:, axis],
            truth,
            prediction,
            history,
            float(mean_torque[axis]),
        )
        for axis, name in enumerate(("roll Tx", "pitch Ty", "yaw Tz"))
        if largest[axis] > NEGLIGIBLE_SHARE * largest.max()
    ]


def error_panels(
    errors: PositionErrors, truth: Any, prediction: Any, history: int, mean_force: np.ndarray
) -> list[Panel]:
    """Error of the soil's positions, of the force and, where it was predicted, of the body's place."""
    positions = [
        Curve(label, errors.time, 1e3 * np.sqrt(getattr(errors, key)), colour, style, scaled)
        for key, label, colour, style, scaled in (
            # A baseline that runs away must not flatten the curves that matter.
            ("constant_velocity", "constant velocity", BASELINE, ":", False),
            ("frozen", "frozen", BASELINE, "--", True),
            ("reduction", "PCA alone", ACCENT, "-", True),
            ("total", "network", NETWORK, "-", True),
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
    figure = new_figure(PICTURE_WIDTH, 1.25 * len(panels) + 0.85)
    axes = figure.subplots(len(panels), 1, squeeze=False, sharex=True)[:, 0]
    for axis, panel in zip(axes, panels, strict=True):
        for curve in panel.curves:
            axis.plot(curve.time, curve.values, color=curve.colour, linestyle=curve.style, label=curve.label)
        axis.set_ylim(*limits(panel))
        axis.set_ylabel(panel.label, fontsize=9)
        axis.grid(alpha=0.25, linewidth=0.6)
    axes[-1].set_xlabel("time [s]")
    figure.align_ylabels(axes)
    # One legend, every label once, what is drawn last first.
    entries = {
        label: handle
        for axis in axes[::-1]
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    order = [label for label in ("network", "simulated (MPM)") if label in entries]
    others = dict.fromkeys(curve.label for panel in panels for curve in panel.curves)
    order += [label for label in others if label not in order]
    figure.legend(
        [entries[label] for label in order],
        order,
        loc="outside upper center",
        ncols=3,
        fontsize=8.5,
        columnspacing=1.2,
        handlelength=1.6,
    )
    return figure


def limits(panel: Panel) -> tuple[float, float]:
    """Range of the vertical axis."""
    scaled = [curve.values[np.isfinite(curve.values)] for curve in panel.curves if curve.scaled]
    values = np.concatenate([*scaled, [0.0]] if panel.from_zero else scaled)
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
    missing = max(panel.least_height - (high - low), 0.0)
    if high - low + missing <= 0.0:
        missing = 1.0
    room = 0.06 * (high - low + missing)
    if panel.from_zero:
        return 0.0, high + missing + room
    return low - 0.5 * missing - room, high + 0.5 * missing + room


# --- How the position errors are spread over the particles ---------------------------------------
# The paper's Fig. "Distribution of … position MSE".

BINS_PER_DECADE = 4
# An error below a micrometre counts as one [m²]: particles that rest would fill decades with rounding.
SMALLEST = 1e-12


def error_bins(values: Sequence[np.ndarray]) -> np.ndarray:
    """Borders [m²] of bins, equally wide on a logarithmic axis, that hold all of the values."""
    everything = np.concatenate([np.maximum(v, SMALLEST) for v in values])
    low = np.floor(BINS_PER_DECADE * np.log10(everything.min())) / BINS_PER_DECADE
    high = np.floor(BINS_PER_DECADE * np.log10(everything.max()) + 1.0) / BINS_PER_DECADE
    return 10.0 ** np.linspace(low, high, round((high - low) * BINS_PER_DECADE) + 1)


@styled
def histogram_figure(runs: Sequence[ParticleErrors]) -> Figure:
    """Share of particles by the mean-square error of their position, all runs together; dotted: the medians."""
    spread = {
        "PCA (reduction)": (np.concatenate([run.reduction for run in runs]), ACCENT),
        "network": (np.concatenate([run.network for run in runs]), NETWORK),
    }
    bins = error_bins([values for values, _ in spread.values()])
    figure = new_figure(PICTURE_WIDTH, 3.6)
    axes = figure.subplots(2, 1, sharex=True, sharey=True)
    for axis, (label, (values, colour)) in zip(axes, spread.items(), strict=True):
        values = np.maximum(values, SMALLEST)
        share = np.full(len(values), 100.0 / len(values))
        axis.hist(values, bins, weights=share, color=colour, alpha=0.85, edgecolor="white", linewidth=0.4)
        median = float(np.median(values))
        axis.axvline(median, color="black", linestyle=":", linewidth=1.2)
        axis.set_title(f"{label}: median {median:.1e}, mean {values.mean():.1e} m²", fontsize=9)
        axis.set_ylabel("particles [%]")
        axis.grid(alpha=0.25, linewidth=0.6, axis="y")
    axes[0].set_xscale("log")
    plain_log_numbers(axes[0].xaxis)
    axes[1].set_xlabel("position MSE of a particle [m²]")
    return figure


# --- How a network was trained: loss and skill by step, from the log beside its checkpoint --------------

VALIDATION = {
    "skill/validation": ("position skill", NETWORK),
    "force_nrmse/validation": ("force NRMSE", ACCENT),
}
# Of the losses; what a model predicts decides which there are.
COLOURS = {"total": TRUTH, "force": ACCENT, "torque": BASELINE}
# Skill and NRMSE beyond these say only that a rollout ran away.
LOWEST, HIGHEST = -0.5, 1.5
MOST_BYTES = 1 << 26  # of a log, all files together; a day of training writes a tenth of that


def read_log(folder: Path) -> dict[str, np.ndarray]:
    """Scalars of a TensorBoard folder: name → steps and values, shape (k, 2); empty if there is no log.

    Raises:
        UserError: It holds what is no log.
    """
    if not folder.is_dir():
        return {}
    advice = "remove it: only a figure of the report needs it"
    left = MOST_BYTES
    for file in sorted(folder.iterdir()):
        if "tfevents" in file.name:  # what TensorBoard would read
            try:
                with open_file(file, left) as content:
                    left -= os.fstat(content.fileno()).st_size
            except (OSError, ValueError) as error:
                raise UserError(f"{file} is no log of TensorBoard ({error}); {advice}") from error
    try:
        events = EventAccumulator(str(folder), size_guidance={"scalars": 0}).Reload()
    except Exception as error:  # whatever bytes do to a reader that is not ours
        reason = " ".join(str(error).split()) or type(error).__name__
        raise UserError(f"{folder} holds no log of TensorBoard ({reason:.200}); {advice}") from error
    # A training that was killed logs some steps again, and its files are out of order if the clock went back.
    return {
        name: np.array(sorted({e.step: e.value for e in events.Scalars(name)}.items()), dtype=np.float64)
        for name in events.Tags()["scalars"]
        if name.startswith("loss/") or name in VALIDATION
    }


@styled
def training_figure(log: Mapping[str, np.ndarray]) -> Figure:
    """Training losses above, the rollouts of the validation runs below."""
    figure = new_figure(PICTURE_WIDTH, 4.4)
    losses, rollouts = figure.subplots(2, 1, sharex=True)
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
        axis.grid(alpha=0.25, linewidth=0.6)
        if axis.lines:
            axis.legend(ncols=2, fontsize=8.5)
    rollouts.set_xlabel("training step")
    return figure


# --- What the network itself steps: the r modes as points in space, with the points of the body ---------
# Letters: T frames, r modes, M body points.

# The longest force arrow is this share of the picture's longest side long.
ARROW_SHARE = 0.3


def latent_path(run: Run, basis: Basis) -> np.ndarray:
    """The modes of a run at every frame [m], shape (T, r, 3)."""
    parts = [
        basis.transform(torch.from_numpy(run.positions(frames)))
        for frames in frame_chunks(run.particle_count, run.frame_count)
    ]
    return torch.cat(parts).numpy()


@styled
def subspace_view(truth: Run, prediction: Run, paths: tuple[np.ndarray, np.ndarray], frame: int) -> Figure:
    """Modes, body points and force at one frame, with the way that the modes have come.

    `paths` are the `latent_path` of the two runs [m], shape (T, r, 3) each.
    """
    figure = new_figure(PICTURE_WIDTH, 4.3)
    axis = figure.add_subplot(projection="3d")
    body = prediction.body_points[frame]
    everything = np.concatenate(
        [*(path.reshape(-1, 3) for path in paths), prediction.body_points.reshape(-1, 3)]
    )
    low, high = everything.min(axis=0), everything.max(axis=0)
    width = float((high - low).max())
    for path, colour, filled in ((paths[0], TRUTH, "none"), (paths[1], NETWORK, NETWORK)):
        for mode in range(path.shape[1]):
            axis.plot(*path[: frame + 1, mode].T, color=colour, linewidth=0.8, alpha=0.6)
        axis.scatter(
            *path[frame].T, s=34, facecolors=filled, edgecolors=colour, linewidths=1.2, depthshade=False
        )
    axis.scatter(*body.T, s=6, color=BASELINE, marker="s", depthshade=False)
    for mode, place in enumerate(paths[0][frame], start=1):
        axis.text(place[0], place[1], place[2] + 0.03 * width, str(mode), fontsize=8)
    strongest = max(float(np.linalg.norm(run.force, axis=1).max()) for run in (truth, prediction))
    if strongest > 0.0:
        for run, colour in ((truth, TRUTH), (prediction, NETWORK)):
            arrow = ARROW_SHARE * width / strongest * run.force[frame]
            axis.quiver(*body.mean(axis=0), *arrow, color=colour, linewidth=1.4)
    decorate(axis, low, high)
    axis.set_title(f"t = {prediction.time[frame]:.2f} s")
    marks = [
        Line2D(
            [], [], color=TRUTH, marker="o", markerfacecolor="none", linewidth=0.8, label="simulated (MPM)"
        ),
        Line2D([], [], color=NETWORK, marker="o", linewidth=0.8, label="network"),
        Line2D([], [], color=BASELINE, marker="s", markersize=3, linewidth=0.0, label="body"),
    ]
    figure.legend(handles=marks, loc="outside upper center", ncols=3, fontsize=8.5)
    return figure


def decorate(axis: Axes3D, low: np.ndarray, high: np.ndarray) -> None:
    """Room around what is drawn [m], and few ticks, so that their numbers stay apart.

    Modes are no places: a short side is stretched, so that what lies close together can be told apart.
    """
    room = 0.05 * float((high - low).max())
    low, high = low - room, high + room
    for name, start, end in zip("xyz", low, high, strict=True):
        getattr(axis, f"set_{name}lim")(start, end)
        getattr(axis, f"set_{name}label")(f"{name} [m]", fontsize=9, labelpad=-1.0)
    axis.set_box_aspect(np.maximum(high - low, 0.6 * float((high - low).max())), zoom=0.95)
    for part in (axis.xaxis, axis.yaxis, axis.zaxis):
        part.set_major_locator(MaxNLocator(4))
    axis.tick_params(labelsize=8, pad=0)
    axis.view_init(elev=18, azim=-65)
