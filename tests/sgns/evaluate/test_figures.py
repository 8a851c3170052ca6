"""Figures of the report."""

import math
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
from tensorboard.summary.writer.record_writer import masked_crc32c
from torch.utils.tensorboard import SummaryWriter

from sgns.config import UserError
from sgns.data.run import Run
from sgns.data.surface import particle_spacing, surface_grid
from sgns.evaluate import figures
from sgns.evaluate.command import read_log
from sgns.evaluate.figures import (
    HIGHEST,
    LOWEST,
    SMALLEST,
    Curve,
    Panel,
    error_bins,
    error_panels,
    force_panels,
    histogram_figure,
    history_figure,
    limits,
    torque_panels,
    training_figure,
)
from sgns.evaluate.metrics import ParticleErrors, PositionErrors
from sgns_testing.pictures import pixels
from sgns_testing.runs import make_run

HISTORY = 3
MEAN = np.array([-80.0, 0.0, 20.0])
WHEEL = {"blade": None, "kind": "wheel", "diameter": 0.3, "width": 0.1}


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    with Run(make_run(tmp_path_factory.mktemp("truth") / "a.h5", frames=20, n=60, seed=1)) as run:
        yield run


@pytest.fixture(scope="module")
def prediction(tmp_path_factory):
    path = tmp_path_factory.mktemp("rollout") / "a.h5"
    with Run(make_run(path, frames=20, n=60, seed=2, producer="rollout")) as run:
        yield run


# --- Surface, reduction, errors by particle, training ---------------------------------------------------


def test_profile(truth, prediction):
    grid = surface_grid(truth.positions(slice(0, 1))[0])
    figure = figures.profile_figure({"simulated (MPM)": truth, "network": prediction}, [4, 9, 14], grid)
    assert [len(axis.lines) for axis in figure.axes] == [3, 3, 3]
    # As of `Run.surface`: half a particle spacing above the highest particle.
    rest = figures.middle_line(truth, 0, grid) + 500.0 * particle_spacing(truth.positions(0)[0])
    np.testing.assert_allclose(figure.axes[0].lines[2].get_ydata(), rest)
    pixels(figure)


@pytest.mark.parametrize("modes", [1, 2, 7, 64])
def test_reduction_curves(modes):
    energy = 1.0 - 0.5 ** np.arange(1, modes + 1)
    pixels(figures.energy_figure(energy, energy - 0.1, min(modes, 4)))
    residual = 1e-5 * 0.5 ** np.arange(modes + 1)
    pixels(figures.reconstruction_figure(residual, residual[1:], min(modes, 4), 2.0))


def test_complete_energy_and_no_residual_can_be_drawn():
    before = dict(matplotlib.rcParams)
    draw = lambda: figures.png(figures.energy_figure(np.ones(3), np.ones(3), 3))  # noqa: E731
    assert draw() == draw()
    pixels(figures.reconstruction_figure(np.array([1e-5, 1e-6, 0.0]), np.zeros(2), 2, math.nan))
    assert dict(matplotlib.rcParams) == before


@pytest.mark.parametrize(
    "values",
    [
        10.0 ** np.random.default_rng(0).uniform(-11.0, -3.0, 500),
        np.zeros(4),
        np.full(4, 1e-6),
        np.full(1, 1e-4),
    ],
)
def test_bins_are_equally_wide_on_the_axis_and_hold_everything(values):
    bins = error_bins([values, values[:3]])
    assert len(bins) >= 2 and np.diff(np.log10(bins)) == pytest.approx(0.25)
    assert np.histogram(np.maximum(values, SMALLEST), bins)[0].sum() == len(values)


def test_shares_add_up_to_all_particles_of_all_runs():
    rng = np.random.default_rng(1)
    runs = [
        ParticleErrors(10.0 ** rng.uniform(-9, -4, 50), 10.0 ** rng.uniform(-13, -6, 50)) for _ in range(3)
    ]
    figure = histogram_figure(runs)
    for axis in figure.axes:
        assert sum(bar.get_height() for bar in axis.patches) == pytest.approx(100.0)
    medians = [axis.lines[0].get_xdata()[0] for axis in figure.axes]
    assert medians[0] == pytest.approx(np.median(np.concatenate([run.reduction for run in runs])))
    pixels(figure)


def test_log_is_read_as_it_was_written(tmp_path):
    with SummaryWriter(tmp_path / "tensorboard") as writer:
        for step in range(0, 300, 50):
            writer.add_scalar("loss/total", 2.0 ** (-step / 50), step)
            writer.add_scalar("samples_per_s", 1000.0, step)
        writer.add_scalar("skill/validation", 0.5, 250)
    log = read_log(tmp_path / "tensorboard")
    assert set(log) == {"loss/total", "skill/validation"}
    assert log["loss/total"][:, 0] == pytest.approx(np.arange(0, 300, 50))
    assert log["loss/total"][:, 1] == pytest.approx(2.0 ** -np.arange(6.0))
    pixels(training_figure(log))


def test_no_log_is_no_error(tmp_path):
    assert read_log(tmp_path / "tensorboard") == {}
    (tmp_path / "events.out.tfevents.1.x").write_bytes(b"cut short")
    assert read_log(tmp_path) == {}


@pytest.mark.parametrize("name", [r"loss/$\frac$ %_", "skill/validation", "force_nrmse/validation"])
def test_part_of_a_log_can_be_drawn_and_names_are_no_formulas(name):
    pixels(training_figure({name: np.array([[1.0, 0.5], [2.0, 0.4]])}))


def test_rollouts_that_ran_away_do_not_flatten_the_rest():
    log = {"skill/validation": np.array([[1.0, -1e9], [2.0, np.nan], [3.0, 0.9]])}
    low, high = training_figure(log).axes[1].get_ylim()
    assert LOWEST - 0.1 < low < LOWEST and 1.0 < high < HIGHEST


def test_a_file_that_is_no_log_is_one_line(tmp_path):
    record = b"\xff\xff\xff\x0f"  # no event
    length = len(record).to_bytes(8, "little")
    checks = [masked_crc32c(part).to_bytes(4, "little") for part in (length, record)]
    content = b"".join((length, checks[0], record, checks[1]))
    (tmp_path / "events.out.tfevents.1.x").write_bytes(content)
    with pytest.raises(UserError, match="holds no log of TensorBoard") as caught:
        read_log(tmp_path)
    assert "\n" not in str(caught.value)


# --- Quantities through time -----------------------------------------------------------------------------


def curves(panel):
    return {curve.label: curve for curve in panel.curves}


def errors(scale=1.0, frames=17):
    return PositionErrors(np.arange(frames) / 60.0, *[scale * np.linspace(1e-6, 1e-4, frames)] * 7)


def test_forces_have_their_signs_and_predictions_begin_after_the_history(truth, prediction):
    panels = force_panels(truth, prediction, HISTORY, MEAN)
    assert [panel.label for panel in panels] == ["draft −Fx [N]", "vertical Fz [N]"]
    draft = curves(panels[0])
    assert np.array_equal(draft["simulated (MPM)"].values, -truth.force[:, 0])
    assert np.array_equal(draft["network"].values, -prediction.force[HISTORY:, 0])
    assert np.array_equal(draft["network"].time, prediction.time[HISTORY:])
    assert draft["training mean"].values == pytest.approx(80.0)
    pixels(history_figure(panels))


def test_a_force_along_an_axis_without_any_is_left_out(truth, prediction):
    def labels(lateral, forward=1.0):
        force = prediction.force * [forward, 0.0, forward]
        force[:, 1] = lateral * np.abs(prediction.force).max()
        pushed = SimpleNamespace(
            time=prediction.time, force=force, scene=prediction.scene, pose=prediction.pose, force_spread=None
        )
        panels = force_panels(None, pushed, HISTORY, MEAN)
        # A small component is not blown up.
        assert all(np.ptp(limits(panel)) >= 0.1 * np.ptp(limits(panels[0])) for panel in panels)
        return [panel.label.split()[0] for panel in panels]

    assert labels(0.01) == ["draft", "vertical"]
    assert labels(0.2) == ["draft", "lateral", "vertical"]
    assert labels(0.0, forward=0.0) == ["draft", "vertical"]


def test_a_turned_wheel_is_compared_along_its_heading_and_its_axle(tmp_path):
    """The forces of two wheels that were turned by 90° are those of the world, the other way round."""
    scene = WHEEL | {"slip_angle": 90.0}
    run = Run(make_run(tmp_path / "run.h5", frames=20, n=60, scene=scene))
    force = np.array([3.0, 2.0, 1.0]) * np.linspace(0.0, 1.0, 20)[:, None]
    spread = 0.1 * force
    wheel = SimpleNamespace(
        time=run.time, force=force, torque=force, scene=run.scene, pose=run.pose, force_spread=spread
    )
    panels = force_panels(wheel, wheel, HISTORY, np.array([3.0, 2.0, 1.0]))
    labels = ["drawbar pull\n(along heading) [N]", "lateral force\n(along axle) [N]", "vertical Fz [N]"]
    assert [panel.label for panel in panels[:3]] == labels
    for panel, last in zip(panels, (2.0, -3.0, 1.0), strict=False):
        assert [curve.values[-1] for curve in panel.curves] == pytest.approx([last] * 3)
        assert panel.curves[-1].band[-1] == pytest.approx(0.1 * abs(last))
    drive = torque_panels(wheel, wheel, HISTORY, np.zeros(3))[1]
    assert drive.label == "drive torque\n(about axle) [N m]"
    assert curves(drive)["network"].values[-1] == pytest.approx(-3.0)
    pixels(history_figure(panels))


def test_wheel_has_drawbar_pull_and_its_own_sinkage(tmp_path):
    runs = [
        Run(make_run(tmp_path / f"{seed}.h5", frames=20, n=60, seed=seed, scene=WHEEL)) for seed in (1, 2)
    ]
    panels = force_panels(*runs, HISTORY, MEAN)
    assert [panel.label for panel in panels] == ["drawbar pull Fx [N]", "vertical Fz [N]", "sinkage [mm]"]
    assert np.array_equal(curves(panels[0])["simulated (MPM)"].values, runs[0].force[:, 0])
    depths = curves(panels[2])
    for label, run, frames in (
        ("simulated (MPM)", runs[0], slice(None)),
        ("network", runs[1], slice(HISTORY, None)),
    ):
        assert depths[label].values == pytest.approx(1e3 * (0.15 - run.pose[frames, 2]))
    pixels(history_figure(panels))


def test_the_spread_is_a_band_around_the_predicted_force(truth, prediction):
    spread = np.linspace(0.0, 60.0, 20)[:, None] * [1.0, 0.1, 0.5]
    told = SimpleNamespace(
        **{name: getattr(prediction, name) for name in ("time", "force", "scene", "pose")},
        force_spread=spread,
    )
    panels = force_panels(truth, told, HISTORY, MEAN)
    assert curves(panels[1])["network"].band == pytest.approx(spread[HISTORY:, 2])
    low, high = limits(panels[0])
    assert low < (-told.force[:, 0] - spread[:, 0]).min() and high > (-told.force[:, 0] + spread[:, 0]).max()
    figure, plain = history_figure(panels), history_figure(force_panels(truth, prediction, HISTORY, MEAN))
    assert [len(axis.collections) for axis in figure.axes] == [1, 1]
    assert [len(axis.collections) for axis in plain.axes] == [0, 0]
    (edge,) = figure.axes[0].collections[0].get_paths()
    assert np.ptp(edge.vertices[:, 1]) > 60.0
    pixels(figure)


def test_path_without_truth(prediction):
    panels = force_panels(None, prediction, 1, MEAN)
    assert "simulated (MPM)" not in curves(panels[0])
    pixels(history_figure(panels))


def test_torque_about_axes_without_any_is_left_out(truth, prediction):
    (pitch,) = torque_panels(truth, prediction, HISTORY, np.zeros(3))
    assert pitch.label == "pitch Ty [N m]"
    still = SimpleNamespace(time=np.arange(8.0), torque=np.zeros((8, 3)), scene={})
    assert torque_panels(still, still, HISTORY, np.zeros(3)) == []


def test_errors_of_soil_force_and_a_body_that_was_predicted(truth, prediction):
    panels = error_panels(errors(), truth, prediction, HISTORY, MEAN)
    labels = ["position RMSE [mm]", "force error [N]", "body misplaced [mm]"]
    assert [panel.label for panel in panels] == labels
    force = curves(panels[1])
    difference = prediction.force[HISTORY:] - truth.force[HISTORY:]
    assert force["network"].values == pytest.approx(np.sqrt((difference**2).sum(axis=1)))
    assert force["training mean"].values[0] == pytest.approx(np.linalg.norm(MEAN - truth.force[HISTORY]))
    assert curves(panels[0])["network"].values[-1] == pytest.approx(10.0)
    pixels(history_figure(panels))
    given = error_panels(errors(0.0), truth, truth, HISTORY, MEAN)  # the body on its given path
    assert [panel.label for panel in given] == labels[:2]
    pixels(history_figure(given))


def test_baseline_that_runs_away_does_not_flatten_the_rest():
    time = np.arange(4.0)
    wild = Curve("wild", time, np.array([0.0, 1e3, 1e6, np.inf]), "black", scaled=False)
    calm = Curve("calm", time, np.array([1.0, 2.0, np.nan, 2.0]), "black")
    low, high = limits(Panel("x", [wild, calm], from_zero=True))
    assert low == 0.0 and 2.0 < high < 2.5
    assert limits(Panel("x", [Curve("zero", time, np.zeros(4), "black")])) == pytest.approx((-0.56, 0.56))
