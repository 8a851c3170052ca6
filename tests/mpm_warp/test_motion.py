"""Motion laws and paths."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mpm_warp import SceneError
from mpm_warp.motion import curved, ramp, sampled_poses
from mpm_warp.rotation import about_y, angular_velocity, multiply, rotate, slerp


def test_curved_motion_is_half_an_ellipse():
    t = np.linspace(0.0, 4.0, 401)
    x, z = curved(t, 0.08, 0.1).T
    inside = t <= 0.95 * 4.0
    np.testing.assert_allclose(((x[inside] - 0.2) / 0.2) ** 2 + (z[inside] / 0.08) ** 2, 1.0, atol=1e-12)
    assert z.min() == pytest.approx(-0.08)
    np.testing.assert_allclose(np.diff(x[~inside]), 0.0)  # it stops at 95 %


def test_fastest_cut_lasts_the_published_2_6_seconds():
    """0.4 m / 0.15 m/s is 2.67 s; the published scripts say 2.6."""
    z = curved(np.linspace(0, 3, 3001), 0.05, 0.15)[:, 1]
    assert np.argmin(z) == pytest.approx(1300, abs=1)


def test_ramp_goes_down_across_and_up():
    t = np.array([0.0, 1.0, 2.0, 4.0, 6.0, 7.0, 8.0, 20.0])
    x, z = ramp(t, 0.05, 0.1).T
    np.testing.assert_allclose(z, [0, -0.025, -0.05, -0.05, -0.05, -0.025, 0, 0], atol=1e-12)
    np.testing.assert_allclose(x, [0, 0.025, 0.05, 0.25, 0.45, 0.475, 0.5, 0.5], atol=1e-12)


def test_sampled_path_interpolates_and_rests_at_its_ends():
    quarter = about_y(np.pi / 2)
    path = [[1.0, 0, 0, 0, 0, 0, 0, 1], [3.0, 2, 0, -1, *quarter]]
    poses = sampled_poses(np.array(path), np.array([0.0, 1.0, 2.0, 3.0, 9.0]))
    np.testing.assert_allclose(poses[:, 0], [0, 0, 1, 2, 2])
    np.testing.assert_allclose(poses[2, 3:], about_y(np.pi / 4), atol=1e-12)
    np.testing.assert_allclose(poses[0], path[0][1:])
    np.testing.assert_allclose(poses[4], path[1][1:], atol=1e-12)


def test_a_path_of_one_pose_rests():
    poses = sampled_poses(np.array([[0.0, 1, 2, 3, 0, 0, 0, 1]]), np.array([0.0, 5.0]))
    np.testing.assert_allclose(poses, [[1, 2, 3, 0, 0, 0, 1]] * 2)


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([[0.0, 1, 2, 3]], "rows of 8 numbers"),
        ([[0.0, 1, 2, float("nan"), 0, 0, 0, 1]], "not finite in row 1, column 4"),
        ([[0.0, 1, 2, 3, 0, 0, 0, 1], [0.0, 1, 2, 3, 0, 0, 0, 1]], "row 2 does not come after"),
        ([[0.0, 1, 2, 3, 0, 0, 0, 2]], "quaternion in row 1 is not of length 1"),
    ],
)
def test_bad_paths(rows, words):
    with pytest.raises(SceneError, match=words):
        sampled_poses(np.array(rows), np.array([0.0]))


def test_quaternions_agree_with_scipy():
    a, b = (
        Rotation.random(20, rng=np.random.default_rng(0)),
        Rotation.random(20, rng=np.random.default_rng(1)),
    )
    v = np.random.default_rng(2).normal(size=(20, 3))
    np.testing.assert_allclose(rotate(a.as_quat(), v), a.apply(v), atol=1e-12)
    product = multiply(a.as_quat(), b.as_quat())
    np.testing.assert_allclose(rotate(product, v), (a * b).apply(v), atol=1e-12)
    np.testing.assert_allclose(angular_velocity(b.as_quat(), product, 1.0), a.as_rotvec(), atol=1e-9)
    half = slerp(b.as_quat(), product, np.full(20, 0.5))
    turned = (Rotation.from_rotvec(0.5 * a.as_rotvec()) * b).apply(v)
    np.testing.assert_allclose(rotate(half, v), turned, atol=1e-9)
