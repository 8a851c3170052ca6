"""Further bodies in the soil: free in six degrees of freedom, on a path, or following the scene's own body."""

import math
import re

import numpy as np
import pytest

from mpm_warp import (
    Bed,
    Body,
    Box,
    Cylinder,
    Effects,
    MeshBody,
    Other,
    Preview,
    Scene,
    SceneError,
    Solver,
    SolverStopped,
    Sphere,
    Wheel,
    effects_for,
)
from mpm_warp.poses import rotate, rotation_matrices
from mpm_warp.rigid_body import longest_step
from sgns_testing.meshes import box_corners, box_triangles
from sgns_testing.scenes import block, cut
from sgns_testing.solvers import assert_same_frames, momenta

BED = Bed(size=(0.16, 0.16, 0.06), spacing=0.01, particles_per_cell=4.0, headroom=0.05)
COARSE = Bed(size=(0.16, 0.16, 0.08), spacing=0.04, headroom=0.08)
ELASTIC = Effects(yielding=False, rate_dependence=False, separation=False)


def free(tool=None, **values) -> Other:
    return Other(**({"tool": tool or Sphere(diameter=0.05), "position": (0.08, 0.08, 0.025)} | values))


def scene(*others: Other, **values) -> Scene:
    return Scene(**({"bed": BED, "duration": 0.1, "frame_rate": 50.0, "others": others} | values))


def motion(solver) -> np.ndarray:
    """Place, quaternion, velocity, angular momentum of the first further body."""
    return solver.state().arrays["others_0_motion"]


SIZE, AWRY = (0.06, 0.05, 0.03), np.array([0.5, 0.1, -0.3, math.sqrt(0.65)])


def mesh_box(size=SIZE, rotation=(0.0, 0.0, 0.0, 1.0)) -> MeshBody:
    """A box, turned in its file: its axes are not those of the box."""
    corners = box_corners(size, -0.5 * np.array(size))
    return MeshBody.of_mesh(rotate(np.array([rotation]), corners), box_triangles())


def in_air(courant: float, tool) -> tuple[Solver, list]:
    one = free(tool, position=(0.08, 0.08, 0.3), velocity=(0.1, -0.2, 0.5), spin=(8.0, 1.0, 9.0), density=1e5)
    solver = Solver(scene(one, bed=COARSE, courant=courant), ELASTIC, precision="float64")
    return solver, list(solver.frames())


def test_a_body_in_the_air_falls_freely() -> None:
    solver, frames = in_air(0.6, Box(size=(0.06, 0.09, 0.02)))
    n, dt = 5 * solver.substeps_per_frame, solver.time_step
    pull = np.array([0.0, 0.0, -9.81])
    wanted = np.array([0.08, 0.08, 0.3]) + 0.1 * np.array([0.1, -0.2, 0.5]) + 0.5 * n * (n + 1) * dt**2 * pull
    np.testing.assert_allclose(frames[-1].other_poses[0, :3], wanted, rtol=0, atol=1e-13)
    assert not frames[-1].other_forces.any()


@pytest.mark.parametrize("tool", [Box(size=(0.06, 0.09, 0.02)), mesh_box((0.06, 0.09, 0.02), AWRY)], ids=repr)
def test_a_turning_body_keeps_angular_momentum_and_to_second_order_its_energy(tool) -> None:
    lost = []
    for courant in (0.6, 0.3):
        solver, _ = in_air(courant, tool)
        (one,) = solver.scene.companions
        start = one.inertia @ np.array([8.0, 1.0, 9.0])
        np.testing.assert_allclose(motion(solver)[10:13], start, rtol=1e-14)
        in_body = motion(solver)[10:13] @ rotation_matrices(motion(solver)[3:7])
        energy = (in_body @ np.linalg.solve(one.inertia, in_body)) / (
            start @ np.linalg.solve(one.inertia, start)
        )
        lost.append(abs(energy - 1.0))
    assert lost[0] < 1e-5
    assert 3.0 < lost[0] / lost[1] < 5.0


@pytest.mark.parametrize(("tool", "threads"), [(None, 1), (None, 2), (mesh_box(SIZE, AWRY), 1)], ids=str)
def test_a_body_and_the_soil_that_it_hits_keep_their_momentum(tool, threads: int) -> None:
    one = free(tool, position=(0.145, 0.155, -0.05), velocity=(0.0, 0.0, -1.0), spin=(5.0, 0.0, 0.0))
    solver = Solver(block(others=(one,)), precision="float64", threads=threads)
    frames = list(solver.frames())
    (body,) = solver.scene.companions
    state = motion(solver)
    linear, angular = momenta(solver)
    assert state[9] > -0.9  # it was slowed
    np.testing.assert_allclose(
        linear + body.mass * state[7:10], [0.0, 0.0, -body.mass], rtol=0, atol=1e-12 * body.mass
    )
    whole = angular + state[10:13] + body.mass * np.cross(state[:3], state[7:10])
    before = body.mass * np.cross(one.position, one.velocity) + body.inertia @ one.spin
    np.testing.assert_allclose(whole, before, rtol=0, atol=2e-3 * np.abs(before).max())
    given = sum(frame.other_forces[0] for frame in frames) / solver.scene.frame_rate
    np.testing.assert_allclose(body.mass * (state[7:10] - one.velocity), given, atol=1e-12)


def test_a_free_mesh_moves_as_the_box_that_it_is() -> None:
    """Also if the box is turned in the file, and turned back at the start."""
    start = {"position": (0.08, 0.07, 0.03), "velocity": (0.2, 0.0, -1.0), "spin": (4.0, -6.0, 5.0)}
    start |= {"density": 20_000.0}  # which asks for no shorter steps
    found = []
    for tool, rotation in (
        (Box(size=SIZE), (0.0, 0.0, 0.0, 1.0)),
        (mesh_box(), (0.0, 0.0, 0.0, 1.0)),
        (mesh_box(SIZE, AWRY), (*-AWRY[:3], AWRY[3])),
    ):
        solver = Solver(scene(free(tool, rotation=rotation, **start), duration=0.06), precision="float64")
        found.append(list(solver.frames()))
    assert max(np.abs(frame.other_forces).max() for frame in found[0]) > 5.0
    for frames in found[1:]:
        for one, two in zip(frames, found[0], strict=True):
            np.testing.assert_allclose(one.other_poses[0, :3], two.other_poses[0, :3], atol=1e-7)
            np.testing.assert_allclose(one.position, two.position, atol=1e-6)
            np.testing.assert_allclose(one.other_forces, two.other_forces, atol=1e-2)
    turned, box = found[2][-1].other_poses[0, 3:], found[0][-1].other_poses[0, 3:]
    np.testing.assert_allclose(
        rotation_matrices(turned) @ rotation_matrices(AWRY), rotation_matrices(box), atol=1e-5
    )


def test_what_is_said_of_further_bodies_before_a_run() -> None:
    turn = (0.0, 0.0, 0.0, 1.0)
    rows = ((0.0, 0.05, 0.08, 0.05, *turn), (0.1, 0.08, 0.08, 0.005, *turn))
    path = {"tool": mesh_box(), "motion": "path"}
    light = free(mesh_box(), position=(0.08, 0.08, 0.1), density=100.0)
    found = Preview.of(scene(light, Other(path=rows, **path)))
    free_one, origin, way = found.lines
    assert (
        free_one
        == "scene.others[0] is free and has 0.009 kg; its lowest point begins 85 mm above the surface"
    )
    assert origin.startswith(
        "the path is that of scene.others[1]'s centre of mass; around it scene.others[1] reach"
    )
    assert way.startswith(
        "scene.others[1]: its lowest point gets 10 mm deep (at 0.10 s); it first touches soil at"
    )
    (words,) = found.warnings
    assert re.match(
        r"scene.others\[0\] is so light that the run takes [\d.]+ times as many steps as the soil", words
    )
    for rows, words in (
        (
            ((0.0, 0.08, 0.08, 0.1, *turn),),
            "scene.others[0] never touches soil: its lowest point stays 85 mm above",
        ),
        (((0.0, 0.08, 0.08, -0.04, *turn),), "scene.others[0]'s lowest point comes to 5 mm above the floor"),
        (
            ((5.0, 0.08, 0.08, 0.0, *turn), (6.0, 0.08, 0.08, 0.01, *turn)),
            "the path's times are 5 to 6, the run's 0 to 0.1 s: scene.others[0] does not move",
        ),
    ):
        assert any(one.startswith(words) for one in Preview.of(scene(Other(path=rows, **path))).warnings), (
            words
        )
    thin = free(mesh_box((0.06, 0.05, 0.004)), position=(0.08, 0.08, 0.1))
    assert Preview.of(scene(thin)).warnings[0].startswith("scene.others[0]'s thinnest part is 4 mm")
    millimetres = ((0.0, 50.0, 80.0, 90.0, *turn), (0.1, 80.0, 80.0, 90.0, *turn))
    assert "look like millimetres" in Preview.of(scene(Other(path=millimetres, **path))).not_meant[0]


def test_a_mesh_on_a_path_is_pushed_as_its_box() -> None:
    rows = tuple((t, 0.05 + 0.3 * t, 0.08, 0.0, 0.0, 0.0, 0.0, 1.0) for t in (0.0, 0.1))
    forces = []
    for tool in (Box(size=SIZE), mesh_box()):
        frames = list(Solver(scene(Other(tool=tool, motion="path", path=rows))).frames())
        forces.append([frame.other_forces[0] for frame in frames])
    assert np.abs(forces[0]).max() > 4.0
    np.testing.assert_allclose(*forces, atol=0.05)


def test_the_steps_that_a_light_mesh_needs() -> None:
    """A hollow one has less mass, and more surface."""

    def step(tool) -> float:
        return longest_step(scene(free(tool, position=(0.08, 0.08, 0.2))).companions[0])

    assert step(mesh_box()) == pytest.approx(step(mesh_box(SIZE, AWRY)))
    assert step(Box(size=SIZE)) < step(mesh_box()) < 1.5 * step(Box(size=SIZE))
    shell = box_corners(SIZE, -0.5 * np.array(SIZE)), box_triangles()
    hollow = MeshBody.of_mesh(
        np.concatenate([shell[0], 0.8 * shell[0]]), np.concatenate([shell[1], shell[1][:, ::-1] + 8])
    )
    assert step(hollow) < 0.7 * step(mesh_box())


@pytest.mark.parametrize(
    "tool", [pytest.param(Sphere(diameter=0.05), marks=pytest.mark.long), Box(size=(0.06, 0.06, 0.04))]
)
def test_a_body_at_rest_weighs_on_the_soil_what_it_weighs(tool) -> None:
    one = free(tool, position=(0.08, 0.08, tool.half_size[2]))
    solver = Solver(scene(one, duration=0.4))
    frames = list(solver.frames())
    weight = solver.scene.companions[0].mass * 9.81
    force = np.mean([frame.other_forces[0] for frame in frames[-5:]], axis=0)
    assert force[2] == pytest.approx(weight, rel=0.02)
    assert np.abs(force[:2]).max() < 0.02 * weight
    assert 0.0 < tool.half_size[2] - frames[-1].other_poses[0, 2] < 0.01
    assert np.abs(motion(solver)[7:10]).max() < 2e-3


def sliding(tilt: float) -> np.ndarray:
    """How far a box has slid down a slope of elastic soil, with a friction of 0.3, at the frames [m]."""
    box = Box(size=(0.06, 0.06, 0.03), friction=0.3)
    one = free(box, position=(0.05, 0.08, 0.015))
    solver = Solver(scene(one, tilt=tilt, duration=0.2), ELASTIC)
    frames = list(solver.frames())
    x = np.array([frame.other_poses[0, 0] for frame in frames])
    return x - x[0]


def test_a_box_on_a_slope_slides_where_it_is_steeper_than_friction() -> None:
    angle, time = math.radians(25.0), np.arange(11) / 50.0
    wanted = 9.81 * (math.sin(angle) - 0.3 * math.cos(angle))
    assert 2.0 * np.polyfit(time, sliding(25.0), 2)[0] == pytest.approx(wanted, rel=0.05)
    flat = sliding(13.0)  # it settles, and stays
    assert np.abs(flat).max() < 0.005
    assert abs(flat[-1] - flat[-3]) < 1e-5


def test_a_body_that_comes_to_floor_or_walls_ends_the_run() -> None:
    fast = free(position=(0.08, 0.08, 0.03), velocity=(0.0, 0.0, -5.0), density=50_000.0)
    with pytest.raises(SolverStopped, match=r"scene.others\[0\] reached the floor of the bin by 0\.\d+ s"):
        list(Solver(scene(fast)).frames())
    aside = free(position=(0.12, 0.08, 0.2), velocity=(2.0, 0.0, 0.0))
    with pytest.raises(SolverStopped, match=r"scene.others\[0\] reached a side of the bin"):
        list(Solver(scene(aside)).frames())


def test_a_prescribed_further_body_feels_what_the_own_one_does() -> None:
    plate = cut()
    row = plate.poses_at(np.array([0.0]))[0]
    box = Box(size=(0.044, 0.193, 0.2))
    rows = tuple((t, *plate.poses_at(np.array([t]))[0]) for t in np.linspace(0.0, 0.2, 61))
    bed, timing = plate.bed, {"duration": 0.2, "contact_margin": plate.contact_margin}
    other = Scene(bed=bed, others=(Other(tool=box, motion="path", path=rows),), **timing)
    found = list(Solver(other, precision="float64").frames())
    wanted = list(Solver(cut(motion="path", path=rows), precision="float64").frames())
    assert row[2] > 0.0
    for one, two in zip(found, wanted, strict=True):
        np.testing.assert_allclose(one.position, two.position, atol=1e-7)
        np.testing.assert_allclose(one.other_forces[0], two.force, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(one.other_torques[0], two.torque, rtol=1e-6, atol=1e-6)


def test_a_run_with_a_free_body_goes_on_where_it_stopped() -> None:
    hit = scene(free(position=(0.08, 0.08, 0.03), velocity=(0.2, 0.0, -1.0), spin=(1.0, 2.0, 3.0)))
    solver = Solver(hit)
    whole = list(solver.frames())
    frames = Solver(hit).frames()
    again = Solver(hit)
    for frame in again.frames():
        if frame.index == 2:
            break
    assert_same_frames(list(Solver(hit, start=again.state()).frames()), whole[3:])
    assert_same_frames(frames, whole)


def test_scenes_with_further_bodies_know_what_they_hold() -> None:
    known = scene(free(spin=(1.0, 0.0, 0.0)), free(Sphere(), position=(0.08, 0.08, 0.2)))
    assert Scene.from_dict(known.to_dict()) == known
    _, decisions = effects_for(known)
    assert decisions["free_body"].on
    assert decisions["free_body"].reason == "scene.others[0] is free in six degrees of freedom"
    assert decisions["symmetry"].reason == "scene.others[0] is free to leave the plane"
    buried = scene(free(position=(0.08, 0.08, -0.03)))
    assert 0 < len(buried.displaced) < 400
    assert Preview.of(buried).warnings[-1].startswith("scene.others[0] is in the soil at the start: ")
    begins = "its lowest point begins 55 mm below the surface"
    assert Preview.of(buried).lines[-1] == f"scene.others[0] is free and has 0.173 kg; {begins}"
    with pytest.raises(SceneError, match=r"effects.free_body is false, but scene.others\[0\] is free"):
        effects_for(known, {"free_body": False})


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: scene(free(position=(0.01, 0.08, 0.0))), r"scene.others\[0\] leaves the bin at 0.000 s"),
        (lambda: scene(free(Sphere(diameter=0.0004))), r"scene.others\[0\] of 0.0004 m is too thin"),
        (lambda: free(rotation=(0.0, 0.0, 0.0, 2.0)), "it must be of length 1"),
        (
            lambda: free(load=5.0),
            "scene.others.load is 5, but motion=free does not use it; allowed: position",
        ),
        (lambda: Other(motion="path"), "scene.others.path is missing"),
        (lambda: Solver(scene(Other(motion="follow"))), "has nothing to follow: a scene of kind bed has no"),
        (
            lambda: Scene.from_dict({"others": [{"tool": {"shape": "cone"}}]}),
            r"scene.others\[0\].tool.shape is 'cone'; allowed: sphere, box, cylinder, mesh",
        ),
        (lambda: Scene.from_dict({"others": 3}), "scene.others is 3; it must be a list of groups"),
        (lambda: Scene.from_dict({"others": [3]}), r"scene.others\[0\] is 3; it must be a group of keys"),
    ],
)
def test_what_a_further_body_cannot_be(make, words: str) -> None:
    with pytest.raises(SceneError, match=words):
        make()


def test_moments() -> None:
    """Against sums over many points, and a mesh against its box."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.05, 0.05, (400_000, 3))
    x, y, z = points.T
    for tool, inside in (
        (Sphere(diameter=0.1), x**2 + y**2 + z**2 < 0.0025),
        (Cylinder(diameter=0.1, width=0.06), (x**2 + z**2 < 0.0025) & (abs(y) < 0.03)),
        (Box(size=(0.1, 0.08, 0.02)), (abs(y) < 0.04) & (abs(z) < 0.01)),
        (mesh_box((0.1, 0.08, 0.02)), (abs(y) < 0.04) & (abs(z) < 0.01)),
    ):
        volume, moments = tool.moments
        cell = 0.001 / len(points)
        squares = points[inside] ** 2
        assert volume == pytest.approx(cell * inside.sum(), rel=0.01)
        wanted = cell * (squares.sum() - squares.sum(axis=0))
        np.testing.assert_allclose(moments, np.diag(wanted), rtol=0.01, atol=1e-15)


def test_the_second_of_two_wheels_rolls_in_the_rut_of_the_first() -> None:
    tool = Cylinder(diameter=0.1, width=0.05, friction=0.5)
    wheel = Wheel(
        bed=Bed(size=(0.6, 0.15, 0.05), spacing=0.0125, particles_per_cell=4.0, headroom=0.06),
        diameter=0.1,
        width=0.05,
        load=20.0,
        rim_speed=0.5,
        slip=0.2,
        settle=0.2,
        start=0.22 / 0.6,
        duration=0.95,
        others=(Other(tool=tool, motion="follow", position=(-0.12, 0.0, 0.0)),),
    )
    effects, _ = effects_for(wheel)
    assert effects.symmetry
    frames = list(Solver(wheel, effects).frames())
    np.testing.assert_array_equal(frames[0].other_poses[0, :3], frames[0].body_pose[:3] - [0.12, 0.0, 0.0])
    first = np.array([frame.body_pose[[0, 2]] for frame in frames])
    second = np.array([frame.other_poses[0, [0, 2]] for frame in frames])
    rut = second[:, 0] > 0.32  # where the first had come to its full sinkage
    assert rut.sum() > 5
    ground = np.interp(second[rut, 0], first[:, 0], first[:, 1])
    sinkage = (0.05 - ground).mean()
    more = (ground - second[rut, 1]).mean()
    assert 0.002 < sinkage
    assert more < 0.5 * sinkage  # it sinks less below the rut than the first below the bed
    up = np.array([[f.force[2], f.other_forces[0, 2]] for f in frames])[rut]
    np.testing.assert_allclose(up.mean(axis=0), 20.0, rtol=0.1)


def test_thin_bars_of_a_wheel_begin_inside_where_its_contact_does() -> None:
    tool = Cylinder(diameter=0.08, width=0.05, grousers=4, grouser_height=0.01, grouser_thickness=0.004)
    still = ((0.0, 0.08, 0.08, 0.08, 0.0, 0.0, 0.0, 1.0),)
    for margin in (-0.5, 0.1):
        made = Body(bed=BED, duration=0.02, tool=tool, path=still, contact_margin=margin)
        expected = made.contact_distance + 0.25 * 0.004 if margin < 0 else 0.0
        assert (expected < 0.0) == (margin < 0)
        assert float(Solver(made).body.data.shape.grouser_offset) == pytest.approx(expected)
