"""Environments: gymnasium's checks, and what is rewarded."""

from __future__ import annotations

import runpy
import sys
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import mpm_warp
from mpm_warp.poses import about_y
from sgns import Simulator, UserError
from sgns.envs import Dig, DigEnvs, DriveEnvs, SoilEnvs
from sgns_testing.trained import WHEEL, TrainedKinds, driven_wheels

ROOT = Path(__file__).resolve().parents[2]
GROUSERS = {"grousers": 8, "grouser_height": 0.01, "grouser_thickness": 0.003}


@pytest.fixture(scope="module")
def cutter() -> Simulator:
    return Simulator.pretrained("excavation")


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> TrainedKinds:
    return driven_wheels(tmp_path_factory.mktemp("wheels"), "network")


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


def test_the_network_is_told_the_numbers_of_the_scene(wheels: TrainedKinds) -> None:
    class Plain(SoilEnvs):
        free_tool, actions = True, 1

    envs = Plain(2, wheels.simulator("network"), replace(WHEEL, load=77.0, slip=0.3))
    assert envs.beds.context.tolist() == [[77.0, 0.3]] * 2


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
    again, reward, _, over, info = many.step(actions)  # a new episode; the actions are not used
    assert not reward.any() and not info["work"].any() and not over.any() and (again[:, 0] == 1.0).all()
    assert not many.beds.force.any()


def test_of_a_list_of_seeds_each_counts(cutter: Simulator) -> None:
    envs, targets = DigEnvs(2, simulator=cutter, seconds=0.2), []
    for seed in ([1, 2], [1, 2], [1, 3], [2, 2], 1, 1):
        envs.reset(seed=seed)
        targets.append(envs.target.copy())
    same = [(one == targets[0]).all() for one in targets]
    assert same == [True, True, False, False, False, False] and (targets[4] == targets[5]).all()
    for seed, message in {
        (): "a list of 2",
        (1,): "a list of 2",
        (1, -1): "whole number of 0 or more",
    }.items():
        with pytest.raises(UserError, match=message):
            envs.reset(seed=list(seed))


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


def test_a_wheel_goes_and_sinks_as_the_scene_says(wheels: TrainedKinds) -> None:
    """Of a wheel slower than its way slip has two meanings, and grousers reach deeper than the rim."""
    for scene in (
        replace(WHEEL, slip=-0.5, **GROUSERS),
        replace(WHEEL, slip=0.2, travel_speed=2.0 * WHEEL.rim_speed, **GROUSERS),
    ):
        envs = DriveEnvs(1, simulator=wheels.simulator("network"), scene=scene, seconds=0.3)
        envs.least, envs.most = -0.5, 0.5
        seen, _ = envs.reset()
        assert seen[0, 3] * scene.diameter == pytest.approx(scene.sinkage(envs.beds.pose)[0], abs=1e-6)
        before = envs.beds.pose[0, 0]
        envs.step(np.array([[-1.0]]))
        assert scene.slip == -0.5
        assert envs.beds.pose[0, 0] - before == pytest.approx(scene.speed * envs.frames * envs.frame_time)


def test_wrong_use_is_refused_in_one_line(cutter: Simulator, wheels: TrainedKinds) -> None:
    for message, call in {
        "needs a network of a tool on a prescribed path": lambda: DigEnvs(
            1, simulator=wheels.simulator("network")
        ),
        "needs a network of a wheel": lambda: DriveEnvs(1, simulator=cutter),
        "train one: sgns train dataset=quick_wheel": lambda: DriveEnvs(1),
        "num_envs is 0; it must be": lambda: DigEnvs(0, simulator=cutter),
        "at least one action": lambda: DigEnvs(1, simulator=cutter, seconds=0.01),
        "seconds is nan": lambda: DigEnvs(1, simulator=cutter, seconds=np.nan),
        "seconds is '4'": lambda: DigEnvs(1, simulator=cutter, seconds="4"),
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
