"""Going on from a recorded frame, and from where a solver stopped."""

import copy
from dataclasses import replace

import numpy as np
import pytest

from mpm_warp import Bed, Effects, Incline, Material, SceneError, Solver, SolverStopped, State, Walls, Wheel
from mpm_warp.limits import PhysicalLimits
from mpm_warp.solver import run_concurrently
from sgns_testing.scenes import UNDAMPED, block, cut
from sgns_testing.solvers import assert_same_frames, change


def wheel() -> Wheel:
    bed = Bed(size=(0.4, 0.24, 0.08), spacing=0.02, headroom=0.1)
    return Wheel(bed=bed, duration=0.1, settle=0.05, load=20.0, **UNDAMPED)


def slope(**kw) -> Incline:
    bed = Bed(size=(0.08, 0.08, 0.04), spacing=0.02, headroom=0.04, walls=Walls(x="periodic", y="periodic"))
    return Incline(bed=bed, material=Material(friction_angle=20.0), duration=0.1, flowing=False, tilt=30.0)


def with_state(scene, effects=None, frame=2):
    """All frames, and the state at one of them."""
    solver, whole, state = Solver(scene, effects), [], None
    for found in solver.frames():
        whole.append(found)
        if found.index == frame:
            state = solver.state()
    assert state.frame == frame
    return whole, state


@pytest.mark.parametrize(
    ("scene", "effects"),
    [
        (cut(duration=0.1), Effects()),
        (cut(duration=0.1), Effects(symmetry=True)),
        (cut(duration=0.1), Effects(fluidity=True, nonlocality=True)),
        (cut(duration=0.1), Effects(nonlocality=True)),
        (cut(duration=0.1, clearance=0.0, material=Material(cohesion=100.0)), Effects()),
        (wheel(), Effects()),
        (replace(wheel(), slip_angle=30.0, load=((0.0, 20.0), (0.1, 40.0))), Effects()),
        (slope(), Effects()),
    ],
    ids=["cut", "half", "fluidity", "nonlocal", "cohesive", "wheel", "turned wheel", "periodic"],
)
def test_the_rest_is_bit_equal(scene, effects):
    """A second solver that starts from a frame of the first goes on as the first did, every time that it is asked."""
    whole, state = with_state(scene, effects)
    later = Solver(scene, effects, start=state)
    state.arrays["position"] += 1.0  # no longer the solver's business
    assert_same_frames(later.frames(), whole[3:])
    stages = [stage for _, stage in run_concurrently([later.stages()], 1, "cpu")]
    assert_same_frames(stages, whole[3:])


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("velocity", 20.0, r"it moves at 34.6 m/s, which nothing here can cause \(\d"),
        ("velocity", np.nan, r"particle \d+ at .* of frame 3: its speed is not finite"),
        ("elastic_strain", np.nan, "speed is not finite"),
    ],
)
def test_what_soil_cannot_do_stops_the_solver(name, value, words):
    """It gives its last good frame, from where a solver with a shorter step goes on, near to where an undisturbed one
    gets."""
    scene = cut(duration=0.1, material=Material(youngs_modulus=1e6))
    solver, frames = Solver(scene), []
    with pytest.raises(SolverStopped, match=words) as caught:
        for found in solver.frames():
            frames.append(found)
            if found.index == 2:
                change(getattr(solver.particles, name), value, at=17)
    text, state = str(caught.value), caught.value.state
    assert "\n" not in text
    assert "particle" in text and "substep" in text and "of frame 3" in text
    assert state.frame == frames[-1].index == 2
    np.testing.assert_array_equal(state.arrays["position"].astype(np.float32), frames[-1].position)
    *_, last = Solver(replace(scene, courant=0.3), start=state).frames()
    *_, undisturbed = Solver(scene).frames()
    assert last.index == undisturbed.index
    assert np.abs(last.position - undisturbed.position).max() < 1e-3


def test_with_symmetry_the_message_names_the_right_particle():
    """15 rows across: particles on the plane of symmetry come first and count half."""
    scene = cut(duration=0.1, bed=Bed(size=(0.5, 0.375, 0.16), spacing=0.025, headroom=0.12))
    solver = Solver(scene, Effects(symmetry=True))
    assert solver._half.on_plane < 500
    frames = solver.frames()
    next(frames)
    change(solver.particles.velocity, np.nan, at=500)
    with pytest.raises(SolverStopped, match=f"^particle {solver._half.kept[500]} at "):
        next(frames)


@pytest.mark.parametrize(
    ("volume", "shear", "courant", "words"),
    [
        (-0.5, 0.3, 0.6, None),
        (-1.2, 0.0, 0.6, "strained to 30.1 % of its volume and by 0 in shear"),
        (-0.5, -1.5, 0.6, "strained to 60.7 % of its volume and by 1.5 in shear"),
        (-0.5, 0.0, 0.8, "compressed to 60.7 % of its volume, where waves are too fast for steps of"),
        (np.nan, 0.0, 0.6, "strain is not finite"),
        (0.0, np.inf, 0.6, "strain is not finite"),
    ],
)
def test_strains_that_soil_cannot_have(volume, shear, courant, words):
    scene = cut(courant=courant)
    limits = PhysicalLimits(scene, Solver(scene).time_step)
    ln_j, strain = np.full(5, -0.01), np.zeros((5, 6))
    ln_j[3], strain[3, 4] = volume, shear
    found = limits.too_strained(ln_j, strain)
    if words is None:
        assert found is None
    else:
        assert found[0] == 3
        assert words in found[1]


def test_a_state_of_another_scene_is_refused():
    assert Solver(cut()).state() is None
    solver = Solver(cut(duration=0.1))
    next(solver.frames())
    state = solver.state()
    with pytest.raises(SceneError, match=r"position has shape \(3840, 3\)"):
        Solver(block(), start=State(0, {k: v for k, v in state.arrays.items() if k != "contact_stretch"}))
    with pytest.raises(SceneError, match="'fluidity' is on one side only"):
        Solver(cut(), Effects(fluidity=True), start=state)
    state.arrays["log_volume"][3] = np.nan
    with pytest.raises(SceneError, match="log_volume is not finite"):
        Solver(cut(), start=state)


@pytest.mark.parametrize(
    ("scene", "effects"),
    [
        (cut(duration=0.05), Effects(symmetry=True, fluidity=True, nonlocality=True)),
        (wheel(), Effects()),
        (slope(), Effects()),
    ],
    ids=["half", "wheel", "periodic"],
)
def test_every_call_begins_anew(scene, effects):
    """Whatever the call before left: all frames, some of them, none, or a soil that went wrong."""
    solver = Solver(scene, effects)
    first = list(solver.frames())
    assert_same_frames(solver.frames(), first)
    some = [frame for frame, _ in zip(solver.frames(), range(2), strict=False)]
    assert_same_frames(some, first[:2])
    solver.particles.velocity.fill_(np.nan)
    frames = solver.frames()
    next(frames)
    solver.particles.velocity.fill_(np.nan)
    with pytest.raises(SolverStopped):
        next(frames)
    assert_same_frames(solver.frames(), first)


def test_an_earlier_call_ends_where_a_later_one_begins():
    solver = Solver(cut(duration=0.05))
    earlier, later = solver.frames(), solver.frames()
    next(earlier)
    first = next(later)
    with pytest.raises(SceneError, match="asked for again, and it began anew: take them from the later call"):
        next(earlier)
    assert_same_frames([first, *later], Solver(cut(duration=0.05)).frames())
    with pytest.raises(SceneError, match="make a Solver for each"):
        list(run_concurrently([solver.stages(), solver.stages()], 2, "cpu"))


def test_what_was_given_stays_as_it_was():
    """Frames and states are copies, though on a CPU the solver's arrays could be looked at in place."""
    for precision in ("float32", "float64"):
        solver = Solver(wheel(), precision=precision)
        frames = solver.frames()
        given = [next(frames), next(frames)]
        state = solver.state()
        before = copy.deepcopy((given, state))
        for _ in frames:
            pass
        assert_same_frames(given, before[0])
        for name, array in before[1].arrays.items():
            np.testing.assert_array_equal(state.arrays[name], array)
