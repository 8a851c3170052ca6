"""Wheels and other bodies from the command line: scenes, data sets, what they print and refuse."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf

from mpm_warp import Wheel
from sgns.config import UserError
from sgns.data.check import check_run
from sgns.data.run import Run
from sgns.rollout import require_same_freedom
from sgns.simulate.campaign import plan
from sgns.simulate.scene import scene_from_config
from sgns_testing.commands import sgns

SHORT = ["scene=quick_wheel", "scene.settle=0.05", "scene.duration=0.1", "output=run.h5"]


def composed(*overrides):
    with initialize_config_module("sgns.conf", version_base="1.3"):
        return compose("simulate", list(overrides))


@pytest.mark.parametrize("name", ["wheel", "quick_wheel", "paper_wheel", "published_wheel"])
def test_wheel_scenes_are_good(name):
    scene = scene_from_config(composed(f"scene={name}"))
    assert isinstance(scene, Wheel)
    assert scene.warnings() == []


def test_the_published_scene():
    scene = scene_from_config(composed("scene=published_wheel"))
    assert scene.bilateral and scene.friction == 3.0 and scene.damping == 500.0
    assert scene.material.youngs_modulus == 15e6
    assert len(scene.initial_positions()) == pytest.approx(6005, rel=0.02)
    assert scene.frame_count == 561
    assert 1e3 * scene.speed == pytest.approx(12.0)


@pytest.mark.parametrize(("name", "runs"), [("paper_wheel", 243), ("desktop_wheel", 60), ("quick_wheel", 16)])
def test_every_run_of_a_wheel_dataset_is_a_scene(name, runs):
    settings = OmegaConf.to_container(composed(f"dataset={name}"), resolve=True)["dataset"]
    base = scene_from_config(composed(f"scene={settings['scene']}")).to_dict()
    campaign = plan(settings, base, {}, "float32", 0)
    scenes = campaign.scenes.values()
    assert len(scenes) == runs
    assert len({s.arrangement_hash for s in scenes}) == 1
    if name == "paper_wheel":
        small = {s.load for s in scenes if s.diameter == 0.05}
        assert sorted(small) == pytest.approx([100 / 9, 164 / 9, 225 / 9])
        assert {s.width for s in scenes if s.diameter == 0.30} == {0.125}
        assert {round(1e3 * s.speed, 6) for s in scenes} == {15.6, 12.0, 5.85}


def test_a_wheel_run_says_what_a_wheel_does(tmp_path):
    done = sgns(tmp_path, "simulate", *SHORT)
    assert done.returncode == 0, done.stderr
    for words in ("mean drawbar pull", "sinkage", "torque"):
        assert words in done.stdout
    assert "draft" not in done.stdout
    assert check_run(tmp_path / "run.h5") == []
    with Run(tmp_path / "run.h5") as run:
        assert run.scene["kind"] == "wheel"
        assert run.body_points.shape == (7, 16, 3)
        assert run.pose[-1, 2] < run.pose[0, 2]


def test_a_network_of_prescribed_bodies_cannot_roll_a_wheel_out():
    blades, wheels = SimpleNamespace(predicts_body=False), SimpleNamespace(predicts_body=True)
    wheel, blade = (scene_from_config(composed(f"scene={name}")) for name in ("wheel", "excavation"))
    with pytest.raises(
        UserError, match=r"scene\.kind is wheel, whose height is free; a\.ckpt was trained on pre"
    ):
        require_same_freedom(blades, wheel, "a.ckpt")
    with pytest.raises(
        UserError, match=r"scene\.kind is excavation, whose height is prescribed; a\.ckpt was"
    ):
        require_same_freedom(wheels, blade, "a.ckpt")
    require_same_freedom(blades, blade, "a.ckpt")
    require_same_freedom(wheels, wheel, "a.ckpt")


def test_a_body_from_the_command_line(tmp_path):
    (tmp_path / "path.csv").write_text("t,x,y,z,qx,qy,qz,qw\n0,0.3,0.3,0.1,0,0,0,1\n1,0.3,0.3,0.05,0,0,0,1\n")
    (tmp_path / "tool.obj").write_text(
        "v 0 0 0\nv 90 0 0\nv 0 90 0\nv 0 0 90\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
    )
    done = sgns(
        tmp_path,
        "simulate",
        "scene=body",
        "scene.path=path.csv",
        "scene/tool=mesh",
        "scene.tool.file=tool.obj",
        "scene.tool.scale=0.001",
        "scene.duration=0.02",
        "scene.bed.spacing=0.03",
        "output=run.h5",
    )
    assert done.returncode == 0, done.stderr
    assert "mean force" in done.stdout
    assert Run(tmp_path / "run.h5").body_points.shape[1] == 4


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["scene=body"], "scene.path=..."),
        (["scene=body", "scene/tool=mesh"], "scene.tool.file=..."),
        (["scene=body", "scene/tool=cone"], "scene/tool=cone: no such option"),
        (["scene=wheel", "scene.load=heavy"], "scene.load is 'heavy'"),
        (["scene=wheel", "scene.bilateral=maybe"], "scene.bilateral is 'maybe'; allowed: true, false"),
        (["scene=wheel", "scene.friction_angle=steep"], "scene.friction_angle is 'steep'"),
        (["scene=wheel", "scene.grousers=3"], "scene.grouser_height is 0.0; it must be above 0 m"),
    ],
)
def test_bad_input_is_one_line(tmp_path, overrides, words):
    done = sgns(tmp_path, "simulate", *overrides)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert words in line
    assert list(tmp_path.iterdir()) == []
