"""Advice from a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from sgns.advise import TABLE, advice, bands, main, named, shipped, wished
from sgns.config import UserError
from sgns.frontier.point import Point, read_points, write_points
from sgns_testing.commands import composed

POINTS = [
    Point("full", "cut", "solver", "reference", "finest", wall_s_per_simulated_s=400.0, ratio=90.0),
    Point("full", "cut", "solver", "dx", "coarse", settings="scene=quick_excavation", wall_s_per_simulated_s=3.0,
          ratio=0.6, force_nrmse=0.22, position_rmse_mm=3.5),
    Point("full", "cut", "solver", "dx", "fine", settings="scene=quick_excavation scene.bed.spacing=0.01",
          wall_s_per_simulated_s=60.0, ratio=12.0, force_nrmse=0.1, position_rmse_mm=2.0),
    Point("full", "cut", "surrogate", "r", "r = 8", settings="dataset=quick", wall_s_per_simulated_s=0.02,
          decoded_wall_s_per_simulated_s=0.2, ratio=0.004, force_nrmse=0.35, position_rmse_mm=5.0,
          own_force_nrmse=0.26),
]  # fmt: skip


def asked(*overrides: str) -> dict:
    return OmegaConf.to_container(composed(*overrides, command="advise"))


def answer(*overrides: str, more: Sequence[Point] = ()) -> list[str]:
    points = [*POINTS, *more]
    return advice(points, wished(asked(*overrides), points))


def test_the_fastest_that_is_good_enough_is_named_with_its_command() -> None:
    lines = answer("error.force=0.25")
    assert lines[0] == 'use: solver, called "coarse" in the study'
    assert "sgns simulate scene=quick_excavation output=run.h5" in lines[1]
    assert "study full" in lines[-3] and "the solver at finest" in lines[-3]
    assert "task=cut in these beds and soils only" in lines[-2] and "depend on the grid" in lines[-1]
    surrogate = answer("error.force=0.4")
    assert surrogate[0] == 'use: network, called "r = 8" in the study'
    assert any("its training runs: force NRMSE 0.26" in line for line in surrogate)
    assert answer("error.position=0.004")[0] == 'use: solver, called "coarse" in the study'  # in metres


def test_time_is_that_of_a_step() -> None:
    assert (
        answer("error.force=0.4", "time=0.001")[0] == 'use: network, called "r = 8" in the study'
    )  # 0.02 / 60 s
    assert (
        answer("time=0.1")[0] == 'use: solver, called "coarse" in the study'
    )  # the smallest error within the time
    closest = answer("error.force=0.25", "time=0.001")
    assert closest[0].startswith("nothing meets this; closest: network")
    decoded = answer("error.force=0.4", "time=0.001", "particles=true")
    assert decoded[0].startswith("nothing meets this")


def test_a_step_is_what_a_control_loop_calls() -> None:
    unknown = answer("error.force=0.4")
    assert "along a known path (sgns rollout)" in unknown[3] and "up to 3000 steps a second" in unknown[3]
    assert "with Simulator.step, pose by pose, takes longer" in unknown[4]
    known = replace(
        POINTS[3], label="known", stepped_wall_s_per_simulated_s=0.06, wall_s_per_simulated_s=0.01
    )
    points = [*POINTS[:3], known]

    def told(*overrides: str) -> list[str]:
        return advice(points, wished(asked(*overrides), points))

    lines = told("error.force=0.4", "time=0.002")
    assert (
        lines[0] == 'use: network, called "known" in the study'
        and "costs 1 ms per step of 1/60 s with Simulator.step" in lines[3]
    )
    assert not any("takes longer" in line for line in lines)
    # A whole path at once would be quick enough, 0.17 ms a step.
    assert told("error.force=0.4", "time=0.0005")[0].startswith("nothing meets this; closest: network")
    decoded = told("error.force=0.4", "particles=true")[3]
    assert f"costs {1e3 * (0.06 + 0.19) / 60:.3g} ms" in decoded and "all particles decoded" in decoded


@pytest.mark.parametrize(
    "change",
    [
        {"label": "lucky", "force_nrmse": 0.2, "own_force_nrmse": 0.5},  # nearer than to what it learned from
        {"label": "9 runs", "force_nrmse": 0.3, "note": "trained on 9 runs"},  # no command makes it
    ],
)
def test_some_surrogates_are_not_named(change: dict) -> None:
    other = replace(POINTS[3], wall_s_per_simulated_s=0.01, **change)
    for wish in ("error.force=0.4", "time=0.001"):
        assert answer(wish, more=[other])[0] == 'use: network, called "r = 8" in the study'


def test_nothing_claims_to_be_better_than_the_reference_is_known() -> None:
    lines = answer("error.force=0.1")
    assert lines[0].startswith('nothing meets this; closest: solver, called "fine"')
    assert any("only known to 0.2" in line for line in lines)
    assert any("within the reference's own error" in line for line in lines)


def test_surrogates_can_be_judged_against_their_training_runs() -> None:
    lines = answer("error.force=0.3", "against=training")
    assert lines[0] == 'use: network, called "r = 8" in the study' and "over its test runs" in lines[-3]


@pytest.mark.parametrize(
    ("overrides", "line"),
    [
        ([], "nothing is asked for"),
        (["task=moon", "time=1"], "task is 'moon'; the table has cut"),
        (["error.sinkage=0.001"], "has all the numbers asked for"),
    ],
)
def test_bad_input_gives_one_line(overrides: list[str], line: str) -> None:
    with pytest.raises(UserError, match=line):
        answer(*overrides)


def test_an_error_that_a_task_does_not_have_is_told_with_the_task_that_has_it() -> None:
    wheel = replace(POINTS[1], scene="wheel", sinkage_error_mm=2.0)
    line = r"it has error\.force, error\.position; error\.sinkage is known of task=wheel$"
    with pytest.raises(UserError, match=line):
        answer("error.sinkage=0.002", more=[wheel])
    with pytest.raises(UserError, match=r"error\.sinkage is known of no task$"):
        answer("error.sinkage=0.002")


def test_an_error_that_was_likely_meant_in_millimetres_is_told() -> None:
    with pytest.raises(
        UserError, match=r"error\.position is 4 m, .* for 4 mm give error\.position=0\.004; if any"
    ):
        answer("error.position=4")
    assert answer("error.position=0.01")[0].startswith("use: ")


def test_how_long_a_training_took_does_not_look_like_its_name() -> None:
    point = replace(POINTS[3], label="default, 10 s", training_s=15.0)
    assert named(point) == 'network, called "default, 10 s" in the study; its training took 15 s'


def test_the_command_reads_a_table_of_one_s_own(tmp_path: Path) -> None:
    write_points(tmp_path / "points.csv", POINTS)
    cfg = OmegaConf.create(asked("error.force=0.25", f"table='{tmp_path / 'points.csv'}'"))
    assert main(cfg) == pytest.approx(3.0 / 60)


def test_the_table_that_ships_is_the_committed_study_and_answers() -> None:
    committed = Path(__file__).parents[2] / "experiments" / "accuracy_vs_time" / "full" / "points.csv"
    assert TABLE.read_bytes() == committed.read_bytes()
    points = read_points(TABLE)
    assert {p.kind for p in points} >= {"solver", "surrogate"}
    references = [p for p in points if p.axis == "reference"]
    assert len(references) == len({p.scene for p in points})
    assert not any("/" in p.command for p in points)  # no folder of the machine that made it
    assert advice(points, wished(asked("error.force=0.6", "time=0.01"), points))[0].startswith("use: ")


@pytest.mark.parametrize("study", ["../train", "x" * 300, "a/b", "$"])
def test_tables_of_studies_that_do_not_ship(study: str) -> None:
    assert shipped(study, "cut") == {}


def test_a_table_names_no_file_to_be_read(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("scenes: {cut: {bands: {force_nrmse: 0.5}}}")
    assert bands("full", "cut")
    assert bands(str(tmp_path / "mine"), "cut") == {}
