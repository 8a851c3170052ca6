"""Motion laws of tools."""

import numpy as np
import pytest

from mpm_warp import Body, Box, Effects, Preview, SceneError, Solver
from mpm_warp.motions import Passes, curved, ramp
from mpm_warp.poses import rotate
from sgns_testing.scenes import cut


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


# --- Several passes -------------------------------------------------------------------------------------


def test_passes_go_down_across_up_and_back():
    passes = Passes(
        number=2, length=0.1, advance=0.02, deepening=0.01, lift=0.05, return_speed=0.2, easing=0.1
    )
    corners, places = passes.corners(depth=0.03, speed=0.1)
    x = [0, 0.03, 0.13, 0.16, 0.16, 0.02, 0.02, 0.06, 0.16, 0.20, 0.20]
    z = [0, -0.03, -0.03, 0, 0.05, 0.05, 0, -0.04, -0.04, 0, 0.05]
    np.testing.assert_allclose(places, np.transpose([x, z]), atol=1e-12)
    assert corners[2] - corners[1] == pytest.approx(1.0)  # 0.1 m at 0.1 m/s
    assert corners[5] - corners[4] == pytest.approx(0.14 / 0.2)
    # In the middle of a straight part the tip lags by half the easing and is on the line.
    middle = 0.5 * (corners[:-1] + corners[1:])
    np.testing.assert_allclose(
        passes.displacement(middle + 0.05, 0.03, 0.1), 0.5 * (places[:-1] + places[1:]), atol=1e-12
    )
    cut = passes.cutting(middle, 0.03, 0.1)
    np.testing.assert_array_equal(cut, [0, 0, 0, -1, -1, -1, 1, 1, 1, -1])


def test_passes_are_smooth_begin_at_rest_and_reach_their_depth():
    passes, step = Passes(number=3, length=0.1, advance=0.03, deepening=0.01), 1e-4
    time = np.arange(0.0, passes.turns(0.05, 0.1)[-1] + 0.1, step)
    moved = passes.displacement(time, 0.05, 0.1)
    velocity = np.diff(moved, axis=0) / step
    acceleration = np.diff(velocity, axis=0) / step
    assert np.linalg.norm(velocity[[0, -1]], axis=1).max() < 1e-4
    assert np.linalg.norm(acceleration, axis=1).max() <= 2 * passes.return_speed / passes.easing + 1e-3
    assert np.linalg.norm(velocity, axis=1).max() == pytest.approx(passes.return_speed, rel=1e-3)
    assert moved[:, 1].min() == pytest.approx(-0.07, abs=1e-9)
    assert moved[:, 1].max() == pytest.approx(passes.lift, abs=1e-9)
    np.testing.assert_allclose(moved[0], 0.0, atol=1e-15)


def test_passes_without_length_or_lift_are_no_problem():
    moved = Passes(number=3, length=0.0, lift=0.0, deepening=0.0).displacement(
        np.linspace(0, 5, 5001), 0.02, 0.1
    )
    assert np.isfinite(moved).all()
    rounding = 0.1 / np.sqrt(2.0) * 0.1 / 4.0  # of a V: speed, easing
    assert moved[:, 1].min() == pytest.approx(-0.02 + rounding, abs=1e-6)


def test_passes_that_the_motion_does_not_use_are_told():
    words = "scene.passes is not used: scene.motion is 'curved'"
    assert any(words in one for one in cut(passes=Passes(number=3)).warnings())
    for scene in (cut(), cut(motion="passes", depth=0.03, passes=Passes(length=0.05))):
        assert not any("scene.passes" in one for one in scene.warnings())


def test_passes_that_do_not_fit_are_refused_or_told():
    with pytest.raises(SceneError, match=r"cut 3 would be -0.01 m deep; it must be above 0 m"):
        cut(motion="passes", depth=0.03, passes=Passes(number=3, deepening=-0.02))
    with pytest.raises(SceneError, match=r"the plate leaves the bin at .* change scene.depth, .* passes"):
        cut(motion="passes", duration=9.0, passes=Passes(length=0.5))
    with pytest.raises(SceneError, match=r"the plate leaves the bin at .*: z = "):
        cut(motion="passes", duration=20.0, passes=Passes(number=3, length=0.05, deepening=0.06))
    with pytest.raises(SceneError, match=r"scene.passes.number is 0; allowed: 1 to 100"):
        Passes(number=0)
    short = cut(motion="passes", duration=2.0, passes=Passes(length=0.05))
    ends = short.path_times()[-1]
    assert any(f"scene.duration={ends:.4g} takes it all" in words for words in Preview.of(short).warnings)


def test_a_body_makes_passes_with_its_tip():
    box = Box(size=(0.05, 0.193, 0.12))
    passes = Passes(number=2, length=0.05)
    body = Body(motion="passes", tool=box, bed=cut().bed, rake=15.0, depth=0.04, duration=6.0, passes=passes)
    plate = cut(motion="passes", rake=15.0, depth=0.04, duration=6.0, start=0.10, speed=0.1, passes=passes)
    tips = [
        pose[:, :3] + rotated(pose, scene.body.tip)
        for scene in (body, plate)
        for pose in [scene.body_poses()]
    ]
    np.testing.assert_allclose(*tips, atol=1e-12)
    assert not any("path is that of" in line for line in Preview.of(body).lines)
    with pytest.raises(SceneError, match=r"scene.path is given but scene.motion is 'passes'"):
        Body(motion="passes", path=((0.0, 0.2, 0.2, 0.2, 0, 0, 0, 1),))


def rotated(poses: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return np.array([rotate(pose[3:], vector) for pose in poses])


def test_a_second_pass_in_the_same_place_meets_less_soil():
    passes = Passes(number=2, length=0.08, deepening=0.0, lift=0.06, return_speed=0.4)
    scene = cut(
        motion="passes", depth=0.05, duration=2.3, frame_rate=30.0, start=0.15, passes=passes, clearance=0.01
    )
    force = np.array([frame.force for frame in Solver(scene, Effects(symmetry=True)).frames()])
    cutting = passes.cutting(scene.times(), scene.depth, scene.speed)
    first, second = (-force[cutting == number, 0].mean() for number in (0, 1))
    assert 0.0 < second < 0.7 * first
    assert f"mean draft of each pass: {first:.1f} N, {second:.1f} N" in scene.summary(force, force, force)


def test_passes_that_a_run_does_not_finish_are_told_in_its_summary():
    """Of a plate and of a body; `number` 3, of which the second is under way when the run ends."""
    passes = Passes(number=3, length=0.05)
    begin = passes.corners(0.05, 0.1)[0][6]
    bed, box = cut().bed, Box(size=(0.05, 0.15, 0.10))
    for scene in (
        cut(motion="passes", depth=0.05, speed=0.1, passes=passes, duration=begin + 0.5),
        Body(motion="passes", depth=0.05, tool=box, bed=bed, passes=passes, duration=begin + 0.5),
    ):
        force = np.tile([-2.0, 0.0, 0.0], (scene.frame_count, 1))
        assert "each pass: 2.0 N, 2.0 N (cut short), not reached" in scene.summary(force, force, force)
        force[scene.times() > begin - 0.1] = 0.0  # the second has begun, above the soil
        assert "each pass: 2.0 N, not reached, not reached" in scene.summary(force, force, force)
