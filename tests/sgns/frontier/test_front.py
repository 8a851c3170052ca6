"""The front, and labels that keep apart."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sgns.frontier.figures import (
    place_labels,
    reduction_figure,
    scene_figure,
    through_time_figure,
    training_figure,
)
from sgns.frontier.point import Point, effective_error, front

BANDS = {"force_nrmse": 0.2}


def point(label: str, wall: float, error: float, kind: str = "solver", **more) -> Point:
    return Point("s", "cut", kind, "dx", label, wall_s_per_simulated_s=wall, force_nrmse=error, **more)


POINTS = [
    point("fast", 0.1, 0.5, "surrogate"),
    point("slow and worse", 1.0, 0.6),
    point("good", 2.0, 0.25),
    point("within the band", 3.0, 0.15),
    point("also within, slower", 4.0, 0.01),
    point("not a simulation", 0.01, 0.1, "reduction"),
    point("no error", 0.001, float("nan")),
]


def test_the_front_is_what_nothing_faster_equals() -> None:
    assert [p.label for p in front(POINTS, "force_nrmse", BANDS)] == ["fast", "good", "within the band"]
    assert front(POINTS, "force_nrmse", {})[-1].label == "also within, slower"


def test_no_point_is_better_than_the_reference_is_known() -> None:
    assert [effective_error(p, "force_nrmse", BANDS) for p in POINTS[3:5]] == [0.2, 0.2]
    reference = Point("s", "cut", "solver", "reference", "finest", wall_s_per_simulated_s=400.0)
    assert effective_error(reference, "force_nrmse", BANDS) == 0.2


def test_no_label_covers_another_or_leaves_the_axes() -> None:
    rng = np.random.default_rng(0)
    x, y = 10.0 ** rng.normal(0.5, 0.2, 40), 10.0 ** rng.normal(-0.5, 0.1, 40)
    figure = Figure(figsize=(13, 8), dpi=110)
    FigureCanvasAgg(figure)
    axes = figure.add_subplot(xscale="log", yscale="log")
    axes.plot(x, y, "o")
    axes.set(xlim=(0.001, 1000.0), ylim=(0.05, 3.0))
    figure.canvas.draw()
    boxes = np.array(place_labels(axes, x, y, [f"a label, number {k}" for k in range(40)]))
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


@pytest.mark.parametrize("bands", [{}, BANDS])
def test_figures_are_pictures(bands: dict) -> None:
    assert scene_figure(POINTS, "force_nrmse", bands, "cut").startswith(b"\x89PNG")


def test_figures_of_training_and_of_errors_through_time_are_pictures() -> None:
    quarters = {f"{c}_q{q}": 0.1 * q for c in ("force_nrmse", "position_rmse_mm") for q in (1, 2, 3, 4)}
    trained = [
        point(
            "a", 0.1, 0.4, "surrogate", training_s=30.0, own_force_nrmse=0.5, mean_force_nrmse=0.8, **quarters
        ),
        point("b", 0.1, 0.4, "surrogate", training_s=60.0, own_position_rmse_mm=4.0, **quarters),
    ]
    assert through_time_figure(trained, "t").startswith(b"\x89PNG")
    assert training_figure(trained, "t").startswith(b"\x89PNG")


def test_the_figure_of_reductions_is_a_picture() -> None:
    points = [
        point(
            f"r {r}", 0.1, 0.4, "reduction", modes=float(r), own_position_rmse_mm=9.0 / r, frozen_rmse_mm=12.0
        )
        for r in (1, 2, 4)
    ]
    assert reduction_figure(points, "t").startswith(b"\x89PNG")


def test_labels_are_no_formulas() -> None:
    evil = r"$\frac$ 50 % a_b"
    quarters = {f"{c}_q{q}": 0.1 * q for c in ("force_nrmse", "position_rmse_mm") for q in (1, 2, 3, 4)}
    known = {"own_force_nrmse": 0.5, "own_position_rmse_mm": 3.0, **quarters}
    points = [
        point(evil, time, 0.4, "surrogate", training_s=300.0 * time, modes=10.0 * time, **known)
        for time in (0.1, 0.2)
    ]
    assert scene_figure(points, "force_nrmse", {}, evil).startswith(b"\x89PNG")
    for figure in (through_time_figure, training_figure, reduction_figure):
        assert figure(points, evil).startswith(b"\x89PNG")
