"""Points of surrogates and of reductions: smaller training sets, trainings of a given time, tiny studies."""

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest
import yaml

from mpm_warp import Solver, effects_for
from sgns.config import UserError
from sgns.data.run import Run
from sgns.data.writer import RunWriter
from sgns.evaluate.command import evaluate
from sgns.frontier import measure
from sgns.frontier.measure import (
    EveryNthFrame,
    TrainingPlan,
    every_nth_frame,
    frame_means,
    full_space_fields,
    measure_reduction,
    measure_surrogates,
    own_errors,
    read_record,
    reduction_points,
    seconds_per_step,
    train_for,
    training_settings,
    with_training_runs,
)
from sgns.frontier.study import Study, composed_scene
from sgns.model.checkpoint import read_checkpoint
from sgns.reduction.pca import IncrementalPCA
from sgns.reduction.reduce import fit_runs
from sgns.settings import ModelSettings
from sgns_testing.surrogates import FakeSimulator, fitted, frozen_latent, small_dataset
from sgns_testing.tiny import FIT, MODEL, POLYNOMIAL, REDUCTION, TRAINING, make_dataset, reduced

# --- Smaller training sets: nested subsets of runs, every nth frame -------------------------------------


def test_subsets_of_runs_are_nested_and_leave_the_other_splits_alone(tmp_path):
    dataset = make_dataset(tmp_path)
    subsets = [set(with_training_runs(dataset, count, seed=3).split["train"]) for count in (1, 2, 3, 4)]
    assert [len(subset) for subset in subsets] == [1, 2, 3, 4]
    assert subsets[0] < subsets[1] < subsets[2] < subsets[3] == set(dataset.split["train"])
    part = with_training_runs(dataset, 2)
    assert part.split["test"] == dataset.split["test"]
    assert part.split["train"] == [n for n in dataset.split["train"] if n in part.split["train"]]
    assert with_training_runs(dataset, None) is dataset


@pytest.mark.parametrize("count", [0, 5])
def test_more_runs_than_there_are_is_one_line(tmp_path, count):
    with pytest.raises(UserError, match=f"training_runs is {count}.*give 1 to 4"):
        with_training_runs(make_dataset(tmp_path), count)


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_means_of_frames_keep_the_impulse(n):
    force = np.random.default_rng(0).normal(size=(3 * n + 1, 3))
    means = frame_means(force, n)
    assert len(means) == len(force[::n])
    np.testing.assert_array_equal(means[0], force[0])
    np.testing.assert_allclose(n * means[1:].sum(axis=0), force[1:].sum(axis=0), atol=1e-12)


def test_frames_that_fill_no_whole_mean_are_left_out():
    assert len(frame_means(np.zeros((8, 3)), 3)) == 3  # 0, 1-3, 4-6


def test_a_slower_dataset_has_every_nth_frame(tmp_path):
    fast = reduced(tmp_path)  # 14 frames, run f 12
    slow = every_nth_frame(fast, 3)
    assert slow.frame_rate == fast.frame_rate / 3
    for split in ("train", "validation", "test"):
        for whole, part in zip(fast.runs(split), slow.runs(split), strict=True):
            np.testing.assert_array_equal(part.latent, whole.latent[::3])
            np.testing.assert_array_equal(part.pose, whole.pose[::3])
            assert len(part.time) == len(part.force) == len(part.torque) == len(part.latent)
    assert every_nth_frame(fast, 1) is fast


def test_a_run_read_slowly_is_the_slow_reduced_run(tmp_path):
    slow = every_nth_frame(reduced(tmp_path), 3).runs("test")[0]
    with Run(tmp_path / "runs" / "g.h5") as run:
        view = EveryNthFrame(run, 3)
        assert view.frame_rate == 20.0
        assert view.frame_count == len(slow.latent)
        for name in ("time", "pose", "body_points", "force", "torque"):
            np.testing.assert_allclose(getattr(view, name), getattr(slow, name), atol=1e-12)
        np.testing.assert_array_equal(view.positions(slice(1, 3)), run.positions([3, 6]))
        same = EveryNthFrame(run, 1)
        np.testing.assert_array_equal(same.force, run.force)


# --- Trainings of a given time: whole, kept, told apart by what they depend on --------------------------

NAMES = {"preset": {"name": "tiny"}, "dataset": {"name": "tiny"}}
NETWORK = {"model": MODEL, "training": TRAINING, **NAMES}


@pytest.fixture
def data(tmp_path, monkeypatch):
    monkeypatch.setattr(measure, "seconds_per_step", lambda *_: 0.01)
    return reduced(tmp_path / "data")


def test_as_many_steps_as_fit_and_the_rate_falls_over_them(data, tmp_path):
    done = train_for(0.2, data, NETWORK, tmp_path / "kept")
    assert (done.steps, done.samples) == (20, 20 * TRAINING["batch_size"])
    assert done.processor_s >= 0
    training = read_checkpoint(done.checkpoint)["hyper_parameters"]["settings"]["training"]
    assert training["max_steps"] == 20
    assert training["warmup_steps"] == 2
    assert json.loads((done.checkpoint.parent / "training.json").read_text())["steps"] == 20


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"processor_s": 1, "steps": "x", "samples": 3}', "[" * 10**5]
)
def test_a_damaged_record_is_one_line(tmp_path, text):
    (tmp_path / "timed.json").write_text(text)
    with pytest.raises(UserError, match=r"timed\.json.*; remove it to train again"):
        read_record(tmp_path / "timed.json")


def test_what_is_complete_is_taken_and_what_is_not_is_begun_anew(data, tmp_path):
    done = train_for(0.1, data, NETWORK, tmp_path / "kept")
    made = done.checkpoint.stat().st_mtime_ns
    assert train_for(0.1, data, NETWORK, tmp_path / "kept") == done
    assert done.checkpoint.stat().st_mtime_ns == made
    (done.checkpoint.parent / "timed.json").unlink()  # as if killed before its end
    again = train_for(0.1, data, NETWORK, tmp_path / "kept")
    assert again.checkpoint == done.checkpoint
    assert again.checkpoint.stat().st_mtime_ns > made


def test_other_settings_have_another_folder(data, tmp_path, monkeypatch):
    monkeypatch.setattr(measure, "train", lambda *_, output, **__: output.mkdir(parents=True))
    wider = NETWORK | {"model": MODEL | {"hidden_width": 8}}
    done = {
        train_for(seconds, data, settings, tmp_path / "kept", seed).checkpoint
        for seconds, settings, seed in (
            (0.1, NETWORK, 0),
            (0.12, NETWORK, 0),
            (0.1, wider, 0),
            (0.1, NETWORK, 1),
        )
    }
    assert len(done) == 4


def test_polynomials_have_no_steps(data, tmp_path):
    done = train_for(1.0, data, {"model": POLYNOMIAL, "training": FIT, **NAMES}, tmp_path / "kept")
    assert done.steps == 0
    assert done.samples == FIT["draws"] * 4 * 13  # four runs of 14 frames
    assert done.checkpoint.exists()


def test_a_step_with_more_windows_takes_longer(tmp_path):
    data = reduced(tmp_path)
    few, many = (
        seconds_per_step(data, ModelSettings(**MODEL), TRAINING | {"batch_size": size}, 0)
        for size in (2, 2000)
    )
    assert 0 < few < many


def test_a_clock_that_stands_still_gives_no_number_of_steps(tmp_path, monkeypatch):
    monkeypatch.setattr(measure.time, "process_time", lambda: 1.0)
    with pytest.raises(UserError, match="the processor's clock stands still"):
        train_for(0.2, reduced(tmp_path / "data"), NETWORK, tmp_path / "kept")


# --- Errors against the training data's solver: those of `sgns evaluate` --------------------------------


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return small_dataset(tmp_path_factory.mktemp("data"))


def simulator(dataset, **kw):
    return FakeSimulator(fitted(dataset.runs("train"), 6), dataset.runs("train") + dataset.runs("test"), **kw)


def test_they_are_those_of_evaluate(dataset, tmp_path):
    known = simulator(
        dataset, mistake=lambda z, d: z + 1e-3 * np.arange(len(z))[:, None, None], force_factor=1.1
    )
    found = own_errors(known, dataset.runs("test"), dataset.runs("train")).row()
    told = evaluate(known, dataset, tmp_path, checkpoint=Path("best.ckpt")).total.row()
    assert set(found) == set(told)
    # A run file keeps positions in float32.
    for key in ("rmse_total_mm", "skill_frozen", "surface_rmse_mm", "force_nrmse", "draft_mpe_percent"):
        assert found[key] == pytest.approx(told[key], rel=1e-3)


def test_the_truth_leaves_only_the_reduction(dataset):
    scores = own_errors(simulator(dataset), dataset.runs("test"), dataset.runs("train"))
    assert scores.force.overall_nrmse == 0
    assert scores.rmse_mm("total") == pytest.approx(scores.rmse_mm("reduction"), rel=1e-6)


def test_a_frozen_bed_has_no_skill(dataset):
    known = simulator(dataset, mistake=frozen_latent)
    scores = own_errors(known, dataset.runs("test"), dataset.runs("train"))
    # But for what the reduction leaves out of the frame it is frozen in.
    assert abs(scores.skill("frozen")) < 0.2


# --- Points of surrogates: what an entry may say, what is taken from elsewhere, what a rollout becomes --

BED = [
    "scene.bed.spacing=0.05",
    "scene.bed.particles_per_cell=1",
    "scene.duration=0.2",
    "scene.blade.thickness=0.1",
]


def study(folder, *entries, **scene):
    settings = {"scene": "quick_excavation", "dataset": "quick", "cases": {"a": BED}} | scene
    settings |= {"reference": {"label": "fine"}, "surrogate": list(entries)}
    return Study.from_settings({"name": "tiny", "scenes": {"cut": settings}}, folder)


def plan(entry, **scene):
    found = study("x", {"axis": "r", "label": "b", **entry}, **scene).scenes[0]
    return TrainingPlan.of(found, found.points("surrogate")[0])


def test_keys_of_an_entry_come_over_those_of_its_scene():
    assert plan({}) == TrainingPlan()
    assert plan({"runs": 4}, training={"seconds": 5}) == TrainingPlan(seconds=5, runs=4)
    assert plan({"seconds": 7}, training={"seconds": 5, "seed": 2}) == TrainingPlan(seconds=7, seed=2)


@pytest.mark.parametrize(
    "entry, line",
    [
        ({"second": 4}, "unknown key 'second'; allowed: seconds, runs, every, seed"),
        ({"seconds": 0}, "seconds is 0; it must be a number above 0"),
        ({"seconds": True}, "seconds is True"),
        ({"every": 0}, "every is 0; it must be a whole number, at least 1"),
        ({"runs": 1.5}, "runs is 1.5"),
    ],
)
def test_bad_entries_are_one_line(entry, line):
    with pytest.raises(UserError, match=line):
        plan(entry)


def test_overrides_make_settings():
    assert training_settings("quick", ("preset=fast",))["model"]["hidden_width"] == 64
    assert training_settings("quick_wheel", ("model=polynomial",))["training"]["draws"] == 2


@pytest.fixture
def table(tmp_path):
    file = tmp_path / "table.csv"
    rows = [
        {"case": "solver", "rollout_s_per_simulated_s": "6", "force_nrmse": ""},
        {"case": "all particles", "rollout_s_per_simulated_s": "10.4", "force_nrmse": "0.77"},
    ]
    with file.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    return file


def elsewhere(folder, table, case="all particles"):
    asked = study(folder, {"axis": "f", "label": "full", "table": str(table), "case": case})
    measure_surrogates(asked)
    return asked.store.points()


def test_a_line_of_the_full_space_table_is_taken_anew_each_time(tmp_path, table):
    [(point, cases)] = elsewhere(tmp_path / "out", table)
    assert (point.kind, point.wall_s_per_simulated_s, point.own_force_nrmse) == ("full space", 10.4, 0.77)
    assert cases == []
    assert math.isnan(point.force_nrmse)
    assert math.isnan(point.training_s)
    table.write_text(table.read_text().replace("0.77", "0.66"))
    [(point, _)] = elsewhere(tmp_path / "out", table)
    assert point.own_force_nrmse == 0.66


def test_without_the_table_there_is_no_point(tmp_path):
    assert elsewhere(tmp_path / "out", tmp_path / "none.csv") == []


def test_a_case_that_is_not_there_is_one_line(tmp_path, table):
    with pytest.raises(UserError, match="has no case 'x'; there are: solver; all particles"):
        elsewhere(tmp_path / "out", table, "x")


def test_empty_cells_are_not_known():
    assert math.isnan(full_space_fields({"force_nrmse": ""})["own_force_nrmse"])


# --- a whole point ----------------------------------------------------------------------------------------


class NoWorkload:
    def measure(self):
        return [1.0, 1.0]


@pytest.fixture(scope="module")
def data_of_surrogate_points(tmp_path_factory):
    """Five runs of the smallest bed that a plate cuts, by the solver."""
    folder = tmp_path_factory.mktemp("data")
    split = {"train": ["a", "b", "c"], "validation": ["d"], "test": ["e"]}
    for speed, name in enumerate(name for names in split.values() for name in names):
        scene, _ = composed_scene(["scene=quick_excavation", *BED, f"scene.speed={0.1 + 0.05 * speed}"])
        solver = Solver(scene, effects_for(scene)[0])
        frames = list(solver.frames())
        with RunWriter(
            folder / "runs" / f"{name}.h5",
            scene=scene.to_dict(),
            effects={},
            arrangement_hash=scene.arrangement_hash,
            particle_count=len(frames[0].position),
            body_points=len(scene.body_points()),
            frame_rate=scene.frame_rate,
            seed=0,
            producer="mpm",
        ) as writer:
            for frame in frames:
                writer.append(
                    frame.time,
                    frame.position,
                    frame.velocity,
                    frame.body_points,
                    frame.body_pose,
                    frame.force,
                    frame.torque,
                )
            writer.finish(1.0)
    (folder / "dataset.yaml").write_text(yaml.safe_dump({"name": "tiny", "split": split}))
    return folder


@pytest.fixture
def tiny(data_of_surrogate_points, monkeypatch):
    """Small networks on those runs, trained for ten steps."""
    settings = {
        "model": MODEL,
        "training": TRAINING,
        "reduction": REDUCTION,
        "preset": {"name": "tiny"},
        "dataset": {"name": "tiny", "path": str(data_of_surrogate_points)},
    }
    monkeypatch.setattr(measure, "Workload", NoWorkload)
    monkeypatch.setattr(measure, "seconds_per_step", lambda *_: 0.01)
    monkeypatch.setattr(measure, "training_settings", lambda *_: settings)


@pytest.mark.usefixtures("tiny")
def test_points_from_training_to_observation(tmp_path):
    asked = study(
        tmp_path,
        {"axis": "preset", "label": "whole"},
        {"axis": "runs", "label": "two runs at 30 Hz", "runs": 2, "every": 2, "seed": 3},
        training={"seconds": 0.1},
    )
    measure_surrogates(asked)
    points = {point.label: point for point, _ in asked.store.points()}
    whole, part = points["whole"], points["two runs at 30 Hz"]
    assert (whole.training_runs, part.training_runs) == (3, 2)
    assert whole.training_samples == 10 * TRAINING["batch_size"]
    assert whole.own_runs == 1
    assert 0 < whole.wall_s_per_simulated_s < whole.decoded_wall_s_per_simulated_s
    assert "training.max_steps=10" in whole.settings
    assert (whole.note, part.note) == ("", "trained on 2 runs, one frame in 2")
    assert "seed=3" in part.settings
    fast, slow = (asked.store.observation(point, "a") for point in (whole, part))
    assert (len(fast.time), len(slow.time)) == (13, 7)
    assert slow.time[-1] == pytest.approx(fast.time[-1])
    np.testing.assert_array_equal(fast.force[0], 0)
    assert np.nanmax(np.abs(fast.moved[0])) < 1e-2  # the start, as the basis holds it

    made = asked.store.file("cut", "surrogate", "whole").stat().st_mtime_ns
    measure_surrogates(asked)
    assert asked.store.file("cut", "surrogate", "whole").stat().st_mtime_ns == made


@pytest.mark.usefixtures("tiny")
def test_a_rollout_that_leaves_the_numbers_is_said_and_not_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(measure, "finite_frames", lambda _: 7)
    asked = study(tmp_path, {"axis": "preset", "label": "whole"}, training={"seconds": 0.1})
    measure_surrogates(asked)
    [(point, cases)] = asked.store.points()
    assert (point.note, cases) == ("a: not finite from frame 7 on", [])


@pytest.mark.usefixtures("tiny")
def test_another_bed_than_the_data_s_is_one_line(tmp_path):
    asked = study(tmp_path, {"axis": "preset", "label": "whole"}, cases={"a": ["scene.duration=0.2"]})
    with pytest.raises(UserError, match="has another bed of particles than dataset=quick"):
        measure_surrogates(asked)


# --- Points of the reduction ----------------------------------------------------------------------------


def reduction_study(folder, *entries):
    found = [{"axis": "r", "label": entry["centring"], **entry} for entry in entries]
    return study(folder, dataset="tiny", cases={"a": []}, reduction=found)


@pytest.fixture
def measured(tmp_path, monkeypatch):
    make_dataset(tmp_path / "data")
    monkeypatch.setattr(measure, "Workload", NoWorkload)
    monkeypatch.setattr(measure, "training_settings", lambda *_: {"dataset": {"path": tmp_path / "data"}})
    asked = reduction_study(
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


def test_a_reduction_that_is_there_is_not_measured_again(measured, monkeypatch):
    asked, _ = measured
    monkeypatch.setattr(measure, "fit_runs", lambda *_: pytest.fail("fitted again"))
    for name in ("particle_axis, r 500",):  # cannot be had, so it is asked for each time
        assert not asked.store.has("cut", "reduction", name)
    measure_reduction(reduction_study(asked.folder, {"centring": "particle_axis", "modes": [1, 2, 4]}))


@pytest.mark.parametrize(
    "entry, line",
    [
        ({"centring": "mean", "modes": [1]}, "centring is 'mean'; allowed: scalar"),
        ({"centring": "scalar", "modes": [0]}, "modes is .0.; it must be a list of whole numbers"),
        ({"centring": "scalar"}, "modes is None"),
    ],
)
def test_bad_reductions_are_one_line(tmp_path, entry, line):
    with pytest.raises(UserError, match=line):
        list(reduction_points(reduction_study(tmp_path, entry).scenes[0]))


def test_one_stream_is_the_same_as_by_hand(tmp_path):
    paths = make_dataset(tmp_path).runs("train")
    pca = IncrementalPCA(4)
    for path in paths:
        with Run(path) as run:
            pca.partial_fit(run.positions())
    by_hand, streamed = pca.basis("scalar"), fit_runs(paths, 4).basis("scalar")
    assert math.isclose(float(by_hand.residual_mse(4)), float(streamed.residual_mse(4)), rel_tol=1e-6)
