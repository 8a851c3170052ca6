"""A wheel: its way is prescribed, its height follows from the network."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch

from mpm_warp.poses import in_world_frame
from sgns.config import UserError
from sgns.model.features import nearest_rigid
from sgns.train.command import train
from sgns_testing.tiny import BRIEF, MODEL
from sgns_testing.trained import TrainedKinds

KINDS = {
    "pose": {},
    "points": {"body_nodes": "points"},
    "free": {"body_nodes": "points", "rigid": False, "predicts": "velocity", "next_motion": False},
}


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> TrainedKinds:
    """Of a body whose height is free."""
    models = {kind: MODEL | change for kind, change in KINDS.items()}
    return TrainedKinds.of(tmp_path_factory.mktemp("wheel"), models, scene={"kind": "wheel"})


@pytest.mark.parametrize("kind", KINDS)
def test_rollout_is_stepping_and_needs_no_height(trained, kind) -> None:
    run, simulator = trained.run, trained.simulator(kind)
    assert simulator.predicts_body
    rollout = simulator.rollout(run.pose, latent_history=run.latent[:3, :4])
    assert not np.allclose(rollout.poses[3:, 2], run.pose[3:, 2])
    # Whatever height is put in after the given frames, the same comes out.
    raised = run.pose.copy()
    raised[3:, 2] += 0.1
    again = simulator.rollout(raised, latent_history=run.latent[:3, :4])
    np.testing.assert_array_equal(again.latent, rollout.latent)
    np.testing.assert_array_equal(again.poses[:, 2], rollout.poses[:, 2])
    simulator.reset(history=(run.latent[:3, :4], run.pose[:3]))
    for t in range(3, 14):
        state = simulator.step(run.pose[t])
        # One step after the other goes through poses: equal but for their rounding.
        np.testing.assert_allclose(state.latent, rollout.latent[t], rtol=0, atol=1e-6)
        np.testing.assert_allclose(state.pose, rollout.poses[t], rtol=0, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_a_wheel_goes_on_from_where_it_is(trained, kind) -> None:
    """Whatever height is put in then, too."""
    path, simulator = trained.run.pose.copy(), trained.simulator(kind)
    simulator.reset(path)
    for pose in path[1:6]:
        simulator.step(pose)
    here = simulator.save()
    path[5:, 2] += 0.1
    rollout, many = simulator.rollout(path[5:], start=here), simulator.rollouts(path[None, 5:], start=here)
    states = [simulator.restore(here), *map(simulator.step, path[6:])]
    for frame, state in enumerate(states):
        for found in (rollout.latent, many.latent[0]):
            np.testing.assert_allclose(found[frame], state.latent, rtol=0, atol=1e-5)
        np.testing.assert_allclose(rollout.poses[frame], state.pose, rtol=0, atol=1e-5)
    simulator.restore(rollout.end)
    np.testing.assert_allclose(rollout.end.pose, states[-1].pose, rtol=0, atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_copies_go_on_to_the_bit(trained, kind) -> None:
    path, simulator = trained.run.pose, trained.simulator(kind)
    simulator.reset(path)
    for pose in path[1:5]:
        simulator.step(pose)
    others = [copy.copy(simulator), copy.deepcopy(simulator), pickle.loads(pickle.dumps(simulator))]
    for pose in path[5:9]:
        expected = simulator.step(pose)
        for other in others:
            found = other.step(pose)
            for name in ("latent", "force", "torque", "pose"):
                np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


@pytest.mark.parametrize("kind", ["pose", "points"])  # the third is not told of the way
def test_a_way_far_from_everything_is_refused_and_forgotten(trained, kind) -> None:
    path, simulator = trained.run.pose, trained.simulator(kind)
    simulator.reset(path)
    simulator.step(path[1])
    plain, far = copy.copy(simulator), path[2].copy()
    far[0] = 1e300
    with pytest.raises(UserError, match="not finite at frame 2"):
        simulator.step(far)
    found, expected = simulator.step(path[2]), plain.step(path[2])
    np.testing.assert_array_equal(found.latent, expected.latent)
    np.testing.assert_array_equal(found.pose, expected.pose)
    # A whole path says so in its numbers, also beside others, which are none the worse.
    broken = path.copy()
    broken[5:, 0] = 1e300
    many = simulator.rollouts(np.stack([broken, path]))
    assert not np.isfinite(many.latent[0, 6:]).any() and np.isfinite(many.poses[1]).all()
    assert not np.isfinite(simulator.rollout(broken).latent[6:]).any()


def test_points_that_fix_no_pose_are_refused(trained) -> None:
    path, simulator = trained.run.pose, trained.simulator("points")
    line = simulator.body_points[:1] + 0.01 * np.arange(5.0)[:, None]
    for points in (simulator.body_points[:1], simulator.body_points[:2], line):
        with pytest.raises(UserError, match="lie on one line"):
            simulator.rollout(path, points)


def test_soil_under_a_wheel_follows_the_clock(trained) -> None:
    """A wheel that rests may still sink."""
    path = trained.run.pose[:1].repeat(20, axis=0)
    found, own = (
        trained.simulator("pose", rate_independent=follows).rollout(path) for follows in (True, False)
    )
    np.testing.assert_array_equal(found.latent, own.latent)
    assert (np.diff(found.latent, axis=0) != 0).any(axis=(1, 2)).all()


def test_the_prescribed_part_is_kept(trained) -> None:
    poses = trained.simulator("pose").rollout(trained.run.pose).poses
    prescribed = [0, 1, 3, 4, 5, 6]
    np.testing.assert_allclose(poses[:, prescribed], trained.run.pose[:, prescribed], atol=1e-12)


def test_points_stay_rigid_or_not(trained) -> None:
    apart = {}
    for kind in ("points", "free"):
        points = trained.simulator(kind).rollout(trained.run.pose).body_points
        distance = np.linalg.norm(points[:, :, None] - points[:, None], axis=-1)
        apart[kind] = np.abs(distance - distance[0]).max()
    assert apart["points"] < 1e-9 < 1e-6 < apart["free"]


def test_nearest_rigid_is_exact_for_a_rigid_motion_and_best_otherwise() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(8, 3))
    pose = np.array([[0.3, -0.2, 0.1, 0.5, -0.5, 0.5, 0.5]])
    moved = torch.as_tensor(in_world_frame(pose, points)[0])
    reference = torch.as_tensor(points)
    torch.testing.assert_close(nearest_rigid(reference, moved), moved, rtol=0, atol=1e-12)
    shaken = moved + 0.05 * torch.as_tensor(rng.normal(size=(8, 3)))
    best = nearest_rigid(reference, shaken)
    for angle in (-0.01, 0.01):
        turned = in_world_frame(np.array([[0, 0, 0, 0, 0, np.sin(angle), np.cos(angle)]]), best.numpy())[0]
        assert (best - shaken).square().sum() < (torch.as_tensor(turned) - shaken).square().sum()


def test_wheels_and_blades_do_not_mix(trained) -> None:
    data, folder = trained
    runs = {split: data.runs(split) for split in ("train", "validation", "test")}
    runs["train"][0] = replace(runs["train"][0], scene={"kind": "excavation"})
    with pytest.raises(UserError, match="mix wheels"):
        train(replace(data, _runs=runs), num_modes=4, model=MODEL, training=BRIEF, output=folder / "mixed")
