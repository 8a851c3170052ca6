import numpy as np
import pytest
from pictures import pixels
from synthetic import make_run

from sgns.data.run import Run
from sgns.evaluate.figures import (
    Curve,
    Panel,
    error_panels,
    force_panels,
    history_figure,
    limits,
    torque_panels,
)
from sgns.evaluate.metrics import PositionErrors

HISTORY = 3
MEAN = np.array([-80.0, 0.0, 20.0])
WHEEL = {"blade": None, "kind": "wheel", "diameter": 0.3, "width": 0.1}


@pytest.fixture
def truth(tmp_path):
    with Run(make_run(tmp_path / "truth.h5", frames=20, n=60, seed=1)) as run:
        yield run


@pytest.fixture
def prediction(tmp_path):
    with Run(make_run(tmp_path / "rollout.h5", frames=20, n=60, seed=2, producer="rollout")) as run:
        yield run


def curves(panel):
    return {curve.label: curve for curve in panel.curves}


def errors(scale=1.0, frames=17):
    return PositionErrors(np.arange(frames) / 60.0, *[scale * np.linspace(1e-6, 1e-4, frames)] * 7)


def test_forces_have_their_signs_and_predictions_begin_after_the_history(truth, prediction):
    panels = force_panels(truth, prediction, HISTORY, MEAN)
    assert [panel.label for panel in panels] == ["draft −Fx [N]", "lateral Fy [N]", "vertical Fz [N]"]
    draft = curves(panels[0])
    assert np.array_equal(draft["simulated (MPM)"].values, -truth.force[:, 0])
    assert np.array_equal(draft["network"].values, -prediction.force[HISTORY:, 0])
    assert np.array_equal(draft["network"].time, prediction.time[HISTORY:])
    assert draft["training mean"].values == pytest.approx(80.0)
    pixels(history_figure(panels))


def test_wheel_has_drawbar_pull_and_its_own_sinkage(tmp_path):
    runs = [
        Run(make_run(tmp_path / f"{seed}.h5", frames=20, n=60, seed=seed, scene=WHEEL)) for seed in (1, 2)
    ]
    panels = force_panels(*runs, HISTORY, MEAN)
    assert [panel.label for panel in panels][::3] == ["drawbar pull Fx [N]", "sinkage [mm]"]
    assert np.array_equal(curves(panels[0])["simulated (MPM)"].values, runs[0].force[:, 0])
    depths = curves(panels[3])
    for label, run, frames in (
        ("simulated (MPM)", runs[0], slice(None)),
        ("network", runs[1], slice(HISTORY, None)),
    ):
        assert depths[label].values == pytest.approx(1e3 * (0.15 - run.pose[frames, 2]))
    pixels(history_figure(panels))


def test_path_without_truth(prediction):
    panels = force_panels(None, prediction, 1, MEAN)
    assert "simulated (MPM)" not in curves(panels[0])
    pixels(history_figure(panels))


def test_small_component_is_not_blown_up(truth, prediction):
    draft, lateral, _ = force_panels(truth, prediction, HISTORY, MEAN)
    assert np.ptp(limits(lateral)) > 0.1 * np.ptp(curves(draft)["simulated (MPM)"].values)


def test_torque_about_axes_without_any_is_left_out(truth, prediction):
    assert [panel.label for panel in torque_panels(truth, prediction, HISTORY, np.zeros(3))] == [
        "pitch Ty [N m]"
    ]


def test_no_torque_no_panel(tmp_path):
    still = make_run(tmp_path / "still.h5", frames=8, n=20, scene={"speed": 1e-12, "depth": 0.0})
    with Run(still) as run:
        run.torque  # noqa: B018  (read before it is replaced)
        run._cache["torque", "value"][:] = 0.0
        assert torque_panels(run, run, HISTORY, np.zeros(3)) == []


def test_errors_of_soil_force_and_a_body_that_was_predicted(truth, prediction):
    panels = error_panels(errors(), truth, prediction, HISTORY, MEAN)
    assert [panel.label for panel in panels] == [
        "position RMSE [mm]",
        "force error [N]",
        "body misplaced [mm]",
    ]
    force = curves(panels[1])
    difference = prediction.force[HISTORY:] - truth.force[HISTORY:]
    assert force["network"].values == pytest.approx(np.sqrt((difference**2).sum(axis=1)))
    assert force["training mean"].values[0] == pytest.approx(np.linalg.norm(MEAN - truth.force[HISTORY]))
    assert curves(panels[0])["network"].values[-1] == pytest.approx(10.0)
    pixels(history_figure(panels))


def test_body_on_its_given_path_has_no_error_to_show(truth):
    panels = error_panels(errors(0.0), truth, truth, HISTORY, MEAN)
    assert len(panels) == 2
    pixels(history_figure(panels))


def test_baseline_that_runs_away_does_not_flatten_the_rest():
    time = np.arange(4.0)
    wild = Curve("wild", time, np.array([0.0, 1e3, 1e6, np.inf]), "black", scaled=False)
    calm = Curve("calm", time, np.array([1.0, 2.0, np.nan, 2.0]), "black")
    low, high = limits(Panel("x", [wild, calm], from_zero=True))
    assert low == 0.0 and 2.0 < high < 2.5
    assert limits(Panel("x", [Curve("zero", time, np.zeros(4), "black")])) == pytest.approx((-0.56, 0.56))
