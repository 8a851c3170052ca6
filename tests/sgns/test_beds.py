"""Many beds step as one simulator does."""

from __future__ import annotations

import copy

import numpy as np
import pytest

import mpm_warp
from sgns import Simulator, UserError
from sgns.beds import Beds
from sgns_testing.trained import TrainedKinds, driven_wheels

SHIFT = np.array([1e-3, 0, 0, 0, 0, 0, 0])


@pytest.fixture(scope="module")
def cutter() -> Simulator:
    return Simulator.pretrained("excavation")


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> TrainedKinds:
    return driven_wheels(tmp_path_factory.mktemp("wheels"), "network", "points", "polynomial")


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


def test_beds_of_a_simulator_by_the_clock_never_rest(cutter: Simulator) -> None:
    path = paths(cutter)[1:2]
    clock = Simulator.pretrained("excavation", rate_independent=False)
    agree(Beds(clock, 1, clock.body_points), [clock], path)
    assert np.abs(clock.rollout(path[0]).latent[-1] - cutter.rollout(path[0]).latent[-1]).max() > 1e-4


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
