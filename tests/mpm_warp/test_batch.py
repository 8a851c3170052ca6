"""Many scenes at once: the same frames as one by one, and one that fails leaves the others alone."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
import pytest
import warp as wp
from beds import block, cut

from mpm_warp import (
    Bed,
    Effects,
    Frame,
    Material,
    Scene,
    SceneError,
    Solver,
    SolverStopped,
    Wheel,
    frames_together,
)
from mpm_warp.batch import all_together

needs_cuda = pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device")


class Thrown(Scene):
    """Soil that flies out of the grid within a few frames."""

    def initial_velocities(self):
        return np.tile([0.0, 0.0, 4.0], (len(self.filled[0]), 1))


def different_scenes():
    """Scenes of different motion, gravity, material, kind, time step and number of frames."""
    return [
        cut(duration=0.15),
        cut(duration=0.12, rake=30.0, gravity=1.62, material=Material(youngs_modulus=2.0e6)),
        Wheel(bed=cut().bed, duration=0.08, settle=0.02),
    ]


def by_scene(frames):
    """What came of each scene, in order."""
    found = {}
    for number, frame in frames:
        found.setdefault(number, []).append(frame)
    return [found[number] for number in sorted(found)]


@pytest.mark.parametrize("at_once", [2, 32])
def test_scenes_together_are_the_scenes_alone(at_once):
    scenes = different_scenes()
    together = by_scene(frames_together(scenes, at_once=at_once))
    for scene, frames in zip(scenes, together, strict=True):
        assert len(frames) == scene.frame_count
        for one, two in zip(frames, Solver(scene).frames(), strict=True):
            for a, b in zip(astuple(one), astuple(two), strict=True):
                np.testing.assert_array_equal(a, b)
        assert np.linalg.norm(frames[-1].force) > 0.1


def test_scenes_may_have_effects_of_their_own():
    scene, effects = (
        cut(duration=0.15),
        [Effects(), Effects(rate_dependence=False), Effects(separation=False)],
    )
    found = [frames[-1].force for frames in by_scene(frames_together([scene] * 3, effects))]
    for force, own in zip(found, effects, strict=True):
        np.testing.assert_array_equal(force, list(Solver(scene, own).frames())[-1].force)
    assert len({tuple(force) for force in found}) == 3


def test_scenes_that_fail_leave_the_others():
    sound = cut(duration=0.05)
    uneven = Scene(bed=Bed(size=(0.2, 0.2, 0.1), spacing=0.05, arrangement="jittered"), duration=0.05)
    thrown = Thrown(bed=block().bed, gravity=0.0, duration=0.2, frame_rate=50.0)
    effects = Effects(symmetry=True)
    refused, stopped, whole = by_scene(frames_together([uneven, thrown, sound], effects, at_once=2))
    assert len(refused) == 1 and isinstance(refused[0], SceneError)
    assert len(stopped) < thrown.frame_count
    assert all(isinstance(frame, Frame) for frame in stopped[:-1])
    assert isinstance(stopped[-1], SolverStopped) and "headroom" in str(stopped[-1])
    np.testing.assert_array_equal(whole[-1].force, list(Solver(sound, effects).frames())[-1].force)
    assert len(whole) == sound.frame_count


@needs_cuda
def test_many_scenes_on_cuda_agree_with_the_cpu():
    scenes = [cut(duration=0.15, depth=depth) for depth in np.linspace(0.02, 0.06, 9)]
    for scene, frames in zip(
        scenes, by_scene(frames_together(scenes, device="cuda", at_once=8)), strict=True
    ):
        one, two = frames[-1], list(Solver(scene).frames())[-1]
        np.testing.assert_allclose(one.force, two.force, atol=0.01 * np.linalg.norm(two.force))
        assert np.abs(one.position - two.position).max() < 1e-4
