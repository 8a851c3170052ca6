"""Poses in at any rate, wrench out: against the simulator, at 1 kHz, from another origin, and in other programs."""

from __future__ import annotations

import importlib.util
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

import mpm_warp
from mpm_warp.poses import about_y, rotate, sampled_poses
from sgns import Simulator, UserError
from sgns.coupling import BETWEEN, Coupling

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
FRAMES = 60


@pytest.fixture(scope="module")
def simulator() -> Simulator:
    return Simulator.pretrained("excavation")


@pytest.fixture(scope="module")
def cut(simulator: Simulator) -> np.ndarray:
    """Poses of a cut at 60 Hz, shape (FRAMES, 7)."""
    scene = mpm_warp.Scene.from_dict(simulator.scene)
    return replace(scene, depth=0.06, speed=0.12).body_poses()[:FRAMES]


def at(cut: np.ndarray, times: np.ndarray) -> np.ndarray:
    """The cut's poses at some times."""
    return sampled_poses(np.column_stack([np.arange(len(cut)) / 60, cut]), times)


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(Path(name).stem, EXAMPLES / name)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_at_the_frames_it_is_the_simulator(simulator: Simulator, cut: np.ndarray) -> None:
    force = simulator.rollout(cut).force
    soil = Coupling(simulator)
    first = soil.reset(cut[0], time=3.0)
    assert not first.force.any() and not first.torque.any()
    for i in range(1, FRAMES):
        wrench = soil.step(3.0 + i / 60, cut[i])
        np.testing.assert_allclose(wrench.force, force[i], atol=0.1)
        np.testing.assert_allclose(wrench.torque, soil.state.torque)
    assert soil.state.frame == FRAMES - 1


@pytest.mark.parametrize("rate", [1000.0, 25.0])
def test_at_any_rate_the_soil_takes_the_same_frames(
    rate: float, simulator: Simulator, cut: np.ndarray
) -> None:
    """The cut is straight between frames, so poses in between lead to the same frames."""
    times = np.arange(0.0, (FRAMES - 1) / 60, 1.0 / rate)
    soil = Coupling(simulator)
    soil.reset(cut[0])
    for t, pose in zip(times, at(cut, times), strict=True):
        wrench = soil.step(t, pose)
    assert soil.state.frame == int(times[-1] * 60 + 1e-6)
    here = simulator.rollout(at(cut, np.arange(soil.state.frame + 1) / 60))
    # Between two poses of a slow controller the corners of the path are cut.
    np.testing.assert_allclose(wrench.force, here.force[-1], atol=0.5 if rate > 60 else 20.0)


def test_between_frames_it_is_held_interpolated_or_extrapolated(
    simulator: Simulator, cut: np.ndarray
) -> None:
    found: dict[str, np.ndarray] = {}
    times = np.arange(FRAMES * 4) / 240  # four control steps a frame
    for between in BETWEEN:
        soil = Coupling(simulator, between)
        soil.reset(cut[0])
        found[between] = np.array([soil.step(t, p).force for t, p in zip(times, at(cut, times), strict=True)])
    hold = found["hold"].reshape(FRAMES, 4, 3)
    assert (hold == hold[:, :1]).all() and (np.diff(hold[:, 0, 0]) != 0).any()
    before = np.concatenate([hold[:1], hold[:-1]])[:, :1]
    share = np.arange(4)[:, None] / 4
    line = found["interpolate"].reshape(FRAMES, 4, 3)
    np.testing.assert_allclose(line, before + share * (hold[:, :1] - before), atol=1e-9)
    ahead = found["extrapolate"].reshape(FRAMES, 4, 3)
    np.testing.assert_allclose(ahead, hold[:, :1] + (share + 0.5) * (hold[:, :1] - before), atol=1e-9)


@pytest.mark.parametrize(("between", "most"), [("hold", 0.04), ("interpolate", 0.06), ("extrapolate", 0.04)])
def test_energy_at_1_kHz_is_that_at_60_Hz(
    between: str, most: float, simulator: Simulator, cut: np.ndarray
) -> None:
    """The work of the wrench that a controller feels against that of the frames' mean forces."""
    soil = Coupling(simulator, between)
    soil.reset(cut[0])
    times = np.arange(0.0, (FRAMES - 1) / 60, 1e-3)
    poses = at(cut, times)
    force = np.array([soil.step(t, pose).force for t, pose in zip(times, poses, strict=True)])
    felt = -(force[:-1] * np.diff(poses[:, :3], axis=0)).sum()
    rollout = simulator.rollout(at(cut, np.arange(FRAMES - 1) / 60))
    truth = -(rollout.force[1:] * np.diff(rollout.poses[:, :3], axis=0)).sum()
    assert truth > 1.0
    assert felt == pytest.approx(truth, rel=most)


def test_another_origin_moves_pose_and_torque(simulator: Simulator, cut: np.ndarray) -> None:
    origin, turn = np.array([0.02, 0.01, 0.2]), about_y(0.3)
    tilted = np.column_stack([cut[:, :3], np.tile(turn, (FRAMES, 1))])
    offset = rotate(turn, origin)
    pinned = tilted + np.pad(offset, (0, 4))
    soil = Coupling(simulator, origin=origin)
    soil.reset(pinned[0])
    for i in range(1, 40):
        wrench = soil.step(i / 60, pinned[i])
    np.testing.assert_allclose(soil.state.pose, tilted[39], atol=1e-12)
    np.testing.assert_allclose(wrench.force, soil.state.force)
    np.testing.assert_allclose(wrench.torque, soil.state.torque - np.cross(offset, wrench.force))
    assert np.abs(wrench.torque - soil.state.torque).max() > 0.1


def test_the_first_pose_may_come_with_the_first_step(simulator: Simulator, cut: np.ndarray) -> None:
    soil = Coupling(simulator)
    soil.reset(time=7.0)
    for i in range(3):
        soil.step(7.0 + (i + 0.5) / 60, cut[i])
    assert soil.state.frame == 2


def test_values_that_come_before_the_first_pose_are_kept(
    simulator: Simulator, cut: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[Any] = []
    soil, reset = Coupling(simulator), simulator.reset

    def told(pose: Any = None, values: Any = None) -> Any:
        given.append(values)
        return reset(pose, values=values)

    monkeypatch.setattr(simulator, "reset", told)
    soil.reset(values=simulator.scene)
    soil.step(0.0, cut[0])
    assert given == [simulator.scene] * 2


def test_most_steps_take_microseconds(simulator: Simulator, cut: np.ndarray) -> None:
    """Only those in which a frame is due cost a step of the network; of the others even a busy machine does 20 in the
    time of two milliseconds."""
    soil = Coupling(simulator)
    soil.reset(cut[0])
    spent = []
    for i in range(500):
        begin = time.perf_counter()
        soil.step(i / 1000, cut[0])
        spent.append(time.perf_counter() - begin)
    assert np.median(spent) < 1e-4


def test_wrong_use_is_refused_and_changes_nothing(simulator: Simulator, cut: np.ndarray) -> None:
    soil = Coupling(simulator)
    soil.reset(cut[0])
    soil.step(0.1, cut[5])
    for message, arguments in {
        "the time is 0.05; .* not before the last one, 0.1 s; to begin again: reset": (0.05, cut[0]),
        "the time is nan": (np.nan, cut[0]),
        "the time is 'soon'": ("soon", cut[0]),
        "needs x, y, z": (0.2, cut[0, :3]),
    }.items():
        with pytest.raises(UserError, match=message):
            soil.step(*arguments)
    for message, again in {
        "the time is nan": {"time": np.nan},
        "the time is -inf; it must be a finite number": {"time": -np.inf},
        "values is a int": {"values": 3},
    }.items():
        with pytest.raises(UserError, match=message):
            soil.reset(cut[0], **again)
    assert soil.time == 0.1 and soil.state.frame == 6 and simulator.save().frame == 6
    assert soil.pose is not None and (soil.pose == cut[5]).all()
    with pytest.raises(UserError, match="allowed: hold, interpolate, extrapolate"):
        Coupling(simulator, "spline")
    with pytest.raises(UserError, match=r"origin has shape \(2,\)"):
        Coupling(simulator, origin=(0.0, 1.0))


def test_wheels_are_refused() -> None:
    wheel: Any = SimpleNamespace(predicts_body=True)
    with pytest.raises(UserError, match="a coupling needs a network of a tool on a prescribed path"):
        Coupling(wheel)


def test_ros_messages_become_poses_and_wrenches(simulator: Simulator, cut: np.ndarray) -> None:
    node = example("ros2_node.py")
    assert "rclpy" not in sys.modules
    core, force = node.Answers(Coupling(simulator)), simulator.rollout(cut).force
    for _ in range(2):  # the second time the stamps go back: a fresh bed
        for i in range(40):
            reply = core.answer(node.message(5.0 + i / 60, cut[i]), node.message())
    found = reply.wrench.force
    np.testing.assert_allclose([found.x, found.y, found.z], force[39], atol=0.1)
    assert reply.header.stamp.sec == 5 and reply.header.frame_id == "bed"


@pytest.mark.parametrize(("file", "exporter"), [("fmi2.py", "pythonfmu"), ("fmi3.py", "pythonfmu3")])
def test_an_fmu_gives_the_forces_of_the_simulator(
    tmp_path: Path, simulator: Simulator, cut: np.ndarray, file: str, exporter: str
) -> None:
    builder = pytest.importorskip(exporter).FmuBuilder
    fmpy = pytest.importorskip("fmpy")
    folder = EXAMPLES / "fmu"
    fmu = builder.build_FMU(folder / file, dest=tmp_path, project_files=[folder / "soil.py"])
    assert fmpy.read_model_description(str(fmu)).fmiVersion[0] == file[3]
    names = ["x", "y", "z", "qx", "qy", "qz", "qw"]
    times = np.arange(41) / 60
    table: Any = np.array(
        [(t, *pose) for t, pose in zip(times, cut[:41], strict=True)],
        dtype=[(n, float) for n in ["time", *names]],
    )
    outputs = ["Fx", "Fy", "Fz", "Tx", "Ty", "Tz"]
    found = fmpy.simulate_fmu(
        str(fmu),
        stop_time=40 / 60,
        step_size=1 / 60,
        output_interval=1 / 60,
        input=table,
        output=outputs,
        validate=True,
    )
    force = np.column_stack([found[name] for name in outputs[:3]])
    # What is known at the beginning of a step is there at its end.
    np.testing.assert_allclose(force[1:], simulator.rollout(cut[: len(force) - 1]).force, atol=0.1)
