"""Signed distances against analytic ones. Tools in the soil at the start: what is left out, and that the rest stays
calm. Thin walls of meshes."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import warp as wp
from thin_walls import measure, pushed_sheet

from mpm_warp import (
    Bed,
    Body,
    Box,
    Cylinder,
    Effects,
    MeshBody,
    Plate,
    Scene,
    SceneError,
    Solver,
    Wheel,
    asymmetry,
    effects_for,
)
from mpm_warp.kernels.signed_distance import (
    distances,
    mesh_asymmetry,
    shape_data,
    shape_struct,
    signed_distance,
    thickening,
    thinnest,
    wall_thickness,
)
from mpm_warp.launch import start_warp
from mpm_warp.poses import about_y
from sgns_testing.meshes import BOX_FACES, box_corners, box_triangles, write_obj
from sgns_testing.scenes import cut

start_warp()


@cache
def question(real, shape):
    vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)
    Size, nearest = shape_struct(real), signed_distance(real, shape)

    @wp.kernel(module="unique", enable_backward=False)
    def ask(q: wp.array(dtype=vec3), size: Size, found: wp.array(dtype=vec4)):
        found[wp.tid()] = nearest(q[wp.tid()], size)

    return ask, vec3, vec4


def outward(body, points, real=wp.float64, margin=0.0):
    """Normals (k, 3) and signed distances (k,) at points (k, 3) of the body frame."""
    ask, vec3, vec4 = question(real, body.surface)
    points = np.atleast_2d(np.asarray(points, dtype=float))
    data, mesh = shape_data(body, real, margin, wp.get_device("cpu"))
    found = wp.zeros(len(points), dtype=vec4, device="cpu")
    wp.launch(ask, len(points), [wp.array(points, dtype=vec3, device="cpu"), data, found], device="cpu")
    del mesh
    return found.numpy()[:, :3], found.numpy()[:, 3]


R = math.sqrt(0.5)


@pytest.mark.parametrize(
    ("body", "points", "exact", "normals"),
    [
        (
            Plate(thickness=0.04, width=0.4, length=0.2, edge="square"),
            [[0.03, 0, 0], [0, 0, -0.13], [0.015, 0.1, 0.05], [0.05, 0, 0.14], [-0.018, 0, 0]],
            [0.01, 0.03, -0.005, 0.05, -0.002],
            [[1, 0, 0], [0, 0, -1], [1, 0, 0], [0.6, 0, 0.8], [-1, 0, 0]],
        ),
        (
            Plate(thickness=0.04, width=0.4, length=0.2, edge="bevel"),  # its back ends 40 sqrt(3) mm higher
            [[0.03, 0, 0.0], [0.02, 0, -0.13], [0, 0, -0.1], [0.05, 0.24, 0.0], [0, -0.16, 0.095]],
            [0.01, 0.03, 0.01 * math.sqrt(3.0), 0.05, -0.005],
            [[1, 0, 0], [0, 0, -1], [-math.sqrt(0.75), 0, -0.5], [0.6, 0.8, 0], [0, 0, 1]],
        ),
        (
            Cylinder(diameter=0.2, width=0.1),
            [[0.0, 0, -0.12], [0.07 * R, 0.01, 0.07 * R], [0.05, -0.048, 0], [0.13, 0.09, 0], [0, 0.07, 0]],
            [0.02, -0.03, -0.002, 0.05, 0.02],
            [[0, 0, -1], [R, 0, R], [0, -1, 0], [0.6, 0.8, 0], [0, 1, 0]],
        ),
    ],
    ids=["plate", "bevelled plate", "cylinder"],
)
def test_known_distances(body, points, exact, normals):
    normal, distance = outward(body, points)
    np.testing.assert_allclose(distance, exact, atol=1e-12)
    np.testing.assert_allclose(normal, normals, atol=1e-12)


def test_grousers_stand_on_the_rim():
    """Four bars 2 cm high and 1 cm thick on a rim of 10 cm radius, the first at +x."""
    wheel = Cylinder(diameter=0.2, width=0.1, grousers=4, grouser_height=0.02, grouser_thickness=0.01)
    assert wheel.tip_radius == pytest.approx(0.12)
    points = [
        [0.13, 0, 0],  # beyond a tip
        [0, 0, -0.13],  # of another bar
        [0.11, 0, 0.008],  # beside a bar
        [-0.115, 0, -0.003],  # within one
        [0.11 * R, 0, 0.11 * R],  # half-way between two: the rim
    ]
    normal, distance = outward(wheel, points)
    np.testing.assert_allclose(distance, [0.01, 0.01, 0.003, -0.002, 0.01], atol=1e-12)
    np.testing.assert_allclose(normal[:4], [[1, 0, 0], [0, 0, -1], [0, 0, 1], [0, 0, -1]], atol=1e-12)
    # Turned by one bar nothing changes.
    _, turned = outward(wheel, np.array(points)[:, [2, 1, 0]] * [-1, 1, 1])
    np.testing.assert_allclose(turned, distance, atol=1e-12)


def test_thin_grousers_act_although_contact_begins_inside():
    """Contact from 6 mm inside on, and a bar 4 mm thick: it begins 1 mm under the bar's sides."""
    margin = -0.006
    wheel = Cylinder(diameter=0.2, width=0.1, grousers=4, grouser_height=0.02, grouser_thickness=0.004)
    _, distance = outward(wheel, [[0.11, 0, 0.0], [0.11, 0, 0.0011], [0.11, 0, 0.0009]], margin=margin)
    np.testing.assert_array_equal(distance < margin, [True, False, True])


@pytest.mark.parametrize(
    "body",
    [
        Box(size=(0.1, 0.2, 0.3)),
        Plate(thickness=0.05, width=0.2, length=0.3, edge="bevel"),
        Cylinder(),
        Cylinder(grousers=7, grouser_height=0.02, grouser_thickness=0.01),
    ],
    ids=["box", "plate", "cylinder", "grousers"],
)
def test_the_normal_is_the_gradient_of_the_distance(body):
    """Wherever one face is clearly the nearest; the distance never changes faster than the place."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1.5, 1.5, (400, 3)) * body.half_size
    normal, _ = outward(body, points)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-9)
    steps = 1e-6 * np.eye(3)
    ahead, behind = ([outward(body, points + sign * step)[1] for step in steps] for sign in (1, -1))
    gradient = (np.array(ahead) - np.array(behind)).T / 2e-6
    # Two faces equally near: the difference quotient is neither's normal; that happens at few random points.
    agree = np.linalg.norm(gradient - normal, axis=1) < 1e-4
    assert agree.mean() > 0.98
    assert np.linalg.norm(gradient, axis=1).max() < 1.0 + 1e-6


@pytest.mark.parametrize("real", [wp.float32, wp.float64])
def test_a_mesh_of_a_box_is_the_box(tmp_path, real):
    size = (0.1, 0.2, 0.3)
    file = write_obj(tmp_path / "box.obj", 100.0 * box_corners(size, (3.0, 1.0, 2.0)), BOX_FACES)
    rng = np.random.default_rng(1)
    points = rng.uniform(-0.14, 0.14, (500, 3))
    normal, distance = outward(MeshBody(file=str(file), scale=0.01), points, real, margin=0.2)
    exact_normal, exact = outward(Box(size=size), points)
    np.testing.assert_allclose(distance, exact, atol=2e-6)
    agree = np.linalg.norm(normal - exact_normal, axis=1) < 1e-3
    assert agree.mean() > 0.98  # elsewhere two faces are equally near


@pytest.mark.parametrize("rake", [-40.0, 20.0, None], ids=["forward", "back", "bevel"])
def test_a_mesh_of_a_plate_is_the_plate(tmp_path, rake):
    plate = Plate(thickness=0.1, width=0.2, length=0.3, edge="bevel")
    if rake is not None:
        plate = replace(plate, edge="level").level_at(about_y(-math.radians(rake)))
    ring = [(k, (k + 1) % 4, 4 + (k + 1) % 4, 4 + k) for k in range(4)]
    file = write_obj(tmp_path / "plate.obj", plate.corners, [(0, 1, 2, 3), (7, 6, 5, 4), *ring])
    mesh, points = (
        MeshBody(file=str(file), origin="file"),
        np.random.default_rng(2).uniform(-0.2, 0.2, (500, 3)),
    )
    normal, distance = outward(plate, points)
    mesh_normal, expected = outward(mesh, points - mesh.centre, margin=0.5)
    np.testing.assert_allclose(distance, expected, atol=2e-6)
    assert (np.linalg.norm(normal - mesh_normal, axis=1) < 1e-3).mean() > 0.98


def test_points_far_from_a_mesh_are_not_looked_up(tmp_path):
    file = write_obj(tmp_path / "box.obj", box_corners((0.1, 0.1, 0.1)), BOX_FACES)
    _, distance = outward(MeshBody(file=str(file)), [[0.2, 0, 0], [0.055, 0, 0]], margin=0.01)
    assert distance[0] > 1.0
    assert distance[1] == pytest.approx(0.005, abs=1e-6)


# --- Tools in the soil at the start ---------------------------------------------------------------------

BED = Bed(size=(0.4, 0.3, 0.16), spacing=0.02, particles_per_cell=4.0, headroom=0.12)
SIZE = (0.05, 0.12, 0.08)


def mesh_box(size=SIZE) -> MeshBody:
    return MeshBody.of_mesh(box_corners(size, -0.5 * np.array(size)), box_triangles())


def buried(tool=None, height=-0.03, angle=0.0, **kw) -> Body:
    """A tool that rests in the soil for 0.1 s and then moves on."""
    rows = ((0.0, 0.2), (0.1, 0.2), (0.3, 0.22))
    path = tuple((t, x, 0.15, height, *about_y(angle)) for t, x in rows)
    return Body(**({"bed": BED, "tool": tool or Box(size=SIZE), "path": path, "duration": 0.1} | kw))


def test_distances_of_boxes_meshes_and_cylinders():
    points = np.array([[0.0, 0.0, 0.0], [0.03, 0.0, 0.0], [0.035, 0.07, 0.0], [0.0, 0.0, -0.05]])
    expected = [-0.025, 0.005, np.hypot(0.01, 0.01), 0.01]
    np.testing.assert_allclose(distances(Box(size=SIZE), points), expected, atol=1e-12)
    np.testing.assert_allclose(distances(mesh_box(), points, margin=0.1), expected, atol=1e-7)
    wheel = Cylinder(diameter=0.1, width=0.06)
    np.testing.assert_allclose(distances(wheel, points), [-0.03, -0.02, 0.04, 0.0], atol=1e-12)


@pytest.mark.parametrize("tool", [Box(size=SIZE), mesh_box()], ids=["box", "mesh"])
def test_particles_where_the_tool_starts_are_left_out(tool):
    """Those that contact would push, of a box turned by 30 degrees about its middle."""
    angle = np.radians(30.0)
    scene = buried(tool, angle=angle)
    whole = scene.filled[0]
    x, y, z = (whole - [0.2, 0.15, -0.03]).T
    along = np.stack([x * np.cos(angle) - z * np.sin(angle), y, x * np.sin(angle) + z * np.cos(angle)])
    outside = np.maximum(np.abs(along) - 0.5 * np.array(SIZE)[:, None], 0.0)
    expected = np.flatnonzero(np.linalg.norm(outside, axis=0) < scene.contact_distance)
    np.testing.assert_array_equal(scene.displaced, expected)
    assert len(expected) > 50
    assert len(scene.initial_positions()) == len(scene.initial_velocities()) == len(whole) - len(expected)
    assert len(scene.stored) == len(scene.initial_positions())
    assert scene.arrangement_hash != scene.bed.arrangement_hash
    assert scene.arrangement_hash != buried(tool).arrangement_hash
    assert effects_for(scene)[0].symmetry


@pytest.mark.parametrize(
    "scene",
    [
        Scene(),
        cut(clearance=0.0),
        Wheel(),
        Wheel(bed=Bed(size=(0.4, 0.19, 0.06), spacing=0.01, particles_per_cell=4.0, arrangement="jittered")),
        buried(height=0.05),
        buried(height=0.04 - 0.001),  # a millimetre deep: nothing is inside yet
    ],
)
def test_a_tool_above_the_soil_leaves_all_in(scene):
    assert len(scene.displaced) == 0
    assert scene.initial_positions() is scene.filled[0]
    assert scene.arrangement_hash == scene.bed.arrangement_hash


@pytest.mark.parametrize("tool", [Box(size=SIZE), mesh_box(), Cylinder(diameter=0.08, width=0.1)])
def test_soil_around_a_buried_tool_stays_calm(tool):
    """It closes gaps of less than a particle spacing, under its own weight: 5 mm at 9.81 m/s^2 are 0.3 m/s."""
    frames = list(Solver(buried(tool)).frames())
    assert max(np.linalg.norm(f.velocity, axis=1).max() for f in frames) < 0.35
    assert max(np.linalg.norm(f.force) for f in frames) < 10.0
    weight = 9.81 * buried().material.bulk_density * np.prod(SIZE)
    assert np.abs(np.mean([f.force[2] for f in frames[3:]])) < weight


def test_stress_around_a_buried_tool_is_that_of_the_whole_bed():
    whole, part = Solver(cut(bed=BED)).particles, Solver(buried()).particles
    kept = np.delete(np.arange(whole.position.size), buried().displaced)
    np.testing.assert_array_equal(part.stress.numpy(), whole.stress.numpy()[kept])


def test_a_mesh_with_two_different_sides_is_no_mirror_image():
    """Of a share with one wing the half says nothing about the whole."""
    vertices, triangles = box_corners(SIZE, -0.5 * np.array(SIZE)), box_triangles()
    even = MeshBody.of_mesh(vertices, triangles)
    assert mesh_asymmetry(even) < 1e-6
    assert effects_for(buried(even, height=0.1))[0].symmetry
    assert mesh_asymmetry(BENT) < 1e-6 and mesh_asymmetry(HOLLOW) < 1e-6
    corner = np.array([[0, 0, 0], [0.09, 0, 0], [0, 0.09, 0], [0, 0, 0.09]])
    winged = MeshBody.of_mesh(corner - corner.mean(axis=0), [(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)])
    scene = buried(winged, height=0.1)
    assert asymmetry(scene).startswith("the tool's two sides differ by 45 mm")
    assert not effects_for(scene)[0].symmetry
    with pytest.raises(SceneError, match=r"the tool's two sides differ .*effects\.symmetry=false"):
        Solver(scene, Effects(symmetry=True))


# --- Thin walls of meshes -------------------------------------------------------------------------------


def extruded(outline, width=0.2) -> MeshBody:
    """A mesh with an outline (x, z) [m] in turn, cut into triangles from its first corner, along y."""
    n, corners = len(outline), [(x, y, z) for y in (0.0, width) for x, z in outline]
    side = [(0, k, k + 1) for k in range(1, n - 1)]
    faces = [*side, *((n + c, n + b, n + a) for a, b, c in side)]
    for a in range(n):
        b = (a + 1) % n
        faces += [(b, a, a + n), (b, a + n, b + n)]
    vertices, triangles = np.array(corners), np.array(faces)
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    parts = np.einsum("ij,ij->i", a, np.cross(b, c))
    centre = (parts[:, None] * (a + b + c)).sum(axis=0) / (4.0 * parts.sum())
    return MeshBody.of_mesh(vertices - centre, triangles if parts.sum() > 0.0 else triangles[:, ::-1])


# A V of sheet, 1 mm thick, seen from its inner corner: its bounding box is 10 cm deep.
SHEET = 0.001 * np.sqrt(2.0)
BENT = extruded([(0.0, SHEET), (-0.1, 0.1 + SHEET), (-0.1, 0.1), (0.0, 0.0), (0.1, 0.1), (0.1, 0.1 + SHEET)])
HOLLOW = MeshBody.of_mesh(
    np.concatenate(
        [box_corners((0.1, 0.1, 0.1), -0.05 * np.ones(3)), box_corners((0.098,) * 3, -0.049 * np.ones(3))]
    ),
    np.concatenate([box_triangles(), box_triangles()[:, ::-1] + 8]),
)


@pytest.mark.parametrize("tool", [BENT, HOLLOW], ids=["bent", "hollow"])
def test_walls_are_measured_through_the_mesh(tool):
    assert tool.half_thickness > 0.04
    assert thinnest(tool, 0.04) == pytest.approx(0.001, rel=1e-3)
    assert thinnest(Box(size=SIZE), 0.04) == 0.05


def test_what_tapers_is_an_edge_and_what_is_thick_no_wall():
    wedge = extruded([(0.0, 0.0), (0.1, 0.0), (0.1, 0.06)])
    assert np.isinf(wall_thickness(wedge, 0.1)).all()
    assert np.isinf(wall_thickness(mesh_box(), 0.04)).all()
    assert wall_thickness(mesh_box(), 0.06).min() == pytest.approx(0.05, rel=1e-3)


def test_thin_walls_begin_to_act_further_out():
    """Soil is pressed in by at least a tenth of a grid spacing before it is nearer to the other side."""
    for density, distance in ((1.0, 0.005), (8.0, 0.0), (27.0, -5e-3 / 3)):
        bed = Bed(spacing=0.02, particles_per_cell=density)
        scene = buried(HOLLOW, height=0.2, bed=bed)
        assert scene.contact_distance == pytest.approx(distance)
        found = thickening(HOLLOW, scene.contact_distance, 0.02)
        if density == 1.0:
            assert found is None
        else:
            np.testing.assert_allclose(found, 0.002 - distance - 0.0005, rtol=1e-3)
            at = np.array([[0.06, 0.0, 0.0], [0.0495, 0.01, 0.0], [0.0, 0.0, 0.0]])
            expected = [0.01, -0.0005, 0.049] - found[0]
            np.testing.assert_allclose(distances(HOLLOW, at, 0.1, found), expected, atol=1e-6)
    assert thickening(mesh_box(), 0.0, 0.02) is None and thickening(Box(size=SIZE), 0.0, 0.02) is None


def test_walls_that_are_thinner_than_the_grid_are_told():
    thin = buried(HOLLOW, height=0.2, bed=Bed(spacing=0.02, particles_per_cell=8.0)).warnings()
    assert thin[0].startswith("the tool's thinnest part is 1 mm, 0.05 grid spacings; below 2 the soil")
    assert thin[1].endswith(
        "begins up to 1.5 mm further out, for soil not to go through them; walls of 4 mm need none"
    )
    assert len(buried(HOLLOW, height=0.2).warnings()) == 2
    assert buried(height=0.2).warnings() == []


@pytest.mark.long
@pytest.mark.parametrize("thickness", [0.001, 0.002])
def test_thin_walls_hold_soil(thickness):
    """At 1 m/s and 8 particles per cell, which leaks without."""
    assert measure(thickness, 8.0, 1.0, thickened=False)["through_inside"] > 0.02
    assert measure(thickness, 8.0, 1.0, thickened=True)["through_inside"] == 0.0
    assert pushed_sheet(thickness, 8.0, 1.0).tool.half_thickness < 0.1 * 0.02
