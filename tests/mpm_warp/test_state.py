"""Going on from a recorded frame, and from where a solver stopped."""

import copy
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from mpm_warp import (
    Bed,
    Column,
    Effects,
    Excavation,
    Incline,
    Material,
    Preview,
    Scene,
    SceneError,
    Soil,
    Solver,
    SolverStopped,
    State,
    Walls,
    Wheel,
)
from mpm_warp.launch import run_concurrently
from mpm_warp.limits import PhysicalLimits
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


# --- Soil of another run --------------------------------------------------------------------------------


def along(first: int, count: int, **kw) -> Excavation:
    """A straight cut whose times are exact in binary, from one of its frames on."""
    rate = 64.0
    times = np.arange(12) / rate
    rows = np.column_stack([times, np.tile(cut(clearance=0.0).body_poses()[0], (12, 1))])
    rows[:, 1] += 0.2 * times
    rows[:, 3] -= 0.2 * times
    rows = rows[first:]
    rows[:, 0] -= first / rate
    values = {"motion": "path", "path": rows, "duration": count / rate, "frame_rate": rate, "courant": 0.384}
    return cut(**(values | kw))


def left_by(scene: Scene, effects: Effects | None = None) -> tuple[list, Soil]:
    """All frames, and the soil after the last."""
    solver = Solver(scene, effects)
    return list(solver.frames()), solver.soil()


@pytest.mark.parametrize(
    "effects",
    [Effects(), Effects(symmetry=True), Effects(fluidity=True, nonlocality=True)],
    ids=["whole", "half", "nonlocal"],
)
def test_a_run_in_two_parts_is_bit_equal_to_one(effects):
    assert Solver(along(0, 8), effects).substeps_per_frame == 64
    whole, _ = left_by(along(0, 8), effects)
    _, soil = left_by(along(0, 3), effects)
    rest = list(Solver(along(3, 5), effects, start_from=soil).frames())
    assert len(rest) == 6
    for one, same in zip(rest, whole[3:], strict=True):
        np.testing.assert_array_equal(one.position, same.position)
        np.testing.assert_array_equal(one.velocity, same.velocity)
        np.testing.assert_array_equal(one.body_pose, same.body_pose)
        if one.index:
            np.testing.assert_array_equal(one.force, same.force)
            np.testing.assert_array_equal(one.torque, same.torque)
    assert np.abs(rest[-1].force).max() > 1.0


def test_a_periodic_run_in_two_parts_is_bit_equal_to_one():
    bed = slope().bed
    scene = Scene(bed=bed, material=slope().material, tilt=30.0, duration=0.2)
    whole, _ = left_by(scene)
    _, soil = left_by(replace(scene, duration=0.1))
    rest = list(Solver(replace(scene, duration=0.1), start_from=soil).frames())
    for one, same in zip(rest, whole[6:], strict=True):
        np.testing.assert_array_equal(one.position, same.position)


def test_soil_of_one_half_starts_a_whole_one():
    """A tool that is not symmetric follows one that was."""
    _, soil = left_by(along(0, 3), Effects(symmetry=True))
    half = list(Solver(along(3, 3), Effects(symmetry=True), start_from=soil).frames())
    whole = list(Solver(along(3, 3), Effects(), start_from=soil).frames())
    np.testing.assert_allclose(whole[0].position, half[0].position, atol=1e-7)
    np.testing.assert_array_equal(whole[0].velocity, half[0].velocity)
    for one, other in zip(whole, half, strict=True):
        np.testing.assert_allclose(one.position, other.position, atol=1e-6)
        np.testing.assert_allclose(one.force, other.force, atol=0.02)
    _, later = left_by(along(3, 3).starting_from(soil), Effects(symmetry=True))  # a third run
    assert later.state.whole is not None
    with pytest.raises(SceneError, match="soil to start from was not computed as one half"):
        Solver(along(3, 3), Effects(symmetry=True), start_from=left_by(along(0, 1))[1])


def test_a_wheel_that_has_settled_keeps_its_sinkage():
    scene = replace(wheel(), settle=0.249, duration=0.25)
    frames, soil = left_by(scene)
    driven = replace(scene, settle=0.0, duration=0.1)
    later = list(Solver(driven, start_from=soil).frames())
    assert later[0].body_pose[2] == frames[-1].body_pose[2] < frames[0].body_pose[2] - 1e-4
    assert abs(later[1].body_pose[2] - later[0].body_pose[2]) < 1e-4
    assert later[1].force[2] == pytest.approx(20.0, rel=0.2)  # its load, from the first frame on
    elsewhere = replace(driven, start=0.5)
    assert Solver(elsewhere, start_from=soil).scene.goes_on is False
    assert next(Solver(elsewhere, start_from=soil).frames()).body_pose[2] == elsewhere.poses_at(0.0)[0, 2]


def test_a_pile_that_has_settled_stays_at_rest_and_keeps_its_mass():
    bed = Bed(size=(0.4, 0.4, 0.06), spacing=0.02, particles_per_cell=4.0, headroom=0.04)
    column = Column(bed=bed, radius=0.08, duration=1.5, frame_rate=20.0)
    frames, soil = left_by(column)
    later = list(Solver(Scene(bed=bed, duration=0.5, frame_rate=20.0), start_from=soil).frames())
    longer = list(Solver(replace(column, duration=2.0)).frames())
    for one, same in zip(later, longer[30:], strict=True):
        np.testing.assert_array_equal(one.position, same.position)
    fell, crept = (np.linalg.norm(b - a, axis=1) for a, b in (moved(frames), moved(later)))
    assert np.sqrt(np.mean(crept**2)) < 0.04 * np.sqrt(np.mean(fell**2))


def moved(frames):
    """Positions at the beginning and at the end."""
    return frames[0].position, frames[-1].position


def test_a_new_tool_displaces_the_soil_that_it_is_in():
    _, soil = left_by(Scene(bed=cut().bed, duration=0.05))
    buried = cut(motion="rest", clearance=-0.05, duration=0.1).starting_from(soil)
    assert 0 < len(buried.displaced) == Preview.of(buried).displaced
    assert len(buried.initial_positions()) == len(soil.particles["position"]) - len(buried.displaced)
    assert len(list(Solver(buried).frames())) == 7
    above = cut(motion="rest", duration=0.1).starting_from(soil)
    assert len(above.displaced) == 0
    assert len({scene.arrangement_hash for scene in (buried, above, cut())}) == 3


def test_soil_goes_only_into_its_own_bed():
    _, soil = left_by(Scene(bed=cut().bed, duration=0.05))
    with pytest.raises(
        SceneError, match=r"scene.bed.spacing is 0.04, but 0.02 in the run to start from; leave it"
    ):
        Solver(
            cut(bed=replace(cut().bed, spacing=0.04), blade=replace(cut().blade, thickness=0.09)),
            start_from=soil,
        )
    with pytest.raises(SceneError, match=r"material.youngs_modulus is 2e"):
        cut(material=Material(youngs_modulus=2e6)).starting_from(soil)
    with pytest.raises(SceneError, match="a scene of the kind column has a start of its own"):
        Column().starting_from(soil)
    cut(bed=replace(cut().bed, headroom=0.2, store_every=2)).starting_from(soil)
    far = State(3, soil.state.arrays | {"position": np.full((3840, 3), 9.0)})
    with pytest.raises(
        SceneError, match=r"particle 0 of the soil to start from is outside the bin, at \(9, 9, 9\) m"
    ):
        cut().starting_from(Soil(soil.scene, far, soil.pose))
    with pytest.raises(SceneError, match="no frame yet"):
        Solver(cut()).soil()


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("stress", None, "it lacks stress"),
        ("velocity", np.zeros((4, 3)), r"velocity has shape \(4, 3\) and not \(3840, 3\)"),
        ("log_volume", np.full(3840, np.nan), "log_volume is not finite"),
        ("axle", np.zeros(2), "the height of its wheel and its rate are not three finite numbers"),
    ],
)
def test_soil_that_is_damaged_is_refused(name, value, words):
    _, soil = left_by(Scene(bed=cut().bed, duration=0.05))
    arrays = soil.state.arrays | {name: value}
    arrays = {key: array for key, array in arrays.items() if array is not None}
    with pytest.raises(SceneError, match=f"the soil to start from is not good: {words}"):
        Soil(soil.scene, State(soil.state.frame, arrays), soil.pose)
    with pytest.raises(SceneError, match="of another number of particles"):
        Soil(soil.scene, State(3, soil.state.arrays, np.arange(9)), soil.pose)


# --- Poses that are not known beforehand ----------------------------------------------------------------


@pytest.mark.parametrize(
    ("scene", "effects"),
    [
        (along(0, 6), Effects()),
        (along(0, 6), Effects(symmetry=True)),
        (replace(wheel(), frame_rate=64.0, courant=0.39, settle=0.0625), Effects()),
    ],
    ids=["cut", "half", "wheel"],
)
def test_steps_are_the_frames_of_the_same_path(scene, effects):
    frames = list(Solver(scene, effects).frames())
    solver = Solver(scene, effects)
    stepped = [solver.reset(), *(solver.step(pose) for pose in scene.body_poses()[1:])]
    again = [solver.reset(), *(solver.step(pose) for pose in scene.body_poses()[1:])]
    exact = "wheel" not in scene.kind  # whose rotation is not sampled from poses
    for one, same, third in zip(stepped, frames, again, strict=True):
        assert one.index == same.index and one.time == same.time
        compare = np.testing.assert_array_equal if exact else partial(np.testing.assert_allclose, atol=1e-4)
        for name in ("position", "velocity", "pose", "force", "torque"):
            compare(getattr(one, name), getattr(same, name))
            np.testing.assert_array_equal(getattr(one, name), getattr(third, name))
    np.testing.assert_array_equal(one.soil(), one.position)
    np.testing.assert_array_equal(next(solver.frames()).position, frames[0].position)  # which begins anew


def test_steps_go_on_beyond_the_scene_and_react():
    scene = cut(motion="rest", duration=0.05)
    solver = Solver(scene)
    pose, force = scene.body_poses()[0], 0.0
    for _ in range(12):
        pose = pose + np.array([0.002, 0.0, -0.001 if force > -5.0 else 0.001, 0.0, 0.0, 0.0, 0.0])
        state = solver.step(pose)
        force = state.force[0]
    assert state.index == 12 > scene.frame_count
    assert force < -1.0
    assert len(list(Solver(cut(motion="rest"), start_from=solver.soil()).frames())) == 13


def test_poses_that_a_step_refuses():
    scene = cut(motion="rest")
    solver, pose = Solver(scene, Effects(symmetry=True)), scene.body_poses()[0]
    before = solver.step(pose)
    for wrong, words in (
        (pose[:6], "it needs seven finite numbers"),
        (pose * np.nan, "it needs seven finite numbers"),
        (pose * 2.0, "a unit quaternion"),
        (pose + 0.01 * np.eye(7)[1], "leaves the plane at mid-width, .*effects.symmetry=false"),
        (
            pose + 0.5 * np.eye(7)[0],
            r"30 m/s for the fastest point; allowed: \d.* m/s .*: go there in more frames",
        ),
    ):
        with pytest.raises(SceneError, match=words):
            solver.step(wrong)
    after = solver.step(pose)
    assert (before.index, after.index) == (1, 2)
    with pytest.raises(SceneError, match="no tool to move"):
        Solver(Scene(bed=cut().bed)).step(pose)
