import csv
import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from sgns.evaluate.metrics import PositionErrors
from sgns.evaluate.results import (
    Evaluation,
    aggregate,
    example_row,
    run_scores,
    seen_before,
    typical_and_worst,
    write_csv,
    write_json,
)
from sgns_testing.surrogates import made_scores


def test_typical_and_worst_by_position_and_force():
    def chosen(*pairs):
        runs = [
            SimpleNamespace(main_errors=pair, scores=None, name=str(number))
            for number, pair in enumerate(pairs)
        ]
        evaluation = Evaluation(*[None] * 2, runs, *[None] * 8)
        return [run.name for run in typical_and_worst(evaluation)]

    # By position alone the typical run would be the first, and the worst the last.
    pairs = (3.0, 0.9), (2.0, 0.3), (3.5, 0.3), (2.9, 0.25), (4.0, 0.3)
    assert chosen(*pairs) == ["2", "0"]
    nothing = math.nan
    assert chosen((1.0, nothing), (3.0, nothing), (2.0, nothing)) == ["2", "1"]
    assert chosen((1.0, 0.5), (2.0, nothing), (1.1, 0.4)) == ["2", "1"]
    assert chosen((0.0, 0.0), (0.0, 0.0)) == ["0", "0"]
    assert chosen((math.inf, 0.3), (2.0, 0.2), (2.1, 0.3))[1] == "0"


def test_force_in_contact_leaves_rest_out():
    force = np.zeros((8, 3))
    force[4:, 0] = [-90.0, -110.0, -90.0, -110.0]
    guess = SimpleNamespace(force=np.full((8, 3), [-80.0, 0.0, 0.0]), force_spread=None)
    time = np.arange(8) / 60.0
    truth = SimpleNamespace(time=time, force=force, torque=force, wall_time_s=None)
    guess.torque = guess.force
    errors = PositionErrors(time[2:], *[np.full(6, 1e-6)] * 7)
    row = run_scores("a", errors, truth, guess, 2, guess.force[0], np.zeros(3)).row()
    rms = math.sqrt(90.0**2 + 110.0**2)
    assert row["contact_force_nrmse"] == pytest.approx(math.sqrt(10.0**2 + 30.0**2) / rms)
    assert row["contact_mean_force_nrmse"] == pytest.approx(math.sqrt(2.0) * 10.0 / rms)
    assert row["force_nrmse"] == pytest.approx(0.605, abs=1e-3)  # at rest there was no force
    assert math.isnan(row["force_coverage"])
    guess.force_spread = np.full((8, 3), 15.0)  # of x two of six frames, of y and z all
    row = run_scores("a", errors, truth, guess, 2, guess.force[0], np.zeros(3)).row()
    assert row["force_coverage"] == pytest.approx(14 / 18)
    still = SimpleNamespace(time=time, force=0.0 * force, torque=force, wall_time_s=None)
    assert math.isnan(
        run_scores("a", errors, still, guess, 2, guess.force[0], np.zeros(3)).row()["contact_force_nrmse"]
    )


def test_aggregate_by_hand(tmp_path):
    scores = [made_scores("a, with comma", 1e-6, 4e-6, 1.2), made_scores("b", 3e-6, 4e-6, 0.9, math.nan)]
    total = aggregate(scores)
    assert total.frames == 8
    assert total.skill() == pytest.approx(0.5)
    assert total.skill("constant_velocity") == pytest.approx(0.75)
    assert total.rmse_mm("total") == pytest.approx(math.sqrt(2.0))
    assert total.force.mpe[0] == pytest.approx(5.0)  # signed: errors cancel
    assert total.force.absolute_mpe[[0, 2]] == pytest.approx(15.0)  # unsigned: they do not
    assert math.isnan(total.force.absolute_mpe[1])
    assert total.solver_rate == 10.0

    write_csv(tmp_path / "metrics.csv", [score.row() for score in (*scores, total)])
    with (tmp_path / "metrics.csv").open(newline="", encoding="utf-8") as file:
        read = list(csv.DictReader(file))
    assert [row["run"] for row in read] == ["a, with comma", "b", "all runs"]
    assert float(read[0]["skill_frozen"]) == pytest.approx(0.75)
    assert read[0]["lateral_nrmse"] == ""
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.csv"]

    row, together = example_row(scores[1]), example_row(total)
    assert row["mse_total_m2"] == 3e-6 and row["mse_frozen_m2"] == 4e-6
    assert row["draft_mpe_percent"] == pytest.approx(-10.0)
    assert row["draft_abs_mpe_percent"] == pytest.approx(10.0)
    assert row["nrmse"] == pytest.approx(0.1)
    assert math.isnan(row["lateral_mpe_percent"])
    assert together["draft_mpe_percent"] == pytest.approx(5.0)
    assert together["draft_abs_mpe_percent"] == pytest.approx(15.0)
    assert list(together) == list(row)


def test_aggregate_of_one_run_is_that_run():
    one = made_scores("a", 1e-6, 4e-6, 1.2)
    assert aggregate([one], "a").row() == pytest.approx(one.row(), nan_ok=True)


def test_json_is_strict(tmp_path):
    content = {"x": math.nan, "y": [np.float64(1.5), np.inf], "z": np.arange(2), "n": np.int64(3)}
    write_json(tmp_path / "a.json", content)
    assert json.loads((tmp_path / "a.json").read_text()) == {"x": None, "y": [1.5, None], "z": [0, 1], "n": 3}


def test_sinkage_is_the_mean_of_the_wheels_only():
    blade = made_scores("blade", 1e-6, 4e-6)
    wheels = [
        replace(blade, name=name, body_mse=mse, sinkage_mae=mae)
        for name, mse, mae in (("a", 4e-6, 1e-3), ("b", 0.0, 3e-3))
    ]
    total = aggregate([blade, *wheels])
    assert total.sinkage_mae == pytest.approx(2e-3)
    assert total.row()["sinkage_mae_mm"] == pytest.approx(2.0)
    assert total.row()["body_rmse_mm"] == pytest.approx(1e3 * math.sqrt(4e-6 / 3))
    assert blade.row()["body_rmse_mm"] == 0.0 and math.isnan(blade.row()["sinkage_mae_mm"])


@pytest.mark.parametrize(
    ("fitted_on", "settings", "expected"),
    [
        (["a", "b"], {"validation_runs": ["c"]}, ([], [])),
        (["a", "x"], {"validation_runs": ["c"]}, (["x"], [])),
        (["a"], {"validation_runs": ["y"]}, ([], ["y"])),
        (["x"], {"validation_runs": ["x", "y"]}, (["x"], ["y"])),  # a training run that also validated
        (None, {"validation_runs": []}, ([], [])),
        (["x"], {}, (["x"], [])),
    ],
)
def test_what_was_seen_before(fitted_on, settings, expected):
    simulator = SimpleNamespace(basis=SimpleNamespace(fitted_on=fitted_on), card={"settings": settings})
    assert seen_before(simulator, ["x", "y"]) == expected
