"""Many scenes at once: the same frames as one by one, and one that fails leaves the others alone."""

from collections import Counter
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
import warp as wp

from mpm_warp import (
    Bed,
    Effects,
    Frame,
    Incline,
    Material,
    Scene,
    SceneError,
    Solver,
    SolverStopped,
    Walls,
    Wheel,
    frames_together,
)
from mpm_warp import launch as work_module
from mpm_warp.launch import BatchedLaunch, Job, Launch, Program, run_concurrently
from sgns_testing.scenes import UNDAMPED, block, cut
from sgns_testing.solvers import assert_same_frames


class Thrown(Scene):
    """Soil that flies out of the grid within a few frames."""

    def initial_velocities(self):
        return np.tile([0.0, 0.0, 4.0], (len(self.filled[0]), 1))


def by_scene(frames):
    """What came of each scene, in order."""
    found = {}
    for number, frame in frames:
        found.setdefault(number, []).append(frame)
    return [found[number] for number in sorted(found)]


def wheel(**kw):
    return Wheel(bed=cut().bed, **{"settle": 0.02, **UNDAMPED} | kw)


DIFFERENT = [  # in motion, gravity, material, grid, kind, time step and number of frames
    cut(duration=0.1),
    cut(duration=0.08, rake=30.0, gravity=1.62, material=Material(youngs_modulus=2.0e6)),
    cut(duration=0.08, bed=Bed(size=(0.5, 0.3, 0.1), spacing=0.025, headroom=0.12)),
    wheel(duration=0.05),
    wheel(duration=0.07, load=60.0),
    wheel(duration=0.06, slip_angle=30.0, load=((0.0, 20.0), (0.05, 60.0))),
]
BEDS = [  # with 15 and 16 rows across: particles on the plane of symmetry and none
    cut(
        duration=0.05,
        material=Material(grain_diameter=5e-3),
        bed=Bed(size=(0.5, width, 0.16), spacing=0.025, headroom=0.12),
    )
    for width in (0.375, 0.4)
]
PERIODIC = [  # bins of different length
    Incline(
        bed=Bed(size=(length, 0.06, 0.05), spacing=0.01, walls=Walls(x="periodic", y="periodic")),
        material=Material(),
        tilt=40.0,
        flowing=True,
        duration=0.05,
    )
    for length in (0.06, 0.1)
]
OWN = [Effects(), Effects(rate_dependence=False), Effects(separation=False)]


@pytest.mark.parametrize(
    ("scenes", "effects", "at_once"),
    [
        (DIFFERENT, None, (2, 32)),
        ([*BEDS, replace(BEDS[0], depth=0.04, rake=20.0)], Effects(symmetry=True), (32,)),
        (BEDS, Effects(fluidity=True, nonlocality=True), (32,)),
        (BEDS, Effects(symmetry=True, nonlocality=True, torque=False), (32,)),
        (PERIODIC, None, (32,)),
        ([cut(duration=0.15)] * 3, OWN, (32,)),
    ],
    ids=["different", "symmetric", "fluid", "nonlocal", "periodic", "effects"],
)
def test_scenes_together_are_the_scenes_alone(scenes, effects, at_once):
    own = effects if isinstance(effects, list) else [effects] * len(scenes)
    alone = [list(Solver(*one).frames()) for one in zip(scenes, own, strict=True)]
    for number in at_once:
        together = by_scene(frames_together(scenes, effects, at_once=number))
        for frames, expected in zip(together, alone, strict=True):
            assert_same_frames(frames, expected)
        assert len({frames[-1].velocity.tobytes() for frames in together}) == len(scenes)


def test_scenes_of_the_same_kernels_share_every_launch(monkeypatch):
    """As many launches as the scene with the most steps makes alone, whatever the others are."""
    counts = Counter()

    def counted(kind):
        launch = kind.launch
        return lambda self, step=0: counts.update([kind]) or launch(self, step)

    for kind in (Launch, BatchedLaunch):
        monkeypatch.setattr(kind, "launch", counted(kind))
    scenes = [cut(duration=0.05, speed=speed, depth=0.03) for speed in (0.1, 0.15, 0.2)]
    for _ in Solver(scenes[-1]).frames():
        pass
    alone = counts.pop(Launch)
    by_scene(frames_together(scenes))
    assert counts == {BatchedLaunch: alone}


@pytest.mark.parametrize("effects", [Effects(), Effects(symmetry=True, fluidity=True, nonlocality=True)])
def test_captured_graphs_are_the_launches(effects):
    """What a GPU replays, here captured and replayed by Warp on the CPU: the same bits, alone and together, though the
    numbers of steps differ from scene to scene and from remap to remap."""
    scenes = [cut(duration=0.06, speed=speed, depth=0.03, remap_time=4e-3) for speed in (0.1, 0.25)]
    scenes.append(wheel(duration=0.06, load=60.0))

    def computed():
        alone = [list(Solver(scene, effects).frames()) for scene in scenes]
        return [*alone, *by_scene(frames_together(scenes, effects))]

    plain = computed()
    launched = []
    real = wp.capture_launch
    with (
        mock.patch.object(work_module, "captures", lambda device: True),
        mock.patch.object(wp, "capture_launch", lambda graph: launched.append(graph) or real(graph)),
    ):
        captured = computed()
    assert len(launched) > 2 * len(set(launched)) > 10  # each graph served more than once
    for one, two in zip(plain, captured, strict=True):
        assert_same_frames(one, two)


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


def test_when_one_breaks_the_others_are_closed():
    closed = []

    def waits(name):
        try:
            while True:
                yield Job(Program([]), 0)
        finally:
            closed.append(name)

    def breaks():
        yield Job(Program([]), 0)
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        list(run_concurrently([waits("a"), breaks(), waits("b")], 3, "cpu"))
    assert sorted(closed) == ["a", "b"]


@pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device")
def test_many_scenes_on_cuda_agree_with_the_cpu():
    scenes = [cut(duration=0.15, depth=depth) for depth in np.linspace(0.02, 0.06, 9)]
    for scene, frames in zip(
        scenes, by_scene(frames_together(scenes, device="cuda", at_once=8)), strict=True
    ):
        one, two = frames[-1], list(Solver(scene).frames())[-1]
        np.testing.assert_allclose(one.force, two.force, atol=0.01 * np.linalg.norm(two.force))
        assert np.abs(one.position - two.position).max() < 1e-4
