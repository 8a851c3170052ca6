"""Views of the bed and its tool."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest

from mpm_warp.scenes import Wheel, sinkage
from sgns.data.run import Run
from sgns.evaluate.figures import latent_path, subspace_view
from sgns.evaluate.metrics import forward_force, is_wheel
from sgns.evaluate.side_view import body_corners
from sgns.evaluate.solid_view import Camera, DepthBuffer, hull_triangles, solid_views, upper_scale
from sgns_testing.pictures import pixels
from sgns_testing.runs import PLATE, make_run, start_positions
from sgns_testing.surrogates import fitted

# --- The whole bed and the subspace in three dimensions --------------------------------------------------


@pytest.fixture
def pair(tmp_path):
    paths = [
        make_run(tmp_path / f"{seed}.h5", frames=12, n=300, seed=seed, producer=producer)
        for seed, producer in ((1, "mpm"), (2, "rollout"))
    ]
    with Run(paths[0]) as truth, Run(paths[1]) as prediction:
        yield truth, prediction, fitted(paths, 4)


def test_whole_bed_is_drawn_three_times_with_one_scale_of_displacement(pair):
    truth, prediction, _ = pair
    views = solid_views(truth, prediction, 9, start_positions(300))
    assert list(views) == ["simulated (MPM)", "network", "network, its error"]
    pictures = [pixels(view) for view in views.values()]
    assert pictures[0].shape == pictures[1].shape
    assert not np.array_equal(pictures[0], pictures[1])
    bars = [view.axes[-1].get_xlim() for view in views.values()]
    assert bars[0] == bars[1]


@pytest.mark.parametrize(
    "scene",
    [
        {"blade": None, "kind": "wheel", "diameter": 0.15, "width": 0.08},
        {"blade": None, "kind": "body"},
        {"blade": None, "speed": 1e-12, "depth": 0.0},
    ],
)
def test_other_bodies_and_soil_that_rests(tmp_path, scene):
    with Run(make_run(tmp_path / "run.h5", frames=6, n=200, scene=scene)) as run:
        for view in solid_views(run, run, 5, start_positions(200)).values():
            pixels(view)


def test_scale_of_nothing():
    assert upper_scale(np.zeros(5)).vmax == 1.0


def test_path_in_the_subspace_is_the_projection(pair):
    truth, _, basis = pair
    whole = latent_path(truth, basis)
    assert whole == pytest.approx(basis.transform(truth.positions()).numpy())
    assert whole.shape == (truth.frame_count, 4, 3)


def test_subspace_shows_both_paths_and_the_body(pair):
    truth, prediction, basis = pair
    paths = (latent_path(truth, basis), latent_path(prediction, basis))
    figure = subspace_view(truth, prediction, paths, 9)
    axis = figure.axes[0]
    assert [text.get_text() for text in axis.texts] == ["1", "2", "3", "4"]
    assert len(axis.lines) == 8  # a way for every mode of both
    assert len(axis.lines[0].get_data_3d()[0]) == 10
    pixels(figure)


# --- Depth buffer and hull -------------------------------------------------------------------------------


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


# --- The body of a recorded scene ------------------------------------------------------------------------


REST = np.array([[0.3, 0.2, 0.1, 0.0, 0.0, 0.0, 1.0]])


def test_forward_force_follows_the_kind_of_body():
    assert forward_force({"kind": "wheel"}) == ("drawbar pull Fx", 1.0)
    assert forward_force({"blade": {}}) == ("draft −Fx", -1.0)
    assert is_wheel({"kind": "wheel"}) and not is_wheel({"kind": "bed"})


@pytest.mark.parametrize("grousers", [{}, {"grousers": 6, "grouser_height": 0.01, "grouser_thickness": 0.02}])
def test_sinkage_is_that_of_the_scene(grousers):
    scene = Wheel(clearance=0.002, **grousers)
    poses = scene.body_poses()[:5]
    assert sinkage(scene.to_dict(), poses) == pytest.approx(-0.002)
    assert (sinkage(scene.to_dict(), poses) == scene.sinkage(poses)).all()


def test_corners_of_a_wheel_lie_on_its_rims():
    run = SimpleNamespace(scene={"kind": "wheel", "diameter": 0.15, "width": 0.08}, pose=REST)
    corners = body_corners(run, 0) - REST[0, :3]
    assert np.hypot(corners[:, 0], corners[:, 2]) == pytest.approx(0.075)
    assert np.abs(corners[:, 1]) == pytest.approx(0.04)


def test_corners_of_a_blade_are_those_of_its_box(tmp_path):
    with Run(make_run(tmp_path / "run.h5")) as run:
        corners = body_corners(run, 3)
        assert corners.mean(axis=0) == pytest.approx(run.pose[3, :3])
        distance = np.linalg.norm(corners - run.pose[3, :3], axis=1)
        assert distance == pytest.approx(0.5 * np.linalg.norm(PLATE))


def test_other_bodies_are_their_recorded_points():
    points = np.random.default_rng(0).normal(size=(2, 8, 3))
    run = SimpleNamespace(scene={"kind": "body"}, body_points=points, pose=REST, mesh=None)
    assert np.array_equal(body_corners(run, 1), points[1])


def test_corners_of_a_mesh_are_its_vertices():
    vertices = np.random.default_rng(0).normal(size=(20, 3))
    run = SimpleNamespace(scene={"kind": "body"}, pose=REST, mesh=(vertices, None))
    assert body_corners(run, 0) == pytest.approx(vertices + REST[0, :3])
