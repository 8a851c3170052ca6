"""Several threads compute what one does, to rounding, and always the same."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

from mpm_warp import Bed, Effects, Scene, SceneError, Solver, Walls
from mpm_warp.launch import SideBySide, find_device, run_side_by_side
from mpm_warp.scenes import Wheel
from sgns_testing.scenes import UNDAMPED, cut

SHORT = {"duration": 2 / 60}
CUT = cut(**SHORT)
PERIODIC = cut(**SHORT, bed=replace(CUT.bed, walls=Walls(y="periodic")))
WHEEL = Wheel(bed=CUT.bed, settle=0.0, load=60.0, rim_speed=0.1, **UNDAMPED, **SHORT)


def last(scene, effects=None, threads=1):
    """Numbers of the last frame that should not depend on the threads."""
    *_, frame = Solver(scene, effects, precision="float64", threads=threads).frames()
    return {name: getattr(frame, name) for name in ("force", "torque", "body_pose", "position", "velocity")}


@pytest.mark.parametrize("threads", [2, 3])
@pytest.mark.parametrize(
    ("scene", "effects"),
    [
        (CUT, Effects(torque=True)),
        (CUT, Effects(symmetry=True)),
        (CUT, Effects(nonlocality=True)),
        (PERIODIC, Effects()),
        (WHEEL, Effects(torque=True)),
    ],
    ids=["cut", "symmetry", "nonlocality", "periodic", "wheel"],
)
def test_the_answer_is_that_of_one_thread(scene, effects, threads):
    alone, shared = last(scene, effects), last(scene, effects, threads)
    assert np.abs(alone["force"]).max() > 1.0  # N: there is something to add up
    for name, value in alone.items():
        np.testing.assert_allclose(
            shared[name], value, rtol=1e-6, atol=1e-6 * np.abs(value).max(), err_msg=name
        )


def test_the_same_threads_give_the_same_bits():
    frames = [list(Solver(CUT, threads=2).frames())[-1] for _ in range(2)]
    assert np.array_equal(frames[0].position, frames[1].position)
    assert np.array_equal(frames[0].force, frames[1].force)


def test_steps_and_soil_to_start_from_are_those_of_the_frames():
    poses = CUT.body_poses()
    rows = np.column_stack([CUT.times(), poses])  # between which a step goes straight, too
    solver = Solver(replace(CUT, motion="path", path=tuple(map(tuple, rows))), threads=2)
    *_, frame = solver.frames()
    soil = solver.soil()
    solver.reset()
    for pose in poses[1:]:
        step = solver.step(pose)
    assert np.array_equal(step.position, frame.position)
    assert np.array_equal(step.force, frame.force)
    goes_on = next(Solver(replace(CUT, motion="rest"), start_from=soil, threads=2).frames())
    assert np.array_equal(goes_on.position[:9], frame.position[:9])


def test_more_threads_than_particles():
    scene = Scene(bed=Bed(size=(0.06, 0.06, 0.04), spacing=0.02, particles_per_cell=1.0), **SHORT)
    assert Solver(scene).computed_count == 18
    np.testing.assert_allclose(last(scene, threads=20)["position"], last(scene)["position"], atol=1e-7)


@pytest.mark.parametrize("threads", [0, 257, 1.5, "two"])
def test_impossible_numbers_are_refused(threads):
    with pytest.raises(SceneError, match=r"threads is .*allowed: 1 to 256"):
        Solver(CUT, threads=threads)


class Failing:
    def launch(self, step=0):
        raise OSError("no more memory")


class Counting:
    def __init__(self):
        self.seen = []

    def launch(self, step=0):
        self.seen.append(threading.current_thread())


@pytest.mark.parametrize("thread", [0, 1])
def test_an_error_in_a_thread_ends_the_others(thread):
    parts = [[Counting()], [Counting()]]
    parts[thread] = [Failing()]
    later = Counting()
    with pytest.raises(OSError, match="no more memory"):
        run_side_by_side([(SideBySide(parts, ""), 0), (later, 0)], 2)
    assert not later.seen


def test_what_is_not_shared_is_done_once():
    first, both, last = Counting(), [Counting(), Counting()], Counting()
    run_side_by_side([(first, 0), (SideBySide([[one] for one in both], ""), 0), (last, 0)], 2)
    assert [len(one.seen) for one in (first, *both, last)] == [1, 1, 1, 1]
    assert first.seen == last.seen == both[0].seen != both[1].seen


def test_a_gpu_has_no_such_threads(monkeypatch):
    class Gpu:
        is_cuda = True

        def __str__(self):
            return "cuda:0"

    monkeypatch.setattr("mpm_warp.solver.find_device", lambda name: Gpu())
    with pytest.raises(SceneError, match="threads is 2 on cuda:0"):
        Solver(CUT, device="cuda", threads=2)
    assert find_device("cpu").is_cpu
