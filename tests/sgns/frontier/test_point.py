"""Rows of the table, and the front."""

import math
from dataclasses import replace
from pathlib import Path

import pytest

from sgns.config import UserError
from sgns.frontier.point import Point, effective_error, front, read_points, write_points


def test_points_come_back_from_a_table_to_five_digits(tmp_path: Path) -> None:
    points = [
        Point("full", "cut", "solver", "dx", 'dx 20, "a"', paper=True, force_nrmse=0.123456789),
        Point("full", "wheel", "surrogate", "r", "r = 8", training_runs=36.0, note="x, y"),
    ]
    write_points(tmp_path / "points.csv", points)
    back = read_points(tmp_path / "points.csv")
    assert [p.label for p in back] == [p.label for p in points]
    assert back[0].paper and not back[1].paper
    assert back[0].force_nrmse == pytest.approx(0.12346) and back[1].note == "x, y"
    assert math.isnan(back[0].training_runs)  # not known


@pytest.mark.parametrize(
    ("content", "line"),
    [
        ("study,scene\nfull,cut\n", "lacks columns"),
        ("study,scene,kind,axis,label\n", "it has no rows"),
        ("study,scene,kind,axis,label\nfull,cut,magic,dx,a\n", "allowed: solver"),
        ("study,scene,kind,axis,label,ratio\nfull,cut,solver,dx,a,fast\n", "ratio is 'fast'"),
        ("study,scene,kind,axis,label,ratio\nfull,cut,solver,dx,a,inf\n", "ratio is 'inf'"),
        (
            "study,scene,kind,axis,label,wall_s_per_simulated_s\nfull,cut,solver,dx,a,0\n",
            "wall_s_per_simulated_s is '0', which is not a float above 0",
        ),
    ],
)
def test_a_file_that_is_no_table_is_refused_in_one_line(tmp_path: Path, content: str, line: str) -> None:
    (tmp_path / "a.csv").write_text(content)
    with pytest.raises(UserError, match=line):
        read_points(tmp_path / "a.csv")


def test_where_the_core_was_shared_processor_time_is_the_cost() -> None:
    alone = Point(
        "s", "cut", "solver", "dx", "a", wall_s_per_simulated_s=1.05, processor_s_per_simulated_s=1.0
    )
    shared = Point(
        "s", "cut", "surrogate", "r", "b", wall_s_per_simulated_s=0.4, processor_s_per_simulated_s=0.1,
        decoded_wall_s_per_simulated_s=0.8,
    )  # fmt: skip
    assert (alone.shared, alone.cost, alone.decoded_cost) == (False, 1.05, 1.05)
    assert (shared.shared, shared.cost) == (True, 0.1) and shared.decoded_cost == pytest.approx(0.2)
    unknown = Point("s", "cut", "solver", "dx", "c", wall_s_per_simulated_s=2.0)
    assert unknown.cost == 2.0


# --- Which points nobody beats --------------------------------------------------------------------------

BANDS = {"force_nrmse": 0.2}


def point(label: str, wall: float, error: float = math.nan, kind: str = "solver") -> Point:
    return Point("s", "cut", kind, "dx", label, wall_s_per_simulated_s=wall, force_nrmse=error)


POINTS = [
    point("fast", 0.1, 0.5, "surrogate"),
    point("slow and worse", 1.0, 0.6),
    point("good", 2.0, 0.25),
    point("within the band", 3.0, 0.15),
    point("also within, slower", 4.0, 0.01),
    point("not a simulation", 0.01, 0.1, "reduction"),
    point("no error", 0.001),
]


def test_the_front_is_what_nothing_faster_equals() -> None:
    assert [p.label for p in front(POINTS, "force_nrmse", BANDS)] == ["fast", "good", "within the band"]
    assert front(POINTS, "force_nrmse", {})[-1].label == "also within, slower"


def test_no_point_is_better_than_the_reference_is_known() -> None:
    assert [effective_error(p, "force_nrmse", BANDS) for p in POINTS[3:5]] == [0.2, 0.2]
    assert effective_error(replace(point("finest", 400.0), axis="reference"), "force_nrmse", BANDS) == 0.2
