"""The tool as the network sees it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sgns.errors import UserError
from sgns.learning.body import (
    body_track,
    check_poses,
    in_body_frame,
    in_world_frame,
    rotation_matrices,
    rotation_vectors,
)


def some_poses(count: int = 6) -> np.ndarray:
    rng = np.random.default_rng(0)
    turns = Rotation.from_rotvec(0.3 * rng.normal(size=(count, 3)))
    return np.concatenate([rng.normal(size=(count, 3)), turns.as_quat()], axis=1)


def test_rotations_agree_with_scipy() -> None:
    q = some_poses()[:, 3:]
    np.testing.assert_allclose(rotation_matrices(q), Rotation.from_quat(q).as_matrix(), atol=1e-14)
    expected = (Rotation.from_quat(q[1:]) * Rotation.from_quat(q[:-1]).inv()).as_rotvec()
    np.testing.assert_allclose(rotation_vectors(q[:-1], q[1:]), expected, atol=1e-14)
    # q and -q are one rotation.
    np.testing.assert_allclose(rotation_vectors(q[:-1], -q[1:]), expected, atol=1e-14)


def test_points_go_there_and_back() -> None:
    poses, points = some_poses(), np.random.default_rng(1).normal(size=(5, 3))
    world = in_world_frame(poses, points)
    for pose, there in zip(poses, world, strict=True):
        np.testing.assert_allclose(in_body_frame(pose, there), points, atol=1e-14)


def test_pose_track() -> None:
    poses = some_poses()
    track = body_track(poses, None, "pose")
    assert [tuple(part.shape) for part in track] == [(6, 1, 3), (6, 1, 6), (6, 1, 6)]
    np.testing.assert_allclose(track.motion[1:, 0, :3], np.diff(poses[:, :3], axis=0))
    assert not track.motion[0].any()
    matrices = rotation_matrices(poses[:, 3:])
    np.testing.assert_allclose(track.orientation[:, 0, :3], matrices[:, :, 0])
    np.testing.assert_allclose(track.orientation[:, 0, 3:], matrices[:, :, 1])


def test_points_track() -> None:
    points = np.random.default_rng(2).normal(size=(6, 4, 3))
    track = body_track(some_poses(), points, "points")
    assert [tuple(part.shape) for part in track] == [(6, 4, 3), (6, 4, 0), (6, 4, 3)]
    np.testing.assert_allclose(track.motion[1:], np.diff(points, axis=0))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_pose_that_is_not_finite_names_its_frame(bad: float) -> None:
    poses = some_poses()
    poses[3, 1] = bad
    with pytest.raises(UserError, match="frame 3"):
        check_poses(poses)


def test_a_quaternion_must_have_unit_length() -> None:
    poses = some_poses()
    poses[2, 3:] *= 1.01
    with pytest.raises(UserError, match="frame 2"):
        check_poses(poses)
    poses[2, 3:] *= 1.0005 / 1.01
    np.testing.assert_allclose(np.linalg.norm(check_poses(poses)[:, 3:], axis=1), 1.0, atol=1e-14)


@pytest.mark.parametrize("bad", [np.zeros((4, 6)), np.zeros((0, 7)), "path", None])
def test_poses_of_a_wrong_kind(bad: object) -> None:
    with pytest.raises(UserError, match="needs rows"):
        check_poses(bad)  # type: ignore[arg-type]
