import itertools

import numpy as np
import pytest

from sgns.evaluate.solid_view import Camera, DepthBuffer, hull_triangles

RED, BLUE = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
CUBE = np.array(list(itertools.product([0.0, 1.0], repeat=3)))


def area(triangles):
    sides = triangles[:, 1:] - triangles[:, :1]
    return 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum()


def test_camera_keeps_lengths_and_looks_from_its_direction():
    camera = Camera(azimuth=-60.0, elevation=28.0)
    assert camera.axes @ camera.axes.T == pytest.approx(np.eye(3))
    assert np.linalg.det(camera.axes) == pytest.approx(1.0)
    assert camera.project([0.0, 0.0, 1.0])[1] > 0.0  # up is up
    assert camera.project([0.0, -1.0, 0.0])[2] > camera.project([0.0, 1.0, 0.0])[2]  # −y is in front


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_nearer_particle_hides_the_other_whatever_the_order(order):
    centres = np.array([[0.5, 0.5, 0.0], [0.5, 0.5, 1.0]])[list(order)]
    colours = np.stack([BLUE, RED])[list(order)]
    together = DepthBuffer([0, 0], [1, 1], 40)
    together.spheres(centres, 0.2, colours)
    red, _, blue = together.colour[20, 20]
    assert red > 0.5 and blue == 0.0


def test_a_face_hides_what_is_behind_it_and_not_what_is_in_front():
    face = np.array([[[-5.0, -5.0, 0.5], [5.0, -5.0, 0.5], [0.0, 9.0, 0.5]]])
    buffer = DepthBuffer([0, 0], [1, 1], 50)
    buffer.spheres(np.array([[0.25, 0.5, 0.0], [0.75, 0.5, 1.0]]), 0.1, np.stack([BLUE, BLUE]))
    buffer.triangles(face, RED)
    assert buffer.colour[25, 12, 2] == 0.0  # covered
    assert buffer.colour[25, 37, 2] > 0.5  # in front
    assert np.isfinite(buffer.nearness).all()


def test_a_tilted_face_is_as_near_as_its_plane():
    corners = np.array([[[-9.0, -9.0, 0.0], [9.0, -9.0, 0.0], [0.0, 18.0, 0.0]]])
    corners[..., 2] = 0.3 * corners[..., 0] - 0.2 * corners[..., 1] + 1.0
    buffer = DepthBuffer([0, 0], [1, 1], 10)
    buffer.triangles(corners, RED)
    right = up = (np.arange(10) + 0.5) / 10
    assert buffer.nearness == pytest.approx(0.3 * right[None] - 0.2 * up[:, None] + 1.0)


def test_what_lies_outside_the_picture_is_left_out():
    buffer = DepthBuffer([0, 0], [1, 2], 10)
    assert buffer.nearness.shape == (20, 10) and buffer.extent == pytest.approx((0, 1, 0, 2))
    buffer.spheres(np.array([[-3.0, 0.5, 0.0], [0.5, 9.0, 0.0]]), 0.1, np.stack([RED, RED]))
    buffer.triangles(np.array([[[4.0, 4.0, 0.0], [5.0, 4.0, 0.0], [4.0, 5.0, 0.0]]]), RED)
    assert (buffer.colour == 1.0).all()


def test_hull_of_a_cube_has_its_surface_and_its_corners_only():
    inside = np.random.default_rng(0).uniform(0.2, 0.8, (5, 3))
    triangles = hull_triangles(np.concatenate([CUBE, inside]))
    assert len(triangles) == 12 and area(triangles) == pytest.approx(6.0)
    assert np.unique(triangles.reshape(-1, 3), axis=0) == pytest.approx(np.unique(CUBE, axis=0))


def test_hull_of_a_wheel_approaches_that_of_a_cylinder():
    angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    rim = np.stack([np.cos(angle), np.zeros(24), np.sin(angle)], axis=-1)
    half = np.array([0.0, 0.5, 0.0])
    triangles = hull_triangles(np.concatenate([rim - half, rim + half]))
    assert area(triangles) == pytest.approx(2.0 * np.pi * 1.0 + 2.0 * np.pi, rel=0.01)


def test_hull_of_flat_points_is_one_face_and_of_points_on_a_line_is_nothing():
    flat = CUBE * [1.0, 1.0, 0.0]
    assert area(hull_triangles(flat[::2])) == pytest.approx(1.0)
    assert hull_triangles(np.outer(np.arange(4.0), [1.0, 2.0, 3.0])).shape == (0, 3, 3)
