"""Paths, and the kinds of scenes that move a tool."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from mpm_warp import (
    Bed,
    Body,
    Box,
    Effects,
    Material,
    Scene,
    SceneError,
    Solver,
    SolverStopped,
    Wheel,
    effects_for,
    substeps_per_frame,
)
from mpm_warp.discretisation import asymmetry
from mpm_warp.effects import expected_flow
from mpm_warp.limits import PhysicalLimits, top_body_speed
from mpm_warp.motions import along_and_across
from mpm_warp.poses import about_y, rotate, sampled_poses
from mpm_warp.rigid_body import stable_step
from sgns_testing.scenes import UNDAMPED, BlockBed, block, cut
from sgns_testing.solvers import momenta

# --- Paths ------------------------------------------------------------------------------------------


def test_sampled_path_interpolates_and_rests_at_its_ends():
    quarter = about_y(np.pi / 2)
    path = [[1.0, 0, 0, 0, 0, 0, 0, 1], [3.0, 2, 0, -1, *quarter]]
    poses = sampled_poses(np.array(path), np.array([0.0, 1.0, 2.0, 3.0, 9.0]))
    np.testing.assert_allclose(poses[:, 0], [0, 0, 1, 2, 2])
    np.testing.assert_allclose(poses[2, 3:], about_y(np.pi / 4), atol=1e-12)
    np.testing.assert_allclose(poses[0], path[0][1:])
    np.testing.assert_allclose(poses[4], path[1][1:], atol=1e-12)
    alone = sampled_poses(np.array(path[:1]), np.array([0.0, 5.0]))
    np.testing.assert_allclose(alone, [path[0][1:]] * 2)


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


def test_turns_along_a_path_are_scipys():
    a = Rotation.random(20, rng=np.random.default_rng(0))
    v = np.random.default_rng(2).normal(size=(20, 3))
    np.testing.assert_allclose(rotate(a.as_quat(), v), a.apply(v), atol=1e-12)
    path = np.column_stack([np.arange(20.0), np.zeros((20, 3)), a.as_quat()])
    time = np.linspace(0.0, 19.0, 100)
    turned = Rotation.from_quat(sampled_poses(path, time)[:, 3:])
    assert (turned * Slerp(path[:, 0], a)(time).inv()).magnitude().max() < 1e-9


def turning(*rows: tuple[float, float], **kw) -> Body:
    """A box in the bed of `cut`, turned about its middle by angles [degrees] at times [s]."""
    path = tuple((t, 0.24, 0.2, 0.02, *about_y(math.radians(angle))) for t, angle in rows)
    return Body(bed=cut().bed, tool=Box(size=(0.1, 0.1, 0.06)), path=path, **({"duration": 0.1} | kw))


def test_the_fastest_point_counts():
    """Sixty turns a second, each from one frame to the next, where nothing is seen of them."""
    scene = turning(*((quarter / 240.0, 90.0 * quarter) for quarter in range(25)))
    np.testing.assert_allclose(scene.body_poses()[0], np.abs(scene.body_poses()[3]), atol=1e-12)
    rim = 120.0 * math.pi * scene.tool.reach
    assert top_body_speed(scene) == pytest.approx(rim)
    assert substeps_per_frame(scene) > 2 * substeps_per_frame(turning((0.0, 0.0)))
    assert PhysicalLimits(scene, 1e-4).top_speed > 4.0 * rim
    np.testing.assert_allclose(expected_flow(scene).speed, rim)


def test_a_guard_knows_how_fast_a_path_is_between_frames():
    """A tenth of a turn within a millisecond, in a frame of 17 ms."""
    scene = turning((0.0, 0.0), (0.051, 0.0), (0.052, 36.0), (0.1, 36.0))
    way = math.radians(36.0) * scene.tool.reach
    assert top_body_speed(scene) == pytest.approx(60.0 * way)
    for step, fastest in ((1e-4, 1e3 * way), (1e-3, 1e3 * way), (2e-3, 5e2 * way)):
        assert top_body_speed(scene, step) == pytest.approx(fastest)


def sampled(*rows: tuple[float, float, float], **kw) -> Scene:
    """The blade of `cut` along x and z [m] at times [s]."""
    return cut(motion="path", path=tuple((t, x, 0.2, z, 0, 0, 0, 1) for t, x, z in rows), **kw)


SPINNING = Wheel(bed=cut().bed, duration=0.05, settle=0.0, slip=1.0, rim_speed=3000.0, **UNDAMPED)
TURNING = (
    r"the body .* turns by {} degrees within substep .* of frame 2, .* at 0\.0(19|20).* allowed: 0\.01 m"
)


@pytest.mark.parametrize(
    ("scene", "frames", "words"),
    [
        (turning((0.0, 0.0), (0.02, 0.0), (0.020000001, 90.0)), 2, TURNING.format(90)),
        # Back where they were before the substep ends.
        (turning((0, 0), *((0.02 + 1e-10 * k, 90.0 * k) for k in range(5))), 2, TURNING.format(360)),
        (
            sampled((0, 0.2, 0.2), (1e-5, 0.2, 0.2), (1.1e-5, 0.22, 0.2), (1.2e-5, 0.2, 0.2), duration=0.05),
            1,
            r"the body jumps by 0.04 m .* at 0.00000 s",
        ),
        # So fast that no step is short enough; a wheel's poses show no whole turns.
        (SPINNING, 1, r"the body jumps by 0 m .* half a grid spacing"),
    ],
    ids=["quarter", "whole turn", "there and back", "wheel"],
)
def test_a_body_that_jumps_stops_the_solver(scene, frames, words):
    good = []
    with pytest.raises(SolverStopped, match=words) as caught:
        good.extend(frame.index for frame in Solver(scene).frames())
    assert good == list(range(frames))
    assert "\n" not in str(caught.value)


def test_top_speeds():
    slow, straight = Wheel(bed=cut().bed, **UNDAMPED), cut()
    assert top_body_speed(slow) == pytest.approx(slow.speed + slow.angular_speed * slow.body.reach)
    step = np.linalg.norm(np.diff(straight.body_poses()[:, :3], axis=0), axis=1)
    assert top_body_speed(straight) == step.max() * straight.frame_rate
    assert top_body_speed(Scene()) == 0.0


def test_a_path_that_leaves_the_bin_between_frames():
    heights = [(0.0, 0.2), (0.04, 0.2), (0.042, -0.1), (0.044, 0.2)]
    with pytest.raises(SceneError, match=r"the plate leaves the bin at 0\.042 s"):
        sampled(*((t, 0.24, z) for t, z in heights))
    sampled(*((t + 0.5, 0.24, z) for t, z in heights))  # the scene ends before


def test_a_path_that_passes_through_a_wall_between_two_rows():
    """At both rows all that is below the surface is within the bin; half-way a corner has come through the wall."""
    path = ((0.0, -0.1, 0.2, 0.032, 0, 0, 0, 1), (0.01, 0.3, 0.2, 0.0, 0, 0, 0, 1))
    with pytest.raises(
        SceneError, match=r"the body leaves the bin at 0\.00\d s: x = -0\.\d+ m, allowed 0 to"
    ):
        Body(bed=cut().bed, tool=Box(size=(0.1, 0.1, 0.06)), path=path, duration=0.1)
    # A turn by half a circle: at its ends the box is along y, half-way it sticks out along x.
    turn = tuple(
        (t, 0.06, 0.2, 0.0, *Rotation.from_euler("z", a, degrees=True).as_quat())
        for t, a in ((0, 0), (0.01, 179))
    )
    with pytest.raises(SceneError, match=r"the body leaves the bin at 0\.00\d s: x = -0\.0"):
        Body(bed=cut().bed, tool=Box(size=(0.06, 0.2, 0.06)), path=turn, duration=0.1)


# --- The wheel: its motion, its load, and what the soil does to it --------------------------------------


def wheel(**kw) -> Wheel:
    """A small wheel on a coarse bed: 1 200 particles."""
    values = {
        "bed": Bed(size=(0.30, 0.16, 0.08), spacing=0.02, particles_per_cell=2.5, headroom=0.1),
        "diameter": 0.12,
        "load": 60.0,
        "friction_angle": None,
        "damping": 20.0,
        "rim_speed": 0.1,
        "settle": 0.4,
        "start": 0.4,
        "contact_margin": -0.37,  # contact begins when a particle's centre is at the surface
    }
    values |= kw
    values.setdefault("duration", values["settle"] + 1.0 / 60.0)
    return Wheel(**values)


def test_a_raked_square_end_drags_and_an_edge_does_not():
    """Four cells of a plate at 30 degrees: 185, 91 and 26 N."""
    draft = {}
    for edge in ("square", "level", "bevel"):
        scene = cut(blade=replace(cut().blade, edge=edge), rake=30.0, duration=0.4)
        frames = Solver(scene, Effects(symmetry=True, torque=False)).frames()
        draft[edge] = -np.mean([frame.force[0] for frame in frames])
    assert 1.0 < draft["bevel"] < 0.5 * draft["level"] < 0.35 * draft["square"]


def test_slip_kinematics():
    """Rest, then constant speeds with slip 1 - v / (w R); the lowest point of a forward wheel moves backwards."""
    scene = wheel(slip=0.25, settle=0.5, duration=1.5)
    poses = scene.poses_at(np.array([0.0, 0.5, 1.0, 1.5]))
    np.testing.assert_allclose(np.diff(poses[:, 0]), [0.0, 0.0375, 0.0375], atol=1e-12)
    np.testing.assert_array_equal(poses[0], poses[1])
    spun = rotate(poses[:, 3:], np.array([0.0, 0.0, -1.0]))
    angle = np.arctan2(-spun[:, 0], -spun[:, 2])
    np.testing.assert_allclose(angle, [0, 0, 0.1 / 0.06 * 0.5, 0.1 / 0.06], atol=1e-12)
    assert 1.0 - scene.speed / (scene.angular_speed * 0.06) == pytest.approx(0.25)
    assert wheel(gravity=1.62).axle.mass * 1.62 == pytest.approx(scene.load)


@pytest.mark.parametrize(
    ("rim", "travel", "slip"),
    [
        (0.0, 0.1, -1.0),
        (0.05, 0.1, -0.5),
        (0.1, 0.1, 0.0),
        (0.1, 0.05, 0.5),
        (0.1, 0.0, 1.0),
        (0.0, 0.0, 0.0),
    ],
)
def test_travel_and_rim_speed_each_on_its_own(rim, travel, slip):
    """From a locked wheel to one that turns on the spot; what `slip` says is theirs."""
    scene = wheel(rim_speed=rim, travel_speed=travel, slip=0.3, settle=0.5, duration=1.5)
    assert scene.slip == pytest.approx(slip)
    assert Scene.from_dict(scene.to_dict()) == scene
    poses = scene.poses_at(np.array([0.5, 1.5]))
    np.testing.assert_allclose(poses[1, 0] - poses[0, 0], travel, atol=1e-12)
    np.testing.assert_allclose(np.diff(rotation_angles(poses)), rim / 0.06, atol=1e-12)


def rotation_angles(poses):
    """About a wheel's own axle [rad]."""
    return 2.0 * np.arctan2(np.hypot(poses[:, 3], poses[:, 4]), np.hypot(poses[:, 5], poses[:, 6]))


@pytest.mark.parametrize("angle", [-90.0, -30.0, 0.0, 45.0, 90.0])
def test_a_slip_angle_turns_the_wheel_and_not_its_travel(angle):
    scene = wheel(bed=WIDE, slip_angle=angle, slip=0.25, settle=0.0, duration=1.0)
    poses = scene.body_poses()
    np.testing.assert_allclose(poses[-1, :2] - poses[0, :2], [0.075, 0.0], atol=1e-12)
    axle = np.tile([0.0, 1.0, 0.0], (len(poses), 1))
    a = math.radians(angle)
    np.testing.assert_allclose(
        rotate(poses[:, 3:], axle), np.tile([-np.sin(a), np.cos(a), 0.0], (len(poses), 1)), atol=1e-12
    )
    np.testing.assert_allclose(rotation_angles(poses)[-1], 0.1 / 0.06, atol=1e-12)
    # A force along its heading and one along its axle are found again, exactly.
    own = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    turn = scene.poses_at(np.zeros(1))[0, 3:]
    np.testing.assert_allclose(along_and_across(scene.to_dict(), rotate(turn, own)), own, atol=1e-15)
    assert (asymmetry(scene) is None) == (angle == 0.0)


WIDE = Bed(size=(0.30, 0.24, 0.08), spacing=0.02, particles_per_cell=4.0, headroom=0.1)


def turned(angle, **kw):
    """Forces and torques along 5 cm of travel, and in its last part their means in the wheel's own axes."""
    values = {"bed": WIDE, "slip_angle": angle, "travel_speed": 0.2, "settle": 0.1, "duration": 0.35} | kw
    scene = wheel(**values)
    frames = list(Solver(scene, effects_for(scene)[0], precision="float64").frames())
    force, torque = (np.array([getattr(f, k) for f in frames]) for k in ("force", "torque"))
    means = [along_and_across(scene.to_dict(), a[-8:].mean(axis=0)) for a in (force, torque)]
    return force, torque, *means


def test_a_wheel_turned_the_other_way_feels_the_mirrored_forces():
    one, moment, _, _ = turned(40.0, rim_speed=0.05)
    other, counter, _, _ = turned(-40.0, rim_speed=0.05)
    assert one[:, 1].max() > 1.0
    np.testing.assert_allclose(other, one * [1, -1, 1], atol=1e-6 * np.abs(one).max())
    np.testing.assert_allclose(counter, moment * [-1, 1, -1], atol=1e-6 * np.abs(moment).max())


def test_a_locked_wheel_pushed_sideways_is_a_blade():
    """Soil pushes it along its axle only; by symmetry it neither pulls nor turns it about the axle."""
    _, _, (pull, lateral, vertical), (_, drive, _) = turned(90.0, rim_speed=0.0)
    assert lateral > 0.5 * vertical > 0.0
    assert abs(pull) < 1e-6 * lateral
    assert abs(drive) < 1e-6 * lateral


def test_a_locked_wheel_is_held_back_more_than_one_that_rolls():
    _, _, locked, braking = turned(0.0, rim_speed=0.0)
    _, _, rolling, _ = turned(0.0, rim_speed=0.2)
    assert locked[0] < -0.1 * locked[2] < rolling[0]
    assert braking[1] > 0.0  # the soil would turn it


def test_a_load_over_time_is_carried():
    """The vertical force at rest follows it; the mass is that of the largest."""
    loads = ((0.0, 40.0), (0.6, 40.0), (0.7, 80.0))
    scene = wheel(load=loads, start=0.5, settle=1.2)
    assert scene.axle.mass * 9.81 == pytest.approx(80.0)
    assert Scene.from_dict(scene.to_dict()) == scene
    force = np.array([f.force[2] for f in Solver(scene).frames()])
    assert force[18:36].mean() == pytest.approx(40.0, rel=0.02)
    assert force[54:72].mean() == pytest.approx(80.0, rel=0.02)


def test_a_load_over_time_drives_a_free_fall():
    """Half the load of its mass: half of gravity."""
    fall = {"clearance": 0.05, "damping": 0.0, "settle": 1.0 / 12.0}
    full, half = (
        [f.body_pose[2] for f in Solver(wheel(load=load, **fall)).frames()]
        for load in (60.0, ((0.0, 30.0), (1.0, 30.0), (2.0, 60.0)))
    )
    assert full[0] - full[-1] == pytest.approx(2.0 * (half[0] - half[-1]), rel=1e-12)


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_free_fall_of_a_wheel_is_exact(precision):
    """Symplectic Euler, in double precision whatever the solver's: z falls by g dt^2 n (n + 1) / 2."""
    scene = wheel(clearance=0.05, damping=0.0, settle=1.0 / 12.0)
    solver = Solver(scene, precision=precision)
    frames = list(solver.frames())
    n = (scene.frame_count - 1) * solver.substeps_per_frame
    drop = frames[0].body_pose[2] - frames[-1].body_pose[2]
    assert 0.03 < drop
    assert drop == pytest.approx(9.81 * solver.time_step**2 * n * (n + 1) / 2, rel=1e-12)
    nodes = frames[-1].body_points[:, 2].mean()
    assert nodes == pytest.approx(frames[-1].body_pose[2])
    assert not frames[-1].force.any()


def test_damped_fall_reaches_its_terminal_speed():
    """g / damping, exactly, for the damping is implicit."""
    scene = wheel(clearance=0.05, damping=500.0, settle=0.2)
    z = [f.body_pose[2] for f in Solver(scene).frames()]
    assert 60.0 * (z[-2] - z[-1]) == pytest.approx(9.81 / 500.0, rel=1e-6)


@pytest.mark.parametrize("kw", [{}, {"gravity": 1.62, "settle": 1.0}, {"bilateral": True, "friction": 3.0}])
def test_a_wheel_at_rest_carries_its_load(kw):
    # Anywhere else the lattice is not the same on both sides, and friction holds that.
    scene = wheel(start=0.5, **kw)
    frames = list(Solver(scene).frames())
    rest = frames[len(frames) // 2 : -1]  # in the last one it is driven
    force = np.mean([f.force for f in rest], axis=0)
    assert force[2] == pytest.approx(scene.load, rel=0.02)
    assert np.abs(force[:2]).max() < 0.002 * scene.load
    z = np.array([f.body_pose[2] for f in rest])
    assert np.ptp(z) < 0.002
    assert 0.0 < scene.sinkage(frames[-1].body_pose[None])[0] < 0.03


def test_soil_resists_the_rotation_and_pulls_the_wheel_forward():
    """Driving for 0.6 s at 40 % slip, in double precision."""
    scene = wheel(slip=0.4, settle=0.2, duration=0.8)
    frames = list(Solver(scene, precision="float64").frames())
    forces, torques = (np.array([getattr(f, k) for f in frames]) for k in ("force", "torque"))
    force, torque = forces[30:].mean(axis=0), torques[30:].mean(axis=0)
    assert torque[1] < -0.1 * scene.load * 0.06
    assert abs(torque[1]) <= scene.friction * scene.load * 0.06 * 1.2
    assert force[0] > 0.0  # at 40 % slip on friction 0.75 traction exceeds the resistance
    assert force[2] == pytest.approx(scene.load, rel=0.05)
    # Nothing pulls it sideways.
    assert np.abs(forces[:, 1]).max() < 1e-8 * np.abs(forces).max()
    assert np.abs(torques[:, [0, 2]]).max() < 1e-8 * np.abs(torques).max()


def test_momentum_goes_from_the_wheel_to_the_soil():
    """A wheel falls on a free block: both lose to gravity only, and one gains what the other loses."""
    bed = replace(block().bed, low=(0.1, 0.1, -0.1), high=(0.2, 0.2, 0.0))
    times = {"settle": 0.02, "duration": 0.04, "frame_rate": 100.0}
    scene = wheel(bed=bed, load=5.0, damping=0.0, start=0.5, slip=0.9, clearance=-0.004, **times)
    solver = Solver(scene, precision="float64")
    frames = list(solver.frames())
    time = scene.duration
    impulse = sum(f.force for f in frames) / scene.frame_rate
    assert np.linalg.norm(impulse) > 1e-3
    soil, _ = momenta(solver)
    mass = solver.particle_count * solver.grid.particle_mass
    np.testing.assert_allclose(
        soil + mass * 9.81 * time * np.array([0, 0, 1]), -impulse, atol=1e-10 * np.linalg.norm(impulse)
    )
    speed = solver.body._axle.numpy()[1]
    assert scene.axle.mass * (speed + 9.81 * time) == pytest.approx(impulse[2], rel=1e-10)


def test_bilateral_contact_holds_soil_that_a_separable_one_lets_go():
    """A wheel that rotates on the spot while it is let up: only held soil pulls it down."""
    lifted = {}
    for bilateral in (False, True):
        scene = wheel(bilateral=bilateral, settle=0.2)
        solver = Solver(scene)
        frames = solver.frames()
        for _ in range(10):
            next(frames)
        solver.body._axle.assign([solver.body._axle.numpy()[0], 0.5, 0.0])
        lifted[bilateral] = next(frames).force[2]
    assert lifted[False] >= 0.0
    assert lifted[True] < -1.0


def test_a_wheel_much_lighter_than_its_soil_is_stable():
    """0.3 kg on up to 150 springs made for particles of 6 g: shorter steps, and it rests."""
    light = wheel(load=3.0, settle=0.3)
    solver = Solver(light)
    assert solver.substeps_per_frame > 4 * Solver(wheel()).substeps_per_frame
    frames = list(solver.frames())
    z = np.array([f.body_pose[2] for f in frames])
    assert np.abs(z - z[0]).max() < 0.02
    assert np.mean([f.force[2] for f in frames[10:]]) == pytest.approx(3.0, rel=0.05)


def test_the_stable_step_is_stable_and_not_far_from_the_limit():
    """A mass on many springs under symplectic Euler with a lagged damper."""

    def grows(dt):
        x, v = 1.0, 0.0
        for _ in range(2000):
            v += dt * (-n * k * x - n * c * v) / mass
            x += dt * v
            if abs(x) > 1e6:
                return True
        return False

    for mass, n, k, c in ((1.0, 50, 1e4, 6.0), (0.01, 50, 1e4, 6.0), (0.01, 50, 1e4, 0.0)):
        dt = stable_step(mass, n, k, c)
        assert not grows(dt)
        assert grows(2.1 * dt)


def test_a_wheel_that_reaches_the_floor_stops_the_run():
    empty = BlockBed(size=(0.3, 0.16, 0.08), spacing=0.02, low=(0, 0, -0.08), high=(0.02, 0.02, -0.06))
    with pytest.raises(SolverStopped, match=r"the body reached the floor of the bin by 0\.1\d+ s"):
        list(Solver(wheel(bed=empty, damping=0.0)).frames())


def test_a_wheels_friction_angle_is_its_soils():
    assert wheel(friction_angle=45.0).material == Material(friction_angle=45.0)
    own = Material(static_friction=0.5, limit_friction=0.6)
    assert wheel(material=own).material == own


def test_grousers_raise_the_wheel_and_warn_when_thin():
    scene = wheel(grousers=12, grouser_height=0.01, grouser_thickness=0.004)
    assert scene.body_poses()[0, 2] == pytest.approx(0.07)
    assert any("0.20 grid spacings thick" in w for w in scene.warnings())


def test_a_wheels_summary_leaves_the_settling_out():
    scene = wheel(settle=0.1, duration=0.2)
    poses = scene.body_poses()
    force, torque = np.zeros((len(poses), 3)), np.zeros((len(poses), 3))
    force[:7] = 1000.0
    force[7:], torque[7:, 1] = [2.0, 0.0, 60.0], -0.5
    words = scene.summary(force, torque, poses)
    assert "drawbar pull 2.00 N, vertical force 60.00 N" in words
    assert "torque -0.500 N m" in words
    assert scene.results(force, torque, poses) == pytest.approx(
        {
            "mean_pull_N": 2.0,
            "mean_lateral_force_N": 0.0,
            "mean_vertical_force_N": 60.0,
            "mean_sinkage_mm": 1e3 * scene.sinkage(poses)[7:].mean(),
            "mean_torque_Nm": -0.5,
        }
    )


def test_a_wheel_that_only_settles_has_no_means_of_driving():
    scene = wheel(settle=0.195, duration=0.2)
    poses = scene.body_poses()
    poses[-1, 2] -= 0.004
    force = np.ones((len(poses), 3))
    assert (scene.results(force, force, poses), scene.summary(force, force, poses)) == ({}, "")
    assert scene.mean_sinkage(poses) == pytest.approx(scene.sinkage(poses)[-1])


def test_the_summary_of_a_turned_wheel_is_in_its_own_axes():
    scene = wheel(bed=WIDE, slip_angle=90.0, settle=0.1, duration=0.2)
    poses = scene.body_poses()
    force, torque = np.tile([-7.0, 2.0, 60.0], (len(poses), 1)), np.tile([0.5, 0.0, 0.0], (len(poses), 1))
    words = scene.summary(force, torque, poses)
    assert "drawbar pull 2.00 N, lateral force 7.00 N, vertical force 60.00 N" in words
    assert "torque -0.500 N m" in words


@pytest.fixture(scope="module")
def driven():
    """Driving for 0.6 s at 40 % slip, in double precision."""
    scene = wheel(slip=0.4, settle=0.2, duration=0.8)
    return scene, list(Solver(scene, precision="float64").frames())


def test_poses_hold_the_computed_height(driven):
    scene, frames = driven
    poses = np.array([f.body_pose for f in frames])
    planned = scene.body_poses()
    np.testing.assert_allclose(poses[:, [0, 1, 3, 4, 5, 6]], planned[:, [0, 1, 3, 4, 5, 6]], atol=1e-12)
    assert poses[-1, 2] < planned[-1, 2]
    middle = np.array([f.body_points.mean(axis=0) for f in frames])
    np.testing.assert_allclose(middle, poses[:, :3], atol=1e-9)


def test_a_wheel_says_which_of_two_settings_it_does_not_use():
    assert not wheel().warnings()
    [words] = wheel(material=Material(friction_angle=40.0), friction_angle=37.0).warnings()
    assert "material.friction_angle 40 is not used: scene.friction_angle 37" in words
    [words] = wheel(material=Material(static_friction=0.38), friction_angle=37.0).warnings()
    assert (
        "because scene.friction_angle 37 degrees (tan)" in words and "set scene.friction_angle=null" in words
    )
    [words] = wheel(slip=0.4, rim_speed=0.1, travel_speed=0.1).warnings()
    assert "scene.slip 0.4 is not used: travel_speed and rim_speed make it 0" in words
    rim = float(re.search(r"scene.rim_speed=([\d.]+) makes it 0.4", words)[1])
    assert wheel(slip=0.2, rim_speed=rim, travel_speed=0.1).slip == pytest.approx(0.4, abs=1e-3)
    scene = wheel(material=Material(friction_angle=40.0), friction_angle=37.0, slip=0.4, travel_speed=0.1)
    assert not Scene.from_dict(scene.to_dict()).warnings()
    assert wheel(material=Material(friction_angle=40.0), friction_angle=None).material.friction_angle == 40.0
