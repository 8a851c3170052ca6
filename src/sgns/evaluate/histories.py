"""Quantities through time of one run: narrow pictures of panels that share their time axis."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mpm_warp.scenes import sinkage
from sgns.evaluate.figures import ACCENT, BASELINE, NETWORK, PICTURE_WIDTH, TRUTH, new_figure, styled
from sgns.evaluate.metrics import NEGLIGIBLE_SHARE, PositionErrors, forward_force, is_wheel

# A component below this share of the largest is drawn as small as it is, not blown up to fill its panel.
SMALLEST_PANEL = 0.1


@dataclass(frozen=True)
class Curve:
    """A line of a panel.

    Attributes:
        label: for the legend.
        time: [s], shape (t,).
        values: shape (t,).
        colour: of the line.
        style: matplotlib's name of the dashes.
        scaled: whether the panel must be large enough for it.
    """

    label: str
    time: np.ndarray
    values: np.ndarray
    colour: str
    style: str = "-"
    scaled: bool = True


@dataclass(frozen=True)
class Panel:
    """One quantity through time.

    Attributes:
        label: of the vertical axis, with the unit.
        curves: the first is drawn lowest.
        least_height: range that the axis shows at least.
        from_zero: whether the axis begins at zero.
    """

    label: str
    curves: Sequence[Curve]
    least_height: float = 0.0
    from_zero: bool = False


def compared(
    label: str,
    read: Callable[[Any], np.ndarray],
    truth: Any,
    prediction: Any,
    history: int,
    baseline: float | None = None,
) -> Panel:
    """A panel with the truth, the prediction after its history, and perhaps a constant baseline.

    Args:
        label: of the vertical axis.
        read: history (T,) of a `Run`.
        truth: the simulated `Run`; None for a path that was never simulated.
        prediction: the predicted `Run`.
        history: frames that are no predictions.
        baseline: the training runs' mean.
    """
    time = prediction.time
    curves = []
    if baseline is not None:
        level = np.full(len(time), baseline)
        curves.append(Curve("training mean", time, level, BASELINE, "--", scaled=False))
    if truth is not None:
        curves.append(Curve("simulated (MPM)", time, read(truth), TRUTH))
    curves.append(Curve("network", time[history:], read(prediction)[history:], NETWORK))
    return Panel(label, curves)


def force_panels(truth: Any, prediction: Any, history: int, mean_force: np.ndarray) -> list[Panel]:
    """Forward, lateral and vertical force; for a wheel also its sinkage. Arguments as in `compared`."""
    forward, sign = forward_force(prediction.scene)
    panels = [
        compared(
            f"{name} [N]",
            lambda run, axis=axis, sign=sign: sign * run.force[:, axis],
            truth,
            prediction,
            history,
            sign * float(mean_force[axis]),
        )
        for axis, name, sign in ((0, forward, sign), (1, "lateral Fy", 1.0), (2, "vertical Fz", 1.0))
    ]
    panels = alike(panels)
    if is_wheel(prediction.scene):
        panels.append(
            compared(
                "sinkage [mm]", lambda run: 1e3 * sinkage(run.scene, run.pose), truth, prediction, history
            )
        )
    return panels


def torque_panels(truth: Any, prediction: Any, history: int, mean_torque: np.ndarray) -> list[Panel]:
    """Torque about the axes about which there is any worth mentioning. Arguments as in `compared`."""
    turning = np.stack([np.abs(run.torque).max(axis=0) for run in (truth, prediction) if run is not None])
    largest = turning.max(axis=0)
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
    panels = [
        Panel("position RMSE [mm]", positions, from_zero=True),
        Panel(
            "force error [N]",
            [
                Curve("training mean", time, lengths(mean_force - force), BASELINE, "-."),
                Curve("network", time, lengths(prediction.force[history:] - force), NETWORK),
            ],
            from_zero=True,
        ),
    ]
    misplaced = 1e3 * lengths(prediction.pose[history:, :3] - truth.pose[history:, :3])
    if np.any(misplaced):
        panels.append(
            Panel("body misplaced [mm]", [Curve("network", time, misplaced, NETWORK)], from_zero=True)
        )
    return panels


def lengths(vectors: np.ndarray) -> np.ndarray:
    """Lengths (t,) of vectors (t, 3)."""
    return np.linalg.norm(vectors, axis=1)


def alike(panels: Sequence[Panel]) -> list[Panel]:
    """The panels of a vector's components, with a least height from the largest of them."""
    heights = [float(np.ptp(curve.values)) for panel in panels for curve in panel.curves if len(curve.values)]
    return [Panel(p.label, p.curves, SMALLEST_PANEL * max(heights, default=0.0)) for p in panels]


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
    legend(figure, axes)
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


def legend(figure: Figure, axes: Sequence[Axes]) -> None:
    """One legend above the panels, every label once, what is drawn last first."""
    entries = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    order = sorted(entries, key=lambda label: (label != "network", label != "simulated (MPM)"))
    figure.legend(
        [entries[label] for label in order],
        order,
        loc="outside upper center",
        ncols=3,
        fontsize=8.5,
        columnspacing=1.2,
        handlelength=1.6,
    )
