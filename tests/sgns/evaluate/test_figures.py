"""Figures of the report."""

from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
from tensorboard.summary.writer.record_writer import masked_crc32c
from torch.utils.tensorboard import SummaryWriter

from sgns.config import UserError
from sgns.data.run import Run
from sgns.evaluate import figures
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
    read_log,
    torque_panels,
    training_figure,
)
from sgns.evaluate.metrics import ParticleErrors, PositionErrors, surface_grid
from sgns.evaluate.side_view import (
    body_outline,
    common_scales,
    hull,
    middle_slice,
    nice,
    side_view,
    side_views,
    view_times,
)
from sgns_testing.pictures import pixels
from sgns_testing.runs import make_run

# --- Side views, surface, reduction, errors by particle, training ----------------------------------------


@pytest.fixture
def run(tmp_path):
    with Run(make_run(tmp_path / "run.h5", frames=20, n=400)) as run:
        yield run


def test_side_views_of_one_and_of_two_runs(run):
    start = run.positions(slice(0, 1))[0].astype(np.float64)
    frames = view_times(run, 3)
    one = pixels(side_views({"network": run}, frames, start))
    two = pixels(side_views({"simulated (MPM)": run, "network": run}, frames, start))
    assert two.shape[1] > one.shape[1]


def test_narrow_side_view_has_the_runs_above_each_other_with_one_scale(run):
    start = run.positions(slice(0, 1))[0].astype(np.float64)
    frames = view_times(run, 3)
    scales = common_scales([run, run], frames, start)
    figure = side_view({"simulated (MPM)": run, "network": run}, frames[-1], scales)
    upper, lower = figure.axes[:2]
    assert upper.get_xlim() == lower.get_xlim() == pytest.approx(scales.x_limits)
    assert upper.collections[0].norm is lower.collections[0].norm is scales.speed
    assert pixels(figure).shape[1] == round(figures.PICTURE_WIDTH * figures.DPI)
    assert upper.get_position().y0 > lower.get_position().y1
    strongest = max(np.linalg.norm(run.force[f, [0, 2]]) for f in frames)
    assert scales.arrow * strongest < 0.3 * np.ptp(scales.x_limits)


def test_side_view_of_a_run_without_force_motion_or_blade(tmp_path):
    path = make_run(
        tmp_path / "still.h5", frames=8, n=200, scene={"blade": None, "speed": 1e-9, "depth": 0.0}
    )
    with Run(path) as run:
        start = run.positions(slice(0, 1))[0].astype(np.float64)
        pixels(side_views({"network": run}, view_times(run, 2), start))


def test_view_times_lie_after_the_history_and_within_the_run(run):
    frames = view_times(run, 3)
    assert len(frames) == 3 and frames == sorted(frames)
    assert 3 < frames[0] and frames[-1] < run.frame_count


def test_a_tool_that_only_turns_moves():
    pose, points = np.zeros((20, 7)), np.zeros((20, 1, 3))
    angle = 0.05 * np.minimum(np.arange(20), 12)
    pose[:, 5], pose[:, 6] = np.sin(angle / 2), np.cos(angle / 2)
    points[:, 0, 0], points[:, 0, 1] = np.cos(angle), np.sin(angle)
    run = SimpleNamespace(pose=pose, body_points=points, frame_count=20)
    assert view_times(run, 3)[-1] == round(3 + 0.9 * (12 - 3))


def test_outline_of_a_wheel_is_a_circle_about_its_axle():
    wheel = SimpleNamespace(
        scene={"kind": "wheel", "diameter": 0.15}, pose=np.array([[0.1, 0.0, 0.07, 0, 0, 0, 1.0]])
    )
    outline = body_outline(wheel, 0)
    assert np.linalg.norm(outline - [0.1, 0.07], axis=1) == pytest.approx(0.075)


def test_outline_is_the_box_of_the_blade(run):
    outline = body_outline(run, 0)
    blade = run.scene["blade"]
    sides = np.linalg.norm(np.roll(outline, -1, axis=0) - outline, axis=1)
    assert np.sort(sides) == pytest.approx([blade["thickness"]] * 2 + [blade["length"]] * 2, rel=1e-6)
    assert outline.mean(axis=0) == pytest.approx(run.pose[0, [0, 2]])


def test_hull_of_a_square_with_points_inside():
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=float)
    inside = np.random.default_rng(0).uniform(0.1, 0.9, (20, 2))
    assert sorted(hull(np.vstack([square, inside, square])).tolist()) == sorted(square.tolist())
    assert len(hull(np.array([[0.0, 0.0], [1.0, 1.0]]))) == 2


def test_middle_slice_and_nice_numbers():
    y = np.linspace(0.0, 1.0, 11)
    bed = np.stack(np.meshgrid(y, y, y), axis=-1).reshape(-1, 3)
    chosen = bed[middle_slice(bed)]
    assert np.abs(chosen[:, 1] - 0.5).max() < 0.2 and len(chosen) > 100
    assert [nice(v) for v in (0.1, 0.11, 27.0, 8.5)] == pytest.approx([0.1, 0.15, 30.0, 10.0])


def test_profile(run):
    grid = surface_grid(run.positions(slice(0, 1))[0])
    pixels(figures.profile_figure({"simulated (MPM)": run, "network": run}, [4, 9, 14], grid))


@pytest.mark.parametrize("modes", [1, 2, 7, 64])
def test_reduction_curves(modes):
    energy = 1.0 - 0.5 ** np.arange(1, modes + 1)
    pixels(figures.energy_figure(energy, energy - 0.1, min(modes, 4)))
    residual = 1e-5 * 0.5 ** np.arange(modes + 1)
    pixels(figures.reconstruction_figure(residual, residual[1:], min(modes, 4), 2.0))


def test_complete_energy_and_no_residual_can_be_drawn():
    pixels(figures.energy_figure(np.ones(3), np.ones(3), 3))
    pixels(figures.reconstruction_figure(np.array([1e-5, 1e-6, 0.0]), None, 2))


@pytest.mark.parametrize("name", [r"$\frac$", "50 % $x^$_2", "a\nb", "_"])
def test_names_are_no_formulas(run, name):
    start = run.positions(slice(0, 1))[0].astype(np.float64)
    pixels(side_views({name: run}, [4], start))


def test_settings_of_matplotlib_stay_as_they_were():
    before = dict(matplotlib.rcParams)
    pixels(figures.energy_figure(np.array([0.5]), np.array([0.5]), 1))
    assert dict(matplotlib.rcParams) == before


def test_same_figure_same_bytes():
    draw = lambda: figures.png(figures.energy_figure(np.array([0.5, 0.9]), np.array([0.4, 0.8]), 2))  # noqa: E731
    assert draw() == draw()


def test_bins_are_equally_wide_on_the_axis_and_hold_everything():
    values = 10.0 ** np.random.default_rng(0).uniform(-11.0, -3.0, 500)
    bins = error_bins([values, values[:3]])
    assert np.diff(np.log10(bins)) == pytest.approx(0.25)
    assert np.histogram(values, bins)[0].sum() == 500


@pytest.mark.parametrize("values", [np.zeros(4), np.full(4, 1e-6), np.full(1, 1e-4)])
def test_equal_errors_still_have_a_bin(values):
    bins = error_bins([values])
    assert len(bins) >= 2 and np.histogram(np.maximum(values, SMALLEST), bins)[0].sum() == len(values)


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


@pytest.mark.parametrize("names", [["loss/total"], ["skill/validation"], ["force_nrmse/validation"]])
def test_part_of_a_log_can_be_drawn(names):
    pixels(training_figure({name: np.array([[1.0, 0.5], [2.0, 0.4]]) for name in names}))


def test_rollouts_that_ran_away_do_not_flatten_the_rest():
    log = {"skill/validation": np.array([[1.0, -1e9], [2.0, np.nan], [3.0, 0.9]])}
    low, high = training_figure(log).axes[1].get_ylim()
    assert LOWEST - 0.1 < low < LOWEST and 1.0 < high < HIGHEST


def test_a_file_that_is_no_log_is_one_line(tmp_path):
    record = b"\xff\xff\xff\x0f"  # no event
    length = len(record).to_bytes(8, "little")
    content = length + _masked(length) + record + _masked(record)
    (tmp_path / "events.out.tfevents.1.x").write_bytes(content)
    with pytest.raises(UserError, match="holds no log of TensorBoard") as caught:
        read_log(tmp_path)
    assert "\n" not in str(caught.value)


def _masked(data):
    return masked_crc32c(data).to_bytes(4, "little")


def test_names_of_losses_are_no_formulas():
    pixels(training_figure({r"loss/$\frac$ %_": np.array([[1.0, 0.5], [2.0, 0.4]])}))


# --- Quantities through time -----------------------------------------------------------------------------


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
