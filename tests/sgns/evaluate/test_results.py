import math
from dataclasses import replace
from types import SimpleNamespace

import pytest

from sgns.evaluate.results import aggregate, seen_before, seen_warning
from sgns_testing.surrogates import made_scores


def test_aggregate_by_hand():
    total = aggregate([made_scores("a", 1e-6, 4e-6, 1.2), made_scores("b", 3e-6, 4e-6, 0.9, math.nan)])
    assert total.frames == 8
    assert total.skill() == pytest.approx(0.5)
    assert total.skill("constant_velocity") == pytest.approx(0.75)
    assert total.rmse_mm("total") == pytest.approx(math.sqrt(2.0))
    assert total.force.mpe[0] == pytest.approx(5.0)  # signed: errors cancel
    assert total.absolute_mpe["draft"] == pytest.approx(15.0)  # unsigned: they do not
    assert math.isnan(total.absolute_mpe["lateral"])
    assert total.solver_rate == 10.0


def test_aggregate_of_one_run_is_that_run():
    one = made_scores("a", 1e-6, 4e-6, 1.2)
    row = aggregate([one], "a").row()
    assert {k: row[k] for k in row} == pytest.approx(one.row(), nan_ok=True)


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


def simulator(fitted_on, validation_runs):
    return SimpleNamespace(
        basis=SimpleNamespace(fitted_on=fitted_on), card={"settings": {"validation_runs": validation_runs}}
    )


@pytest.mark.parametrize(
    ("fitted_on", "validation", "expected"),
    [
        (["a", "b"], ["c"], ([], [])),
        (["a", "x"], ["c"], (["x"], [])),
        (["a"], ["y"], ([], ["y"])),
        (["x"], ["x", "y"], (["x"], ["y"])),  # a training run that also served for validation
        (None, [], ([], [])),
    ],
)
def test_what_was_seen_before(fitted_on, validation, expected):
    assert seen_before(simulator(fitted_on, validation), ["x", "y"]) == expected


def test_checkpoint_that_does_not_tell_its_validation_runs():
    known = SimpleNamespace(basis=SimpleNamespace(fitted_on=["x"]), card={})
    assert seen_before(known, ["x", "y"]) == (["x"], [])


def test_warning_counts_and_names():
    judged = SimpleNamespace(runs=[1, 2, 3], trained_on=["x", "y"], chosen_by=[])
    assert "2 of the 3 evaluated runs" in seen_warning(judged) and "(x, …)" in seen_warning(judged)
    assert seen_warning(SimpleNamespace(runs=[1], trained_on=[], chosen_by=[])) == ""
