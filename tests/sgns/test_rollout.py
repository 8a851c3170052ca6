from dataclasses import replace
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from sgns import rollout as rolling
from sgns.config import UserError
from sgns.data import run as chunks
from sgns.data.check import check_run
from sgns.data.run import Run
from sgns.model.training_range import Excess
from sgns.rollout import bed_differences, require_known_bed, rollout_scene, unlearned
from sgns.simulator import Simulator
from sgns_testing.commands import composed
from sgns_testing.meshes import box_corners, box_triangles
from sgns_testing.surrogates import FakeSimulator, fitted, small_dataset


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return small_dataset(tmp_path_factory.mktemp("data"), frames=12)


@pytest.fixture
def simulator(dataset):
    return FakeSimulator(fitted(dataset.runs("train"), 4), dataset.runs("train"))


class FakeScene:
    """The parts of a scene that a rollout asks for."""

    frame_rate = 60.0
    mesh = None
    displaced = ()

    def __init__(self, simulator, arrangement_hash=None, bed=None):
        self.poses = simulator.known[0][0]
        self.scene = dict(simulator.scene) | ({"bed": bed} if bed else {})
        self.arrangement_hash = arrangement_hash or simulator.arrangement_hash

    def body_poses(self):
        return self.poses

    def body_points(self):
        return np.array([[0.0, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]])

    def to_dict(self):
        return self.scene


def test_file_is_a_complete_run_with_decoded_soil(simulator, tmp_path):
    path = tmp_path / "out" / "rollout.h5"
    scene = FakeScene(simulator)
    timing = rollout_scene(simulator, scene, path, checkpoint="first/best.ckpt")
    assert check_run(path) == []
    with Run(path) as run:
        assert run.producer == "rollout"
        assert run.frame_count == len(scene.poses)
        expected = simulator.basis.inverse(simulator.known[0][1]).numpy()
        assert run.positions() == pytest.approx(expected.astype(np.float32), abs=1e-6)
        assert run.force == pytest.approx(simulator.known[0][2], rel=1e-5, abs=1e-5)
        assert run.pose == pytest.approx(scene.poses)
        # It says which checkpoint made it.
        assert run.extra["checkpoint"] == "first/best.ckpt"
        assert run.extra["checkpoint_settings"] == simulator.card["settings"]
        assert run.extra["history"] == 1
    assert timing.simulated == pytest.approx((len(scene.poses) - 1) / 60.0)
    assert timing.complete_rate > timing.inference_rate > 0.0


def test_the_spread_of_an_ensemble_is_in_the_file(simulator, tmp_path):
    scene, known = FakeScene(simulator), simulator.rollout
    with_spread = tmp_path / "with.h5"
    spread = np.linspace(0.0, 3.0, len(scene.poses))[:, None] * [1.0, 2.0, 3.0]
    simulator.rollout = lambda *args, **kw: replace(known(*args, **kw), force_spread=spread)
    rollout_scene(simulator, scene, with_spread)
    simulator.rollout = known
    rollout_scene(simulator, scene, tmp_path / "without.h5")
    assert check_run(with_spread) == check_run(tmp_path / "without.h5") == []
    with Run(with_spread) as run, Run(tmp_path / "without.h5") as without:
        np.testing.assert_array_equal(run.force_spread, spread)
        assert without.force_spread is None and run.content_hash != without.content_hash
    with h5py.File(with_spread, "a") as file:
        file["observables/body/force_spread/value"][3, 1] = np.nan
    assert any("force_spread is not finite at frame 3" in problem for problem in check_run(with_spread))


def test_velocities_are_differences_of_positions(simulator, tmp_path, monkeypatch):
    scene = FakeScene(simulator)
    rollout_scene(simulator, scene, tmp_path / "a.h5")
    monkeypatch.setattr(chunks, "CHUNK_BYTES", 1.0)  # one frame at a time
    rollout_scene(simulator, scene, tmp_path / "b.h5")
    with Run(tmp_path / "a.h5") as a, Run(tmp_path / "b.h5") as b:
        velocity, position = a.velocities(), a.positions().astype(np.float64)
        assert (velocity[0] == 0.0).all()
        assert velocity[1:] == pytest.approx(60.0 * np.diff(position, axis=0), abs=1e-4)
        assert a.content_hash == b.content_hash


def test_unknown_bed_is_refused_in_one_line_that_names_it(simulator):
    bed = dict(simulator.scene["bed"]) | {"spacing": 0.01}
    with pytest.raises(UserError, match=r"^[^\n]*best\.ckpt[^\n]*spacing 0\.02 \(here 0\.01\)[^\n]*$"):
        require_known_bed(simulator, FakeScene(simulator, "other", bed), "best.ckpt")
    # Equal beds still differ in something.
    assert "arrangement" in bed_differences({"bed": {"spacing": 1}}, {"bed": {"spacing": 1}})


def test_a_tool_that_starts_in_the_soil_is_refused(simulator):
    scene = FakeScene(simulator, "other")
    scene.displaced = (3, 4)
    with pytest.raises(
        UserError, match=r"in the soil at the start, where 2 particles .*begin above the soil"
    ):
        require_known_bed(simulator, scene, "best.ckpt")


def test_other_frame_rate_is_refused(simulator):
    scene = FakeScene(simulator)
    scene.frame_rate = 30.0
    with pytest.raises(UserError, match=r"scene\.frame_rate is 30 Hz"):
        require_known_bed(simulator, scene, "best.ckpt")
    scene.frame_rate = 60.0
    require_known_bed(simulator, scene, "best.ckpt")


def explode(latent, history):
    latent[7:] = np.inf
    return latent


def test_of_a_rollout_that_runs_away_the_frames_before_are_kept(simulator, tmp_path):
    rollout_scene(simulator, FakeScene(simulator), tmp_path / "whole.h5")
    simulator.mistake = explode
    with pytest.raises(
        UserError, match=r"not finite from frame 7 .*the frames before are in .*r\.stopped\.h5"
    ):
        rollout_scene(simulator, FakeScene(simulator), tmp_path / "r.h5")
    assert not (tmp_path / "r.h5").exists()
    assert [
        line for line in check_run(tmp_path / "r.stopped.h5") if "stopped after 7 good frames" not in line
    ] == []
    with Run(tmp_path / "r.stopped.h5") as run, Run(tmp_path / "whole.h5") as whole:
        assert run.frame_count == 7
        assert "not finite from frame 7" in run.stopped and whole.stopped is None
        np.testing.assert_array_equal(run.positions(), whole.positions(slice(0, 7)))


def test_a_rollout_that_never_was_finite_leaves_nothing_behind(simulator, tmp_path):
    simulator.mistake = lambda latent, history: np.full_like(latent, np.nan)
    with pytest.raises(UserError, match="not finite from frame 0"):
        rollout_scene(simulator, FakeScene(simulator), tmp_path / "out" / "r.h5")
    assert not (tmp_path / "out").exists()


def test_a_path_unlike_the_training_runs_is_told_and_recorded(simulator, tmp_path, caplog):
    answer = simulator.rollout
    excess = Excess(np.array([0.0] * 8 + [0.7] * 4), ["load"] * 12)
    simulator.rollout = lambda *a, **k: replace(answer(*a, **k), _excess=lambda: excess)
    rollout_scene(simulator, FakeScene(simulator), tmp_path / "a.h5")
    words = "from frame 8 on the scene is unlike the training runs; at frame 8 load is 0.7 times its training range"
    assert words in caplog.text and "guess" in caplog.text
    with Run(tmp_path / "a.h5") as run:
        assert run.extra["outside_training"] == 0.7
        assert run.extra["outside_training_words"].startswith(words)


def test_changes_that_the_network_cannot_feel_are_named():
    known = {"gravity": 9.81, "blade": {"length": 0.3, "width": 0.4}, "depth": 0.1}
    asked = {"gravity": 1.62, "blade": {"length": 0.3, "width": 0.2}, "depth": 0.2}
    assert unlearned(known, asked) == [
        "gravity 1.62 (trained with 9.81)",
        "blade.width 0.2 (trained with 0.4)",
    ]
    assert unlearned(known, known | {"depth": 0.3}) == []
    assert unlearned(known, asked, ["gravity"]) == ["blade.width 0.2 (trained with 0.4)"]
    # What follows from a number that is told need not be told.
    soil = {"friction_angle": 30.0, "material": {"static_friction": 0.577}}
    other = {"friction_angle": 37.0, "material": {"static_friction": 0.754}}
    assert len(unlearned(soil, other)) == 2 and unlearned(soil, other, ["friction_angle"]) == []
    # The same mesh in another size, and the same size from numbers in another unit.
    mesh = {"tool": {"digest": "a", "unit": "cm", "scale": 1.0}}
    assert unlearned(mesh, {"tool": mesh["tool"] | {"scale": 0.7}}) == ["tool.scale 0.7 (trained with 1.0)"]
    assert unlearned(mesh, {"tool": mesh["tool"] | {"unit": "mm", "scale": 10.0}}) == []
    assert unlearned(mesh, {"tool": mesh["tool"] | {"digest": "b"}}) == ["another mesh than in training"]


def test_the_scene_of_a_checkpoint_names_no_file(monkeypatch):
    scene = {
        "material": {},
        "path": [[0.0]],
        "bed": {"surface": "secret.csv", "spacing": 0.02},
        "kind": "body",
    }
    scene |= {"tool": {"shape": "mesh", "file": "secret.stl", "digest": ""}}
    scene |= {"others": [{"motion": "path", "path": "secret.csv"}]}
    monkeypatch.setattr(rolling, "read_checkpoint", lambda _: {"hyper_parameters": {"scene": scene}})
    found = rolling.scene_groups("a.ckpt")["scene"]
    assert "secret" not in str(found)
    assert found["others"] == [] and found["bed"] == {"surface": "???", "spacing": 0.02}


def test_a_rollout_holds_the_mesh_of_its_tool(simulator, tmp_path):
    scene = FakeScene(simulator)
    scene.mesh = box_corners((0.2, 0.2, 0.2), (-0.1, -0.1, -0.1)), box_triangles()
    rollout_scene(simulator, scene, tmp_path / "a.h5")
    with Run(tmp_path / "a.h5") as run:
        for found, known in zip(run.mesh, scene.mesh, strict=True):
            np.testing.assert_array_equal(found, known)


def test_a_path_that_comes_to_nothing_is_told(tmp_path, monkeypatch, caplog):
    """As `sgns simulate` does, without what is about the solver only."""
    file = tmp_path / "path.csv"
    file.write_text("0,0.4,0.3,0.12,0,0,0,1\n2,0.5,0.3,0.1,0,0,0,1\n")
    known = SimpleNamespace(scene={}, context_keys=())
    monkeypatch.setattr(Simulator, "load", lambda *_, **__: known)
    for check in ("require_known_bed", "require_same_freedom"):
        monkeypatch.setattr(rolling, check, lambda *_: None)
    monkeypatch.setattr(rolling, "rollout_scene", lambda *_, **__: rolling.RolloutTiming(1.0, 1.0, 1.0))
    thin = ["scene=body", f"scene.path={file}", "scene.tool.size=[0.01,0.2,0.1]"]
    cfg = composed(*thin, "checkpoint=a.ckpt", f"output={tmp_path / 'run.h5'}", command="rollout")
    with caplog.at_level("INFO"):
        rolling.main(cfg)
    (words,) = [r.getMessage() for r in caplog.records if r.levelname == "WARNING"]
    assert "the tool never touches soil" in words
    assert caplog.records[-1].getMessage() == f"to look at it: sgns plot {tmp_path / 'run.h5'}"
    # In another unit it is refused, before an output that is taken.
    (tmp_path / "run.h5").touch()
    with pytest.raises(UserError, match=r"run\.h5 is there already"):
        rolling.main(cfg)
    file.write_text("0,400,300,120,0,0,0,1\n2,500,300,30,0,0,0,1\n")
    with pytest.raises(UserError, match="the positions look like millimetres"):
        rolling.main(cfg)
