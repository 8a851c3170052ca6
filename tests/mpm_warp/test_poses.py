"""Rotations, points carried along, and poses that are refused."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mpm_warp.poses import fitted_poses, in_body_frame, in_world_frame, rotation_matrices, rotation_vectors
from sgns.config import UserError
from sgns.numbers import check_pose, check_poses, first_pose
from sgns_testing.runs import random_poses


def test_rotations_agree_with_scipy() -> None:
    q = random_poses()[:, 3:]
    np.testing.assert_allclose(rotation_matrices(q), Rotation.from_quat(q).as_matrix(), atol=1e-14)
    expected = (Rotation.from_quat(q[1:]) * Rotation.from_quat(q[:-1]).inv()).as_rotvec()
    np.testing.assert_allclose(rotation_vectors(q[:-1], q[1:]), expected, atol=1e-14)
    # q and -q are one rotation.
    np.testing.assert_allclose(rotation_vectors(q[:-1], -q[1:]), expected, atol=1e-14)


def test_points_go_there_and_back() -> None:
    poses, points = random_poses(), np.random.default_rng(1).normal(size=(5, 3))
    world = in_world_frame(poses, points)
    for pose, there in zip(poses, world, strict=True):
        np.testing.assert_allclose(there, Rotation.from_quat(pose[3:]).apply(points) + pose[:3], atol=1e-14)
        np.testing.assert_allclose(in_body_frame(pose, there), points, atol=1e-14)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_pose_that_is_not_finite_names_its_frame(bad: float) -> None:
    poses = random_poses()
    poses[3, 1] = bad
    with pytest.raises(UserError, match="frame 3"):
        check_poses(poses)


def test_a_quaternion_must_have_unit_length() -> None:
    poses = random_poses()
    poses[2, 3:] *= 1.01
    with pytest.raises(UserError, match="frame 2"):
        check_poses(poses)
    poses[2, 3:] *= 1.0005 / 1.01
    np.testing.assert_allclose(np.linalg.norm(check_poses(poses)[:, 3:], axis=1), 1.0, atol=1e-14)


OTHERS = [
    np.ones(7, dtype=bool),
    ["0", "0", "0", "0", "0", "0", "1"],
    np.ones(7, dtype=complex),
    np.ones(7, dtype=object),
    [[0.0], [0.0, 1.0]],
    torch.zeros(7, requires_grad=True),
]


@pytest.mark.parametrize(
    "bad", [np.zeros((4, 6)), np.zeros((0, 7)), np.zeros((2, 3, 7)), "path", None, *OTHERS]
)
def test_poses_of_a_wrong_kind(bad: object) -> None:
    with pytest.raises(UserError, match="needs rows"):
        check_poses(bad)  # type: ignore[arg-type]


@pytest.mark.parametrize("bad", [random_poses()[:3], random_poses()[:1], np.zeros(6), 1.0, *OTHERS])
def test_one_pose_is_no_path_and_of_numbers(bad: object) -> None:
    with pytest.raises(UserError, match=r"tool pose .*needs x, y, z, qx, qy, qz, qw, shape \(7,\)"):
        check_pose(bad)  # type: ignore[arg-type]


def test_of_a_path_the_first_pose_alone_is_looked_at() -> None:
    poses = random_poses()
    known = poses[0].copy()
    poses[1] = np.nan
    found = [
        first_pose(poses),
        first_pose(poses[0]),
        first_pose(poses[0].tolist()),
        check_pose(torch.tensor(poses[0])),
    ]
    poses[0] = 5.0  # what was given does not matter any more
    for pose in found:
        np.testing.assert_allclose(pose, known, atol=1e-15)
    with pytest.raises(UserError, match="first pose has a quaternion of length 10;"):
        first_pose(poses)


def test_poses_of_points_that_are_nowhere_are_nowhere() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(4, 3))
    world = np.stack([points, points + np.nan, points])
    world[2] *= np.inf
    found = fitted_poses(points, world)
    np.testing.assert_allclose(found[0], [0, 0, 0, 0, 0, 0, 1], atol=1e-14)
    assert not np.isfinite(found[1:, :3]).any()


def test_fitted_poses_find_the_poses_again() -> None:
    rng = np.random.default_rng(0)
    quaternion = rng.normal(size=(200, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    quaternion[:4] = np.eye(4)  # half turns about each axis, and none
    poses = np.concatenate([rng.normal(size=(200, 3)), quaternion], axis=1)
    points = rng.normal(size=(6, 3))
    for _ in range(2):
        found = fitted_poses(points, in_world_frame(poses, points))
        np.testing.assert_allclose(found[:, :3], poses[:, :3], atol=1e-12)
        np.testing.assert_allclose(
            rotation_matrices(found[:, 3:]), rotation_matrices(poses[:, 3:]), atol=1e-12
        )
        # Points in a plane, as those of a plate: its mirror image is not taken for a rotation.
        points[:, 0] = 0.0
