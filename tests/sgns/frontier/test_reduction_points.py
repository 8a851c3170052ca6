"""Points of the reduction on a tiny dataset."""

import math

import pytest
from tiny import make_dataset

from sgns.config import UserError
from sgns.data.run import Run
from sgns.frontier import measure
from sgns.frontier.measure import measure_reduction, reduction_points
from sgns.frontier.study import Study
from sgns.reduction.pca import IncrementalPCA
from sgns.reduction.reduce import fit_runs


def study(folder, *entries):
    scene = {"scene": "x", "dataset": "tiny", "cases": {"a": []}, "reference": {"label": "fine"}}
    scene["reduction"] = [{"axis": "r", "label": e["centring"], **e} for e in entries]
    return Study.from_settings({"name": "tiny", "scenes": {"cut": scene}}, folder)


class NoWorkload:
    def measure(self):
        return [1.0, 1.0]


@pytest.fixture
def measured(tmp_path, monkeypatch):
    make_dataset(tmp_path / "data")
    monkeypatch.setattr(measure, "Workload", NoWorkload)
    monkeypatch.setattr(measure, "training_settings", lambda *_: {"dataset": {"path": tmp_path / "data"}})
    asked = study(
        tmp_path / "out",
        {"centring": "particle_axis", "modes": [1, 2, 4, 500]},
        {"centring": "scalar", "modes": [4]},
    )
    measure_reduction(asked)
    return asked, {point.label: point for point, _ in asked.store.points()}


def test_a_point_for_each_number_of_modes_that_there_is(measured):
    _, points = measured
    assert set(points) == {"particle_axis, r 1", "particle_axis, r 2", "particle_axis, r 4", "scalar, r 4"}
    one, two, four = (points[f"particle_axis, r {r}"] for r in (1, 2, 4))
    assert one.own_position_rmse_mm > two.own_position_rmse_mm > four.own_position_rmse_mm > 0
    assert one.energy < two.energy < four.energy < 1
    assert one.own_runs == 3  # two validation runs and a test run
    assert four.wall_s_per_simulated_s >= four.decoded_wall_s_per_simulated_s > 0
    # With all modes of one centring the energy says what the error says.
    left = (four.own_position_rmse_mm / four.frozen_rmse_mm) ** 2
    assert four.energy == pytest.approx(1 - left, abs=1e-4)


def test_what_is_there_is_not_measured_again(measured, monkeypatch):
    asked, _ = measured
    monkeypatch.setattr(measure, "fit_runs", lambda *_: pytest.fail("fitted again"))
    for name in ("particle_axis, r 500",):  # cannot be had, so it is asked for each time
        assert not asked.store.has("cut", "reduction", name)
    measure_reduction(study(asked.folder, {"centring": "particle_axis", "modes": [1, 2, 4]}))


@pytest.mark.parametrize(
    "entry, line",
    [
        ({"centring": "mean", "modes": [1]}, "centring is 'mean'; allowed: scalar"),
        ({"centring": "scalar", "modes": [0]}, "modes is .0.; it must be a list of whole numbers"),
        ({"centring": "scalar"}, "modes is None"),
    ],
)
def test_bad_entries_are_one_line(tmp_path, entry, line):
    with pytest.raises(UserError, match=line):
        list(reduction_points(study(tmp_path, entry).scenes[0]))


def test_one_stream_is_the_same_as_by_hand(tmp_path):
    paths = make_dataset(tmp_path).runs("train")
    pca = IncrementalPCA(4)
    for path in paths:
        with Run(path) as run:
            pca.partial_fit(run.positions())
    by_hand, streamed = pca.basis("scalar"), fit_runs(paths, 4).basis("scalar")
    assert math.isclose(float(by_hand.residual_mse(4)), float(streamed.residual_mse(4)), rel_tol=1e-6)
