"""Environments: many beds step as one simulator does; gymnasium's checks; what is rewarded."""

from __future__ import annotations

import copy
import runpy
import sys
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import yaml
from gymnasium.utils.env_checker import check_env

import mpm_warp
from mpm_warp.poses import about_y
from sgns import Simulator, UserError
from sgns.data.dataset import Dataset
from sgns.envs import Beds, Dig, DigEnvs, DriveEnvs
from sgns.reduction.reduce import reduce_dataset
from sgns.train.command import train
from sgns_testing.runs import make_run
from sgns_testing.tiny import BRIEF, FIT, MODEL, POLYNOMIAL, REDUCTION
from sgns_testing.trained import TrainedKinds

ROOT = Path(__file__).resolve().parents[2]
WHEEL = mpm_warp.Wheel(bed=mpm_warp.Bed(size=(0.4, 0.2, 0.08), spacing=0.04), settle=0.05, duration=0.3)
SHIFT = np.array([1e-3, 0, 0, 0, 0, 0, 0])


@pytest.fixture(scope="module")
def cutter() -> Simulator:
    return Simulator.pretrained("excavation")


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> TrainedKinds:
    """Of two loads and slips."""
    folder = tmp_path_factory.mktemp("wheels")
    known = {"n": len(WHEEL.initial_positions()), "arrangement_hash": WHEEL.arrangement_hash}
    split = {"train": ["a", "b", "c"], "validation": ["d"], "test": ["e"]}
    for seed, name in enumerate("abcde"):
        scene = replace(WHEEL, load=60.0 + 40.0 * (seed % 2), slip=0.2 + 0.2 * (seed % 2)).to_dict()
        make_run(folder / "runs" / f"{name}.h5", frames=14, seed=seed, scene=scene, **known)
    (folder / "dataset.yaml").write_text(yaml.safe_dump({"name": "wheels", "split": split}))
    data = reduce_dataset(Dataset.open(folder), REDUCTION, progress=False)
    pose = MODEL | {"context": ["load", "slip"], "body_nodes": "pose"}
    models = {"network": pose, "points": pose | {"body_nodes": "points"}, "polynomial": POLYNOMIAL}
    for name, model in models.items():
        training = FIT if name == "polynomial" else BRIEF
        train(data, num_modes=4, model=model, training=training, output=folder / name)
    return TrainedKinds(data, folder)


def paths(simulator: Simulator, frames: int = 45) -> np.ndarray:
    """Three tools: one cuts, one stops on the way, one creeps; shape (3, frames, 7)."""
    cut = mpm_warp.Scene.from_dict(simulator.scene).body_poses()[:frames]
    stops = cut[np.minimum(np.arange(frames), 5)]
    creeps = cut[:1] + np.outer(np.arange(frames), [2e-4, 0, -1e-5, 0, 0, 0, 0])
    return np.stack([cut, stops, creeps])


def agree(beds: Beds, simulators: list[Simulator], path: np.ndarray) -> None:
    for one, poses in zip(simulators, path, strict=True):
        one.reset(poses[0])
    beds.reset(np.ones(len(path), bool), path[:, 0])
    for poses in path.transpose(1, 0, 2)[1:]:
        beds.step(poses)
        states = [one.step(pose) for one, pose in zip(simulators, poses, strict=True)]
        for name, atol in (("force", 2e-2), ("torque", 2e-3), ("pose", 1e-6)):
            np.testing.assert_allclose(getattr(beds, name), [getattr(s, name) for s in states], atol=atol)
        np.testing.assert_allclose(beds.latent[:, -1], [state.latent for state in states], atol=1e-5)


def test_beds_side_by_side_are_stepped_as_by_simulators(cutter: Simulator) -> None:
    """Also those whose soil rests because the tool stops or creeps."""
    agree(Beds(cutter, 3, cutter.body_points), [copy.copy(cutter) for _ in range(3)], paths(cutter))


@pytest.mark.parametrize("kind", ["network", "points", "polynomial"])
def test_beds_under_wheels_are_stepped_as_by_simulators(kind: str, wheels: TrainedKinds) -> None:
    one = wheels.simulator(kind)
    path = np.stack([wheels.run.pose, wheels.run.pose + SHIFT])
    agree(Beds(one, 2, one.body_points), [copy.copy(one), copy.copy(one)], path)


def test_beds_left_out_stay_as_they_are(cutter: Simulator) -> None:
    path, beds = paths(cutter), Beds(cutter, 3, cutter.body_points)
    beds.reset(np.ones(3, bool), path[:, 0])
    for t in range(1, 20):
        beds.step(path[:, t])
    whole, force = beds.latent.clone(), beds.force.copy()
    beds.step(path[:, 20], np.array([True, False, False]))
    assert (beds.latent[1:] == whole[1:]).all() and (beds.force[1:] == force[1:]).all()
    assert (beds.latent[0] != whole[0]).any()
    beds.reset(np.array([False, True, False]), path[1:2, 0])
    assert (beds.latent[1] == beds.start).all() and not beds.force[1].any() and beds.force[0].any()


def test_half_precision_is_near(cutter: Simulator, wheels: TrainedKinds) -> None:
    path, force = paths(cutter)[:1], []
    for half in (False, True):
        beds = Beds(cutter, 1, cutter.body_points, half)
        beds.reset(np.ones(1, bool), path[:, 0])
        for t in range(1, path.shape[1]):
            beds.step(path[:, t])
        force.append(beds.force[0])
    np.testing.assert_allclose(force[1], force[0], atol=0.05 * np.abs(force[0]).max())
    assert (force[0] != force[1]).any()
    polynomial = wheels.simulator("polynomial")
    with pytest.raises(UserError, match="half=True is for networks"):
        Beds(polynomial, 1, polynomial.body_points, half=True)


def test_gymnasium_finds_nothing_wrong(wheels: TrainedKinds) -> None:
    check_env(gymnasium.make("sgns/Dig-v0", seconds=0.3).unwrapped)
    drive = {"simulator": wheels.simulator("network"), "scene": WHEEL, "seconds": 0.3}
    check_env(gymnasium.make("sgns/Drive-v0", **drive).unwrapped)


def test_they_are_made_by_their_names(cutter: Simulator) -> None:
    many = gymnasium.make_vec(
        "sgns/Dig-v0", num_envs=3, vectorization_mode="vector_entry_point", simulator=cutter, seconds=0.2
    )
    assert isinstance(many.unwrapped, DigEnvs)
    assert many.observation_space.shape == (3, 47) and many.action_space.shape == (3, 2)
    seen, _ = many.reset(seed=1)
    assert many.observation_space.contains(seen)


def test_many_are_as_one_alone_and_begin_again_after_the_last_step(cutter: Simulator) -> None:
    settings = {"simulator": cutter, "seconds": 0.3, "frames_per_action": 6}
    many, one = DigEnvs(2, **settings), Dig(**settings)
    target = {"target": np.where(many.profile.x < 0.3, -0.03, 0.0)}
    first, _ = many.reset(options=target)
    alone, _ = one.reset(options=target)
    np.testing.assert_allclose(first[0], alone, atol=1e-6)
    actions = np.array([[0.5, -1.0], [0.0, -0.5]])
    for step in range(3):
        seen, reward, ended, over, _ = many.step(actions)
        alone, earned, *_ = one.step(actions[0])
        np.testing.assert_allclose(seen[0], alone, atol=1e-4)
        assert reward[0] == pytest.approx(earned, abs=1e-4)
        assert not ended.any() and (over == (step == 2)).all()
    again, reward, _, over, _ = many.step(actions)  # a new episode; the actions are not used
    assert not reward.any() and not over.any() and (again[:, 0] == 1.0).all()
    assert not many.beds.force.any()


def test_digging_the_trench_earns_and_standing_does_not(cutter: Simulator) -> None:
    envs = DigEnvs(2, simulator=cutter, seconds=3.6)
    x = envs.profile.x
    envs.reset(options={"target": -np.clip(np.minimum(x - 0.12, 0.32 - x), 0.0, 0.05)})
    earned, work = np.zeros(2), np.zeros(2)
    for step in range(envs.length):
        down = -0.5 if step < 6 else 1.0 if step > 30 else 0.0
        _, reward, _, _, info = envs.step(np.array([[0.6, down], [-1.0, 0.0]]))
        earned, work = earned + reward, work + info["work"]
    assert earned[0] > 0.4 and work[0] > 10.0
    assert abs(earned[1]) < 0.01
    assert earned[0] == pytest.approx(1.0 - envs.error[0] / envs.to_dig[0] - 0.001 * work[0], abs=1e-6)


def test_the_profile_is_that_of_the_surface(cutter: Simulator) -> None:
    """To the roughness of the highest particles; a bed at rest is flat."""
    envs = DigEnvs(1, simulator=cutter)
    assert np.abs(envs.profile(envs.beds.latent[:, -1])).max() < 1e-6
    scene = replace(mpm_warp.Scene.from_dict(cutter.scene), depth=0.05, speed=0.1)
    rollout = cutter.rollout(scene.body_poses())
    surface = rollout.surface()
    middle = np.abs(surface.y - 0.3) < 0.04
    seen = envs.profile(envs.beds.latent.new_tensor(rollout.latent[None, -1]))[0]
    heights = np.interp(envs.profile.x, surface.x, surface.z[:, middle].mean(1))
    assert np.corrcoef(seen, heights)[0, 1] > 0.9
    assert np.abs(seen - heights).mean() < 0.015


def test_driving_is_rewarded_by_the_work_of_the_pull(wheels: TrainedKinds) -> None:
    envs = DriveEnvs(3, simulator=wheels.simulator("network"), scene=WHEEL, seconds=0.3)
    assert envs.simulator.context_keys == ("load", "slip")
    loads = []
    for _ in range(2):
        seen, _ = envs.reset()
        assert np.isfinite(seen).all()
        loads.append(envs.beds.context[:, 0].copy())
        before = envs.beds.pose.copy()
        _, reward, _, _, info = envs.step(np.array([[-1.0], [0.0], [1.0]]))
        np.testing.assert_allclose(envs.beds.context[:, 1], [0.2, 0.3, 0.4])
        way = envs.beds.pose[:, 0] - before[:, 0]
        np.testing.assert_allclose(way, 0.00195 * np.array([0.8, 0.7, 0.6]), rtol=1e-9)
        turn = 0.00195 / envs.radius
        np.testing.assert_allclose(envs.beds.pose[:, 3:], np.tile(about_y(turn), (3, 1)), atol=1e-12)
        unit = envs.beds.context[:, 0] * envs.radius
        np.testing.assert_allclose(reward, (info["pull_work"] - 0.2 * info["drive_work"]) / unit)
    assert np.ptp(loads) > 1.0 and np.min(loads) >= 60.0 and np.max(loads) <= 100.0
    assert (loads[0] != loads[1]).all()


def test_wrong_use_is_refused_in_one_line(cutter: Simulator, wheels: TrainedKinds) -> None:
    for message, call in {
        "needs a network of a tool on a prescribed path": lambda: DigEnvs(
            1, simulator=wheels.simulator("network")
        ),
        "needs a network of a wheel": lambda: DriveEnvs(1, simulator=cutter),
        "train one: sgns train dataset=quick_wheel": lambda: DriveEnvs(1),
        "num_envs is 0; it must be": lambda: DigEnvs(0, simulator=cutter),
        "at least one action": lambda: DigEnvs(1, simulator=cutter, seconds=0.01),
        "call reset": lambda: DigEnvs(1, simulator=cutter).step(np.zeros((1, 2))),
        "particles": lambda: DigEnvs(1, simulator=cutter, scene=mpm_warp.Excavation()),
        "no pretrained checkpoint|no checkpoint": lambda: DigEnvs(1, simulator="nothing"),
    }.items():
        with pytest.raises(UserError, match=message):
            call()
    envs = DigEnvs(1, simulator=cutter)
    with pytest.raises(UserError, match="heights above 0, or digs nothing"):
        envs.reset(options={"target": np.zeros(20)})
    envs.reset(seed=0)
    with pytest.raises(UserError, match=r"array of actions has shape \(2,\)"):
        envs.step(np.zeros(2))


def test_without_gymnasium_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(UserError, match=r"pip install 'sgns\[rl\]'"):
        runpy.run_path(str(ROOT / "src" / "sgns" / "envs.py"))
