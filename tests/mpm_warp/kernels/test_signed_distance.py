"""Signed distances against analytic ones."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import warp as wp

from mpm_warp import Box, Cylinder, MeshBody, Plate
from mpm_warp.kernels.signed_distance import shape_data, shape_struct, signed_distance
from mpm_warp.launch import start_warp
from mpm_warp.poses import about_y
from sgns_testing.meshes import BOX_FACES, box_corners, write_obj

start_warp()


@cache
def question(real, shape):
    vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)
    Size, outward = shape_struct(real), signed_distance(real, shape)

    @wp.kernel(module="unique", enable_backward=False)
    def ask(q: wp.array(dtype=vec3), size: Size, found: wp.array(dtype=vec4)):
        found[wp.tid()] = outward(q[wp.tid()], size)

    return ask, vec3, vec4


def distances(body, points, real=wp.float64, margin=0.0):
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
    normal, distance = distances(body, points)
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
    normal, distance = distances(wheel, points)
    np.testing.assert_allclose(distance, [0.01, 0.01, 0.003, -0.002, 0.01], atol=1e-12)
    np.testing.assert_allclose(normal[:4], [[1, 0, 0], [0, 0, -1], [0, 0, 1], [0, 0, -1]], atol=1e-12)
    # Turned by one bar nothing changes.
    _, turned = distances(wheel, np.array(points)[:, [2, 1, 0]] * [-1, 1, 1])
    np.testing.assert_allclose(turned, distance, atol=1e-12)


def test_thin_grousers_act_although_contact_begins_inside():
    """Contact from 6 mm inside on, and a bar 4 mm thick: it begins 1 mm under the bar's sides."""
    margin = -0.006
    wheel = Cylinder(diameter=0.2, width=0.1, grousers=4, grouser_height=0.02, grouser_thickness=0.004)
    _, distance = distances(wheel, [[0.11, 0, 0.0], [0.11, 0, 0.0011], [0.11, 0, 0.0009]], margin=margin)
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
    normal, _ = distances(body, points)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-9)
    steps = 1e-6 * np.eye(3)
    ahead, behind = ([distances(body, points + sign * step)[1] for step in steps] for sign in (1, -1))
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
    normal, distance = distances(MeshBody(file=str(file), scale=0.01), points, real, margin=0.2)
    exact_normal, exact = distances(Box(size=size), points)
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
    normal, distance = distances(plate, points)
    mesh_normal, expected = distances(mesh, points - mesh.centre, margin=0.5)
    np.testing.assert_allclose(distance, expected, atol=2e-6)
    assert (np.linalg.norm(normal - mesh_normal, axis=1) < 1e-3).mean() > 0.98


def test_points_far_from_a_mesh_are_not_looked_up(tmp_path):
    file = write_obj(tmp_path / "box.obj", box_corners((0.1, 0.1, 0.1)), BOX_FACES)
    _, distance = distances(MeshBody(file=str(file)), [[0.2, 0, 0], [0.055, 0, 0]], margin=0.01)
    assert distance[0] > 1.0
    assert distance[1] == pytest.approx(0.005, abs=1e-6)
