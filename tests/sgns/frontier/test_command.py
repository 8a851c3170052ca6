"""Figures of a study, and labels that keep apart."""

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sgns.frontier.command import (
    place_labels,
    reduction_figure,
    scene_figure,
    through_time_figure,
    training_figure,
)
from sgns.frontier.point import Point


def test_no_label_covers_another_or_leaves_the_axes() -> None:
    rng = np.random.default_rng(0)
    x, y = 10.0 ** rng.normal(0.5, 0.2, 40), 10.0 ** rng.normal(-0.5, 0.1, 40)
    figure = Figure(figsize=(13, 8), dpi=110)
    FigureCanvasAgg(figure)
    axes = figure.add_subplot(xscale="log", yscale="log")
    axes.plot(x, y, "o")
    axes.set(xlim=(0.001, 1000.0), ylim=(0.05, 3.0))
    figure.canvas.draw()
    labels = [f"a label, number {k}" for k in range(40)]
    boxes = place_labels(axes, [*zip(x, y, labels, strict=True)])
    assert boxes.shape == (40, 4)
    low, high = boxes[:, None, :2], boxes[:, None, 2:]
    sides = np.minimum(high, boxes[None, :, 2:]) - np.maximum(low, boxes[None, :, :2])
    covered = (sides > 0.0).all(axis=2)
    assert covered.sum() == 40  # only each by itself
    border = axes.get_window_extent()
    assert (boxes[:, 0] > border.x0).all() and (boxes[:, 3] < border.y1).all()
    points = axes.transData.transform(np.column_stack([x, y]))
    inside = (points[:, None] > boxes[None, :, :2]) & (points[:, None] < boxes[None, :, 2:])
    assert not inside.all(axis=2).any()


@pytest.mark.parametrize("label", ["fast", r"$\frac$ 50 % a_b"])  # no formula, whatever it holds
def test_figures_are_pictures(label: str) -> None:
    quarters = {f"{c}_q{q}": 0.1 * q for c in ("force_nrmse", "position_rmse_mm") for q in (1, 2, 3, 4)}
    common = {"force_nrmse": 0.4, "frozen_rmse_mm": 12.0, "mean_force_nrmse": 0.8, **quarters}
    points = [
        Point(
            "s", "cut", kind, "dx", label, wall_s_per_simulated_s=time, training_s=300.0 * time, modes=10.0 * time,
            own_position_rmse_mm=0.3 / time, own_force_nrmse=own, paper=time > 0.1, **common,
        )
        for kind, time, own in (("solver", 2.0, 0.5), ("surrogate", 0.1, 0.5), ("surrogate", 0.2, np.nan))
    ]  # fmt: skip
    points.append(Point("s", "cut", "solver", "reference", label, wall_s_per_simulated_s=400.0))
    for bands in ({}, {"force_nrmse": 0.2}):
        assert scene_figure(points, "force_nrmse", bands, label).startswith(b"\x89PNG")
    for figure in (through_time_figure, training_figure, reduction_figure):
        assert figure(points[:3], label).startswith(b"\x89PNG")
    assert training_figure(points[3:], label).startswith(b"\x89PNG")  # nothing is known
