"""What the controls of a page do to a tool, and what a page is told of it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from mpm_warp import Bed, Body, Excavation, MeshBody, Scene, Wheel
from mpm_warp.poses import rotate
from sgns.config import UserError
from sgns.data.dataset import Dataset
from sgns.data.run import Run
from sgns.model.checkpoint import load_surrogate, pretrained_file
from sgns.model.training_range import TrainingRange
from sgns.reduction.reduce import reduce_dataset
from sgns.train.command import train
from sgns.view.controls import ToolControls, WheelControls, rake_of
from sgns.view.shown import FIELDS, Drive, driven_scene
from sgns_testing.meshes import BOX_FACES, box_corners, write_obj
from sgns_testing.runs import make_run
from sgns_testing.tiny import BRIEF, MODEL, REDUCTION, make_dataset

WIDE = TrainingRange({}, {})
WHEEL = Wheel(bed=Bed(size=(0.4, 0.19, 0.06), spacing=0.03, particles_per_cell=1.0, headroom=0.1), width=0.09)


def tip(controls: ToolControls, pose: np.ndarray) -> np.ndarray:
    return pose[:3] + rotate(pose[3:], controls.scene.body.tip)


def test_a_tool_goes_where_the_sliders_say_and_no_faster() -> None:
    controls = ToolControls(Excavation(rake=12.0), WIDE, 60.0)
    first = tip(controls, controls.pose())
    assert first == pytest.approx([0.08, 0.3, 0.00665])
    controls.hear({"way": 1.0, "depth": 0.05, "rake": 22.0, "speed": 0.1})
    path = np.array([controls.moved() for _ in range(180)])
    tips = np.array([tip(controls, pose) for pose in path])
    assert tips[-1] == pytest.approx([first[0] + 0.1 * 3.0, 0.3, -0.05], abs=0.01)
    assert rake_of(path[-1, 3:]) == pytest.approx(22.0, abs=0.1)
    moved = np.abs(np.diff(tips, axis=0)) * 60.0
    assert moved.max() <= 0.1 + 1e-9
    controls.hear({"way": 0.0})
    for _ in range(30):
        controls.moved()
    assert tip(controls, controls.moved()) == pytest.approx(tip(controls, controls.pose()))
    controls.reset()  # the rake is that of the slider
    assert rake_of(controls.pose()[3:]) == pytest.approx(22.0)
    assert tip(controls, controls.pose()) == pytest.approx(first)


def test_a_braked_wheel_goes_as_its_scene_says() -> None:
    for wheel in (replace(WHEEL, slip=-0.5), replace(WHEEL, travel_speed=2.0 * WHEEL.rim_speed)):
        controls = WheelControls(wheel, WIDE, 60.0)
        controls.hear({"way": 1.0})
        path = np.array([controls.moved() for _ in range(20)])
        assert wheel.slip == controls.wanted["slip"] == -0.5
        assert 60.0 * (path[-1, 0] - path[-2, 0]) == pytest.approx(wheel.speed)


def test_a_second_cut_lifts_goes_back_and_cuts_to_the_same_depth() -> None:
    controls = ToolControls(Excavation(), WIDE, 60.0)
    controls.hear({"way": 1.0, "depth": 0.04, "speed": 0.1})
    for _ in range(150):
        controls.moved()
    furthest = tip(controls, controls.pose())[0]
    controls.hear({"way": 0.0})
    controls.cut_again()
    tips = []
    while controls.plan:
        tips.append(tip(controls, controls.moved()))
        assert len(tips) < 2000
    way = np.array(tips)
    assert way[:, 0].min() == pytest.approx(0.08, abs=2e-3) and way[:, 2].min() == pytest.approx(
        -0.04, abs=2e-3
    )
    back = way[: way[:, 0].argmin()]
    assert (back[back[:, 0] < furthest - 0.01, 2] > 0.0).all()
    assert way[-1, 0] > furthest and way[-1, 2] > 0.0
    controls.cut_again()
    controls.moved()
    controls.hear({"way": -1.0})  # the person takes over
    assert controls.plan == []


def test_a_mesh_comes_from_a_run(tmp_path: Path) -> None:
    mesh = MeshBody(file=str(write_obj(tmp_path / "box.obj", box_corners((0.05, 0.06, 0.07)), BOX_FACES)))
    scene = Body(bed=Bed(size=(0.4, 0.2, 0.16), spacing=0.04), tool=mesh, motion="passes", duration=0.1)
    simulator = SimpleNamespace(
        scene=scene.to_dict(), predicts_body=False, arrangement_hash=scene.arrangement_hash, frame_rate=60.0
    )
    with pytest.raises(UserError, match=r"is a mesh, .* sgns view checkpoint=best.ckpt run=run.h5"):
        driven_scene(simulator, None, "best.ckpt")
    run = SimpleNamespace(scene=scene.to_dict(), meshes=[mesh.mesh], path=Path("run.h5"))
    found = driven_scene(simulator, run, "best.ckpt")
    assert found.mesh is not None and len(found.mesh[1]) == 2 * len(BOX_FACES)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two networks that are told a wheel's load."""
    folder = tmp_path_factory.mktemp("wheels")
    same = {"n": len(WHEEL.stored), "arrangement_hash": WHEEL.arrangement_hash}
    make_dataset(folder, **same, scene=WHEEL.to_dict())
    for seed, file in enumerate(sorted((folder / "runs").glob("*.h5"))):
        file.unlink()
        make_run(file, frames=14, seed=seed, **same, scene=WHEEL.to_dict() | {"load": 60.0 + 10.0 * seed})
    data = reduce_dataset(Dataset.open(folder), REDUCTION, progress=False)
    model, training = MODEL | {"context": ["load"]}, BRIEF | {"members": 2}
    train(data, num_modes=4, model=model, training=training, output=folder / "best")
    return folder / "best" / "best.ckpt"


# The synthetic runs say that they are of a wheel with a blade.
DRIVEN = SimpleNamespace(scene=WHEEL.to_dict(), meshes=[None], path=Path("run.h5"))


def test_a_wheel_is_driven_by_speed_slip_and_load(wheel: Path, tmp_path: Path) -> None:
    drive = Drive(load_surrogate(wheel), DRIVEN, checkpoint=wheel)
    about = drive.about()
    assert about["wheel"] and about["forces"][0] == "drawbar pull Fx"
    assert [one["key"] for one in about["sliders"]] == ["speed", "slip", "load"]
    assert about["sliders"][2]["trained"] == (60.0, 90.0)  # of the training runs
    with pytest.raises(UserError, match="a wheel makes no cuts"):
        drive.controls.cut_again()
    drive.controls.hear({"way": 1.0, "slip": 0.5, "speed": drive.controls.sliders["speed"].high})
    drive.record()
    for _ in range(6):
        drive.step()
    light = dict(zip(FIELDS, np.frombuffer(drive.frame(), "<f4").tolist(), strict=False))
    assert light["frame"] == 6 and light["sinkage"] != 0.0
    assert all(light[f"spread{i}"] > 0.0 for i in range(3))  # it is an ensemble
    speed, angle = drive.controls.speed, drive.controls.angle
    before = drive.kept[-1]
    drive.controls.hear({"load": 85.0})
    drive.step()
    assert drive.kept[-1].pose[0] - before.pose[0] == pytest.approx(0.5 * drive.controls.speed / 60.0)
    assert drive.controls.angle > angle and speed > 0.0
    assert drive.values["load"] == 85.0 and drive.count == 7
    # The soil went on from where it was.
    assert np.abs(drive.kept[-1].latent - before.latent).max() < 0.1 * np.abs(before.latent).max()
    drive.write(drive.recorded(tmp_path / "wheel.h5"), tmp_path / "wheel.h5")
    with Run(tmp_path / "wheel.h5") as run:
        assert run.frame_count == 8 and run.force_spread is not None and run.scene["load"] == 85.0


def test_a_heavier_wheel_is_told_to_the_network(wheel: Path) -> None:
    forces = []
    for load in (60.0, 90.0):
        drive = Drive(load_surrogate(wheel), DRIVEN)
        drive.controls.hear({"load": load})
        drive.reset()
        drive.step()
        forces.append(drive.kept[-1].force)
    assert math.dist(*forces) > 0.0


def test_the_tool_of_the_run_is_driven(tmp_path: Path) -> None:
    surrogate = load_surrogate(pretrained_file("excavation"))
    scene = Scene.from_dict(surrogate.card["scene"])
    narrow = replace(scene, blade=replace(scene.blade, width=0.2))
    drive = Drive(surrogate, SimpleNamespace(scene=narrow.to_dict(), meshes=[None], path=Path("run.h5")))
    drive.record()
    drive.step()
    drive.write(drive.recorded(tmp_path / "narrow.h5"), tmp_path / "narrow.h5")
    with Run(tmp_path / "narrow.h5") as run:
        assert np.ptp(run.body_points[1, :, 1]) == pytest.approx(0.2)


def test_a_record_changes_nothing_of_the_soil(wheel: Path) -> None:
    """The numbers that are told change right after it has begun."""
    latents = []
    for recording in (False, True):
        drive = Drive(load_surrogate(wheel), DRIVEN)
        drive.controls.hear({"way": 1.0})
        for _ in range(6):
            drive.step()
        if recording:
            drive.record()
        drive.controls.hear({"load": 85.0})
        drive.step()
        latents.append(drive.kept[-1].latent)
    np.testing.assert_array_equal(*latents)
