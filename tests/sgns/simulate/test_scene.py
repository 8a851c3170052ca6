"""From the settings to scenes, soils and effects, and into the run file."""

from __future__ import annotations

import logging
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from PIL import Image

from mpm_warp import Decision, Effects, Preview, Scene, SceneError, Tolerances, Wheel
from sgns.cli.help import options_of
from sgns.config import UserError
from sgns.data.check import check_run
from sgns.data.run import Run
from sgns.rollout import require_same_freedom
from sgns.simulate.campaign import plan
from sgns.simulate.command import simulate_campaign
from sgns.simulate.scene import (
    asked_effects,
    decided,
    read_heights,
    read_path,
    scene_from_config,
    scene_from_data,
    warning_summary,
)
from sgns_testing.commands import composed, sgns

# --- Effects --------------------------------------------------------------------------------------------


def chosen(*overrides: str) -> tuple[Effects, dict[str, Decision]]:
    cfg = composed(*overrides)
    return decided(scene_from_config(cfg), asked_effects(cfg))


def test_the_shipped_tolerances_are_the_solvers_own():
    asked = asked_effects(composed())
    assert Tolerances(**asked.pop("tolerance")) == Tolerances()
    assert set(asked.values()) == {"auto"}


@pytest.mark.parametrize(
    ("scene", "rate_dependence"),
    [
        (["scene=excavation"], False),
        (["scene=excavation", "scene.speed=0.15", "scene.depth=0.02"], True),  # the fastest, shallowest cut
        (["scene=paper_wheel"], False),
        (["scene=paper_wheel", "scene.gravity=1.62", "scene.diameter=0.05", "scene.load=11.1"], True),
    ],
)
def test_only_the_fastest_of_the_papers_runs_call_for_rate_dependence(scene, rate_dependence):
    effects, _ = chosen(*scene)
    assert effects == Effects(rate_dependence=rate_dependence, symmetry=True, cohesion=False)


@pytest.mark.parametrize("scene", ["incline", "thin_layer"])
def test_layers_of_some_grains_call_for_nonlocality(scene):
    assert chosen(f"scene={scene}")[0].nonlocality


def test_two_names_of_nonlocality():
    for override in ("effects.nonlocal=true", "effects.nonlocality=true"):
        assert chosen("scene=quick_excavation", override)[0].nonlocality
    assert not chosen("scene=thin_layer", "effects.nonlocal=false")[0].nonlocality


def test_all_physics():
    effects, decisions = chosen("scene=column", "effects=all")
    assert effects == Effects(fluidity=True, nonlocality=True, symmetry=True, torque=False, cohesion=False)
    assert decisions["fluidity"].reason.startswith("asked for; auto would turn it off")


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"symmetry": "maybe"}, "effects.symmetry is 'maybe'; allowed: auto, true, false"),
        ({"colour": True}, "effects has no key 'colour'"),
        ({"tolerance": 3}, "effects.tolerance is 3; it must be a group of keys"),
    ],
)
def test_settings_it_refuses(asked, words):
    with pytest.raises(SceneError, match=words):
        decided(Wheel(), asked)


def fast_and_slow(tmp_path, asked):
    """Three slow cuts and one so fast that friction depends on the rate."""
    base = {
        "kind": "excavation",
        "duration": 0.05,
        "clearance": 0.0,
        "start": 0.3,
        "blade": {"length": 0.1, "width": 0.1, "thickness": 0.08, "edge": "square"},
        "bed": {"size": [0.4, 0.2, 0.16], "spacing": 0.04},
    }
    settings = {"name": "tiny", "path": str(tmp_path / "tiny"), "draw": {"speed": [0.05, 0.06, 0.07, 4.0]}}
    return plan(settings, base, asked, "float32", 0)


def test_runs_of_a_dataset_decide_for_themselves(tmp_path, caplog):
    c = fast_and_slow(tmp_path, {"fluidity": "auto", "torque": False})
    with caplog.at_level(logging.INFO):
        simulate_campaign(c, device="cpu", workers=1)
    assert "rate_dependence on in 1 of 4 runs; else off: the body moves soil" in caplog.text
    assert "torque off: asked for; auto would turn it on" in caplog.text
    said = yaml.safe_load((c.path / "dataset.yaml").read_text())
    assert said["effects"] == {"fluidity": "auto", "torque": False}
    for name, scene in c.scenes.items():
        assert check_run(c.file(name)) == []
        with Run(c.file(name)) as run:
            assert run.effects["rate_dependence"]["on"] is (scene.speed == 4.0)
            assert (run.effects["rate_dependence"]["number"] > 0.01) is (scene.speed == 4.0)
            assert not run.torque.any()


def test_what_no_run_can_have_is_refused_before_anything_is_written(tmp_path):
    c = fast_and_slow(tmp_path, {"free_body": True})
    with pytest.raises(SceneError, match=r"effects\.free_body needs a body whose height is free"):
        simulate_campaign(c, device="cpu", workers=1)
    assert not c.path.exists()


# --- Wheels and other bodies ------------------------------------------------------------------------------

SHORT = ["scene=quick_wheel", "scene.settle=0.05", "scene.duration=0.1", "output=run.h5"]


RANDOM = "published_excavation"  # whose bed takes seconds
SCENES = [pytest.param(n, marks=pytest.mark.long) if n == RANDOM else n for n in options_of("scene")]


@pytest.mark.parametrize("name", SCENES)
def test_no_scene_that_ships_warns_of_itself(name):
    path = ["scene.path=[[0,0.3,0.3,0.2,0,0,0,1],[2,0.4,0.3,0.0,0,0,0,1]]"] if name == "body" else []
    found = Preview.of(scene_from_config(composed(f"scene={name}", *path)))
    assert found.warnings == () and found.not_meant == ()


def test_the_published_scene():
    scene = scene_from_config(composed("scene=published_wheel"))
    assert scene.bilateral and scene.friction == 3.0 and scene.damping == 500.0
    assert scene.material.youngs_modulus == 15e6
    assert len(scene.initial_positions()) == pytest.approx(6005, rel=0.02)
    assert scene.frame_count == 561
    assert 1e3 * scene.speed == pytest.approx(12.0)


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
    for network, scene, words in (
        (blades, wheel, "scene.kind is wheel, whose height is free; a.ckpt was trained on pre"),
        (wheels, blade, "scene.kind is excavation, whose height is prescribed; a.ckpt was"),
    ):
        with pytest.raises(UserError, match=words):
            require_same_freedom(network, scene, "a.ckpt")
    require_same_freedom(blades, blade, "a.ckpt")
    stone = scene_from_config(composed("scene=stone"))
    with pytest.raises(UserError, match=r"scene.others has 1 further bodies, and a.ckpt knows one body"):
        require_same_freedom(blades, stone, "a.ckpt")
    require_same_freedom(wheels, wheel, "a.ckpt")


def test_a_body_from_the_command_line(tmp_path):
    (tmp_path / "path.csv").write_text("t,x,y,z,qx,qy,qz,qw\n0,0.3,0.3,0.1,0,0,0,1\n1,0.3,0.3,0.05,0,0,0,1\n")
    (tmp_path / "tool.obj").write_text(
        "v 0 0 0\nv 90 0 0\nv 0 90 0\nv 0 0 90\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
    )
    tool = ["scene/tool=mesh", "scene.tool.file=tool.obj", "scene.tool.scale=0.001"]
    short = ["scene.duration=0.02", "scene.bed.spacing=0.03", "output=run.h5"]
    done = sgns(tmp_path, "simulate", "scene=body", "scene.path=path.csv", *tool, *short)
    assert done.returncode == 0, done.stderr
    assert "mean force" in done.stdout
    assert Run(tmp_path / "run.h5").body_points.shape[1] == 4
    # Where the origin came to lie in the tool, and that nothing will happen.
    assert (
        "the path is that of the tool's centre of mass; around it the tool reaches from -22 to" in done.stdout
    )
    assert "the tool never touches soil: its lowest point stays 76.7 mm" in done.stdout + done.stderr


def test_a_datasets_warnings_come_once_for_each_kind():
    q = (0, 0, 0, 1)
    rows = [[(0.0, 0.2, 0.2, z, *q), (0.1, 0.205, 0.2, z, *q)] for z in (0.3, 0.2, 0.03)]
    base = {"kind": "body", "bed": {"size": [0.48, 0.4, 0.16], "spacing": 0.04}, "duration": 0.1}
    base["tool"] = {"shape": "box", "size": [0.1, 0.1, 0.08]}
    scenes = {f"run{number}": Scene.from_dict(base | {"path": path}) for number, path in enumerate(rows)}
    (line,) = warning_summary(scenes)
    assert line.startswith(
        "2 of 3 runs, such as run0: the tool never touches soil: its lowest point stays 260 mm"
    )
    assert warning_summary({"run2": scenes["run2"]}) == []
    # Tools that start at different places in the soil: no basis holds both.
    scenes["deep"] = Scene.from_dict(base | {"path": [(t, 0.2, 0.2, -0.04, *q) for t in (0.0, 0.1)]})
    _, still, buried, mixed = warning_summary(scenes)
    assert still.startswith("1 of 4 runs, such as deep: the tool does not move")
    assert buried.startswith("1 of 4 runs, such as deep: the tool is in the soil at the start")
    assert mixed.startswith("the runs do not start from the same particles")


# --- Path files as people have them ---------------------------------------------------------------------

ROW = "0.5,1,2,3,0,0,0,1"


@pytest.mark.parametrize(
    "text",
    [
        f"t,x,y,z,qx,qy,qz,qw\n{ROW}\n",
        f"{ROW}\n",
        f"\ufeffT, X, Y, Z, qx, qy, qz, qw,\r\n\r\n{ROW},\r\n,,,,,,,\r\n",
        f"# of a survey, 3 May\n# t,x,y,z,qx,qy,qz,qw\n{ROW} # start\n\n",
    ],
)
def test_path_files_with_blank_lines_commas_and_comments(tmp_path, text):
    (tmp_path / "path.csv").write_text(text, encoding="utf-8", newline="")
    assert read_path(tmp_path / "path.csv") == [[0.5, 1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty"),
        ("# nothing\n", "is empty"),
        (
            f"time,x,y,z,qx,qy,qz,qw\n{ROW}\n",
            "line 1 of .* is 'time,x,.*: it lacks t; the first line must be t,x,y",
        ),
        (f"t,x,y,z\n{ROW}\n", "it lacks qx, qy, qz, qw"),
        (f"t,x,y,z,qw,qx,qy,qz\n{ROW}\n", "is 't,x,y,z,qw,.* must stand in this order"),
        (f"t,x,y,z,qx,qy,qz,qw,v\n{ROW}\n", "in this order, and no others"),
        (ROW.replace(",", ";"), "line 1 of .* semicolons between them; they need commas"),
        (f"# mine\n{ROW}\n" + ROW.replace(",", "\t"), "line 3 of .* tabs between"),
        (f"{ROW}\n\n0.5,1\n", "line 3 of .*: 2 values instead of 8"),
        (f"{ROW}\n{ROW[:-1]}x\n", "line 2 of .* 'x' is not a number"),
    ],
)
def test_path_files_it_refuses(tmp_path, text, words):
    (tmp_path / "path.csv").write_text(text)
    with pytest.raises(UserError, match=words):
        read_path(tmp_path / "path.csv")


def test_a_path_file_that_is_not_there(tmp_path):
    with pytest.raises(UserError, match=r"cannot read .*nix\.csv: No such file or directory$"):
        read_path(tmp_path / "nix.csv")


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([f"0,{ROW[4:]}", f"0,{ROW[4:]}"], "line 5 of .*path.csv does not come after"),
        ([ROW, "1,1,2,3,0,0,0,2"], "quaternion in line 5 of .*path.csv is not of length 1"),
        (["0,1e14,2,3,0,0,0,1"], "line 4 of .*path.csv of the path holds"),
    ],
)
def test_what_is_wrong_with_poses_is_told_by_the_line_of_the_file(tmp_path, rows, words):
    (tmp_path / "path.csv").write_text("\n".join(["# of 3 May", "t,x,y,z,qx,qy,qz,qw", "", *rows]))
    with pytest.raises(SceneError, match=words):
        scene_from_data({"kind": "body", "path": str(tmp_path / "path.csv")})


def test_the_rows_of_a_map_are_no_lines_of_the_path(tmp_path):
    (tmp_path / "path.csv").write_text("0,0.2,0.3,0.2,0,0,0,1")
    (tmp_path / "map.csv").write_text("0,0\n0,0\n0,nan")
    data = {"kind": "body", "path": str(tmp_path / "path.csv"), "bed": {"surface": str(tmp_path / "map.csv")}}
    with pytest.raises(SceneError, match=r"^bed.surface .* in row 3, number 2$"):
        scene_from_data(data)


def test_a_further_body_has_its_path_from_a_file(tmp_path):
    file = tmp_path / "path.csv"
    data = {"others": [{"position": [0.2, 0.2, 0.2]}, {"motion": "path", "path": str(file)}]}
    file.write_text("t,x,y,z,qx,qy,qz,qw\n0,0.2,0.3,0.2,0,0,0,1\n0.5,0.3,0.3,0.2,0,0,0,1 # end\n")
    assert scene_from_data(data).others[1].path[1] == (0.5, 0.3, 0.3, 0.2, 0.0, 0.0, 0.0, 1.0)
    for text, error, words in (
        (
            "0,0.2\n",
            UserError,
            r"scene.others\[1\].path: line 1 of .*path.csv is '0,0.2': 2 values instead of 8",
        ),
        ("\n0,1e14,2,3,0,0,0,1", SceneError, r"line 2 of .*path.csv of scene.others\[1\].path holds"),
        (
            "\n0,1,2,3,0,0,0,2",
            SceneError,
            r"scene.others\[1\].path's quaternion in line 2 of .*path.csv is not of",
        ),
        (None, UserError, r"scene.others\[1\].path: cannot read .*path.csv: No such file"),
    ):
        file.unlink() if text is None else file.write_text(text)
        with pytest.raises(error, match=words):
            scene_from_data(data)


def test_numbers_in_another_unit_are_refused_before_the_run(tmp_path):
    """And not where a person says that they are meant."""
    (tmp_path / "path.csv").write_text("0,200,300,300,0,0,0,1\n0.1,205,300,300,0,0,0,1\n")
    asked = ["scene=body", "scene.path=path.csv", "scene.duration=0.1", "scene.bed.spacing=0.05"]
    refused = sgns(tmp_path, "simulate", *asked, "output=run.h5")
    assert refused.returncode == 2 and not (tmp_path / "run.h5").exists()
    assert "never touches soil" in refused.stderr and "look like millimetres" in refused.stderr
    assert refused.stderr.rstrip().endswith("if it is meant: limits.any_unit=true")
    done = sgns(tmp_path, "simulate", *asked, "limits.any_unit=true", "output=run.h5")
    assert done.returncode == 0 and "look like millimetres" in done.stderr + done.stdout
    scenes = {"far": scene_from_config(composed(*asked[:1], f"scene.path={tmp_path}/path.csv"))}
    with pytest.raises(UserError, match=r"far: .* look like millimetres"):
        warning_summary(scenes)
    assert len(warning_summary(scenes, any_unit=True)) == 1


# --- The surface of the bed from a file -----------------------------------------------------------------

HEIGHTS = np.array([[0.0, 0.01, 0.02], [0.03, 0.04, 0.05]])  # 2 along x, 3 along y


def write_heights(file: Path) -> None:
    if file.suffix == ".npy":
        np.save(file, HEIGHTS)
    elif file.suffix == ".tif":
        Image.fromarray(HEIGHTS.T[::-1].astype(np.float32)).save(file)
    else:
        np.savetxt(file, HEIGHTS, delimiter="," if file.suffix == ".csv" else " ", header="heights [m]")


@pytest.mark.parametrize("name", ["map.npy", "map.csv", "map.txt", "map.tif"])
def test_a_map_of_heights_is_read(name, tmp_path):
    write_heights(tmp_path / name)
    scene = scene_from_config(composed(f"scene.bed.surface={tmp_path / name}"))
    np.testing.assert_allclose(scene.bed.surface, HEIGHTS, atol=1e-7)
    assert scene_from_config(composed("scene.bed.surface=-12")).bed.surface == -12.0


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("none.npy", None, "No such file or directory"),
        ("map.png", b"x", "it is no map of heights in metres; allowed: .npy, .csv, .txt, .tif"),
        ("map.npy", b"x", "cannot read"),
        ("map.csv", b"0,1\n2", "cannot read"),
        ("map.csv", b"0,a\n2,3", "could not convert string 'a'"),
        ("map.tif", b"x", "cannot identify image file"),
    ],
)
def test_a_map_that_cannot_be_read(name, content, words, tmp_path):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError, match=words) as caught:
        scene_from_config(composed(f"scene.bed.surface={tmp_path / name}"))
    assert str(caught.value).startswith("scene.bed.surface: cannot read") and "\n" not in str(caught.value)


def test_maps_of_whole_numbers_or_objects_are_refused(tmp_path, monkeypatch):
    Image.fromarray(np.zeros((3, 3), np.uint8)).save(tmp_path / "map.tif")
    with pytest.raises(UserError, match="its heights are whole numbers, of no unit"):
        read_heights(tmp_path / "map.tif")
    Image.fromarray(np.zeros((400, 300), np.float32)).save(tmp_path / "map.tif")
    with pytest.raises(UserError, match="it holds 300 x 400 heights, at most 100000"):
        read_heights(tmp_path / "map.tif")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1000)
    with pytest.raises(UserError, match="at most 100000 heights are allowed; coarsen it"):
        read_heights(tmp_path / "map.tif")
    np.savez(tmp_path / "map.npz", np.zeros((3, 3)))
    with pytest.raises(UserError, match="it is an archive of arrays"):
        read_heights((tmp_path / "map.npz").rename(tmp_path / "map.npy"))
    np.save(tmp_path / "map.npy", np.array([[{}]], dtype=object), allow_pickle=True)
    with pytest.raises(UserError, match="allow_pickle=False"):
        read_heights(tmp_path / "map.npy")
    np.save(tmp_path / "map.npy", np.zeros(3))
    with pytest.raises(UserError, match=r"it holds float64 of shape \(3,\); a map of heights has rows"):
        read_heights(tmp_path / "map.npy")


@pytest.mark.parametrize(
    ("overrides", "angle"),
    [
        ([], 37.0),
        (["material=sand"], 37.0),
        (["material.youngs_modulus=2e6"], 37.0),
        (["material=lunar_simulant"], 45.0),
        (["material.friction_angle=40"], 40.0),
        (["material=lunar_simulant", "scene.friction_angle=30"], 30.0),
    ],
)
def test_a_chosen_soil_goes_before_the_wheels_own_friction(overrides, angle):
    asked = ["scene=wheel", *overrides]
    assert scene_from_config(composed(*asked), asked).material.friction_angle == angle
