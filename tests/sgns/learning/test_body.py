"""The tool as the network sees it."""

from __future__ import annotations

import numpy as np
from synthetic import random_poses

from sgns.learning.body import body_track
from sgns.poses import rotation_matrices


def test_pose_track() -> None:
    poses = random_poses()
    track = body_track(poses, None, "pose")
    assert [tuple(part.shape) for part in track] == [(6, 1, 3), (6, 1, 6), (6, 1, 6)]
    np.testing.assert_allclose(track.motion[1:, 0, :3], np.diff(poses[:, :3], axis=0))
    assert not track.motion[0].any()
    matrices = rotation_matrices(poses[:, 3:])
    np.testing.assert_allclose(track.orientation[:, 0, :3], matrices[:, :, 0])
    np.testing.assert_allclose(track.orientation[:, 0, 3:], matrices[:, :, 1])


def test_points_track() -> None:
    points = np.random.default_rng(2).normal(size=(6, 4, 3))
    track = body_track(random_poses(), points, "points")
    assert [tuple(part.shape) for part in track] == [(6, 4, 3), (6, 4, 0), (6, 4, 3)]
    np.testing.assert_allclose(track.motion[1:], np.diff(points, axis=0))
