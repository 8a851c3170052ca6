"""Motion laws and paths."""

from __future__ import annotations

import math

import numpy as np
import pytest
from beds import cut
from scipy.spatial.transform import Rotation

from mpm_warp import Box, Push, Scene, SceneError, Solver, SolverStopped, Wheel, substeps_per_frame
from mpm_warp.expected_flow import expected_flow
from mpm_warp.guard import Guard
from mpm_warp.motion import curved, ramp, sampled_poses
from mpm_warp.rotation import about_y, angular_velocity, multiply, rotate, slerp
from mpm_warp.time_step import top_body_speed


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


def turning(*rows: tuple[float, float], **kw) -> Push:
    """A box in the bed of `cut`, turned about its middle by angles [degrees] at times [s]."""
    path = tuple((t, 0.24, 0.2, 0.02, *about_y(math.radians(angle))) for t, angle in rows)
    return Push(bed=cut().bed, tool=Box(size=(0.1, 0.1, 0.06)), path=path, **({"duration": 0.1} | kw))


def test_the_fastest_point_counts():
    """Sixty turns a second, each from one frame to the next, where nothing is seen of them."""
    scene = turning(*((quarter / 240.0, 90.0 * quarter) for quarter in range(25)))
    np.testing.assert_allclose(scene.body_poses()[0], np.abs(scene.body_poses()[3]), atol=1e-12)
    rim = 120.0 * math.pi * scene.tool.reach
    assert top_body_speed(scene) == pytest.approx(rim)
    assert substeps_per_frame(scene) > 2 * substeps_per_frame(turning((0.0, 0.0)))
    assert Guard(scene, 1e-4).speed_bound > 4.0 * rim
    np.testing.assert_allclose(expected_flow(scene).speed, rim)


def test_a_guard_knows_how_fast_a_path_is_between_frames():
    """A tenth of a turn within a millisecond, in a frame of 17 ms."""
    scene = turning((0.0, 0.0), (0.051, 0.0), (0.052, 36.0), (0.1, 36.0))
    way = math.radians(36.0) * scene.tool.reach
    assert top_body_speed(scene) == pytest.approx(60.0 * way)
    for step, fastest in ((1e-4, 1e3 * way), (1e-3, 1e3 * way), (2e-3, 5e2 * way)):
        assert top_body_speed(scene, step) == pytest.approx(fastest)


def test_motion_without_rotation_counts_as_before():
    scene = cut()
    step = np.linalg.norm(np.diff(scene.body_poses()[:, :3], axis=0), axis=1)
    assert top_body_speed(scene) == step.max() * scene.frame_rate
    assert top_body_speed(Scene()) == 0.0


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([(0.0, 0.0), (0.02, 0.0), (0.020000001, 90.0)], "turns by 90 degrees within substep"),
        (
            [(0.0, 0.0), *((0.02 + 1e-10 * k, 90.0 * k) for k in range(5))],
            "turns by 360 degrees within substep",
        ),
    ],
    ids=["quarter", "whole"],
)
def test_a_body_that_turns_at_once_stops_the_solver(rows, words):
    """Also when it is back where it was before the substep ends."""
    frames = Solver(turning(*rows)).frames()
    assert [next(frames).index, next(frames).index] == [0, 1]
    with pytest.raises(
        SolverStopped, match=words + r" .* of frame 2, .* at 0\.0(19|20).* allowed: 0\.01 m"
    ) as caught:
        next(frames)
    assert "\n" not in str(caught.value)


def test_a_body_that_comes_back_within_a_substep_stops_the_solver():
    path = tuple(
        (t, x, 0.2, 0.2, 0, 0, 0, 1) for t, x in [(0, 0.2), (1e-5, 0.2), (1.1e-5, 0.22), (1.2e-5, 0.2)]
    )
    with pytest.raises(SolverStopped, match=r"the body jumps by 0.04 m .* at 0.00000 s"):
        list(Solver(cut(motion="path", path=path, duration=0.05)).frames())


def test_a_wheel_that_turns_too_fast_stops_the_solver():
    """On the spot, so fast that no step is short enough; a wheel's poses show no whole turns."""
    wheel = Wheel(bed=cut().bed, duration=0.05, settle=0.0, slip=1.0, rim_speed=3000.0)
    with pytest.raises(SolverStopped, match=r"the body jumps by 0 m .* half a grid spacing"):
        list(Solver(wheel).frames())
    slow = Wheel(bed=cut().bed)
    assert top_body_speed(slow) == pytest.approx(slow.speed + slow.angular_speed * slow.body.reach)


def test_a_path_that_leaves_the_bin_between_frames():
    path = tuple(
        (t, 0.24, 0.2, z, 0, 0, 0, 1) for t, z in [(0.0, 0.2), (0.04, 0.2), (0.042, -0.1), (0.044, 0.2)]
    )
    with pytest.raises(SceneError, match=r"the plate leaves the bin at 0\.042 s"):
        cut(motion="path", path=path)
    later = tuple((t + 0.5, *rest) for t, *rest in path)
    cut(motion="path", path=later)  # the scene ends before
