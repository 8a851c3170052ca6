"""Points of surrogates: what an entry may say, what is taken from elsewhere, what a rollout becomes."""

import csv
import math

import numpy as np
import pytest
import yaml
from tiny import MODEL, REDUCTION, TRAINING

from mpm_warp import Solver, effects_for
from sgns.errors import UserError
from sgns.frontier import surrogate_points, timed_training
from sgns.frontier.study import Study
from sgns.frontier.surrogate_points import (
    TrainingPlan,
    full_space_fields,
    measure_surrogates,
    training_settings,
)
from sgns.frontier.timing import composed_scene
from sgns.runs import RunWriter

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
def data(tmp_path_factory):
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
def tiny(data, monkeypatch):
    """Small networks on those runs, trained for ten steps."""
    settings = {
        "model": MODEL,
        "training": TRAINING,
        "reduction": REDUCTION,
        "preset": {"name": "tiny"},
        "dataset": {"name": "tiny", "path": str(data)},
    }
    monkeypatch.setattr(surrogate_points, "Workload", NoWorkload)
    monkeypatch.setattr(timed_training, "seconds_per_step", lambda *_: 0.01)
    monkeypatch.setattr(surrogate_points, "training_settings", lambda *_: settings)


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
    monkeypatch.setattr(surrogate_points, "finite_frames", lambda _: 7)
    asked = study(tmp_path, {"axis": "preset", "label": "whole"}, training={"seconds": 0.1})
    measure_surrogates(asked)
    [(point, cases)] = asked.store.points()
    assert (point.note, cases) == ("a: not finite from frame 7 on", [])


@pytest.mark.usefixtures("tiny")
def test_another_bed_than_the_data_s_is_one_line(tmp_path):
    asked = study(tmp_path, {"axis": "preset", "label": "whole"}, cases={"a": ["scene.duration=0.2"]})
    with pytest.raises(UserError, match="has another bed of particles than dataset=quick"):
        measure_surrogates(asked)
