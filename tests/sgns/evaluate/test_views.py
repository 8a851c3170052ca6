"""Views of the bed and its tool."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.colors import Normalize, to_rgb
from scipy.spatial import ConvexHull

from mpm_warp.bodies import Plate
from mpm_warp.motions import sinkage
from mpm_warp.poses import rotation_matrices
from mpm_warp.scenes import Excavation, Wheel
from sgns import plot
from sgns.data.run import Run
from sgns.data.surface import particle_spacing
from sgns.evaluate import figures
from sgns.evaluate.body_shape import (
    CAMERA,
    MOST_TRIANGLES,
    DepthBuffer,
    body_corners,
    body_cut,
    body_silhouette,
    body_triangles,
    grousers,
    hull,
    hull_triangles,
    project,
    simpler,
)
from sgns.evaluate.views import (
    BEHIND,
    LEAST_SPEED,
    MOST_PARTICLES,
    SPEED,
    STEEL,
    Scales,
    common_scales,
    draw_view,
    latent_path,
    middle_slice,
    nice,
    side_views,
    solid_views,
    subspace_view,
    upper_scale,
    view_times,
)
from sgns_testing.pictures import pixels
from sgns_testing.runs import PLATE, make_run, start_positions
from sgns_testing.surrogates import fitted

WHEEL = {"blade": None, "kind": "wheel", "diameter": 0.15, "width": 0.08}


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    paths = [
        make_run(folder / f"{seed}.h5", frames=20, n=300, seed=seed, producer=producer)
        for seed, producer in ((1, "mpm"), (2, "rollout"))
    ]
    with Run(paths[0]) as truth, Run(paths[1]) as prediction:
        yield truth, prediction, fitted(paths, 4)


# --- From the side ---------------------------------------------------------------------------------------


def test_runs_above_each_other_have_one_scale(pair):
    truth, prediction, _ = pair
    frames = view_times(truth, 3)
    scales = common_scales([truth, prediction], frames, start_positions(300))
    figure = side_views(
        [[("simulated (MPM)", truth, frames[-1])], [("network", prediction, frames[-1])]], scales
    )
    upper, lower = figure.axes[:2]
    assert upper.get_xlim() == lower.get_xlim() == pytest.approx(scales.x_limits)
    assert upper.collections[0].norm is lower.collections[0].norm is scales.speed
    assert pixels(figure).shape[1] == round(figures.PICTURE_WIDTH * figures.DPI)
    assert upper.get_position().y0 > lower.get_position().y1
    strongest = max(np.linalg.norm(run.force[f, [0, 2]]) for run in (truth, prediction) for f in frames)
    assert scales.arrow * strongest < 0.3 * np.ptp(scales.x_limits)


@pytest.mark.parametrize("scene", [WHEEL, {"blade": None, "kind": "body"}, {"blade": None, "speed": 1e-12}])
def test_other_bodies_and_soil_that_rests(tmp_path, scene):
    with Run(make_run(tmp_path / "run.h5", frames=8, n=200, scene={"depth": 0.0} | scene)) as run:
        scales = common_scales([run], view_times(run, 2), start_positions(200))
        pixels(side_views([[("network", run, 5)]], scales))
        for view in solid_views(run, run, 5, start_positions(200)).values():
            pixels(view)


@pytest.mark.parametrize("name", [r"$\frac$", "50 % $x^$_2", "a\nb", "_"])
def test_names_are_no_formulas(pair, name):
    pixels(side_views([[(name, pair[0], 4)]], common_scales(pair[:1], [4], start_positions(300))))


def test_view_times_lie_after_the_history_and_within_the_run(pair):
    frames = view_times(pair[0], 3)
    assert len(frames) == 3 and frames == sorted(frames)
    assert 3 < frames[0] and frames[-1] < pair[0].frame_count


def test_a_tool_that_only_turns_moves():
    pose, points = np.zeros((20, 7)), np.zeros((20, 1, 3))
    angle = 0.05 * np.minimum(np.arange(20), 12)
    pose[:, 5], pose[:, 6] = np.sin(angle / 2), np.cos(angle / 2)
    points[:, 0, 0], points[:, 0, 1] = np.cos(angle), np.sin(angle)
    run = SimpleNamespace(pose=pose, body_points=points, frame_count=20)
    assert view_times(run, 3)[-1] == round(3 + 0.9 * (12 - 3))


def test_middle_slice_nice_numbers_and_the_scale_of_nothing():
    y = np.linspace(0.0, 1.0, 11)
    bed = np.stack(np.meshgrid(y, y, y), axis=-1).reshape(-1, 3)
    chosen = bed[middle_slice(bed)]
    assert np.abs(chosen[:, 1] - 0.5).max() < 0.2 and len(chosen) > 100
    assert [nice(v) for v in (0.1, 0.11, 27.0, 8.5)] == pytest.approx([0.1, 0.15, 30.0, 10.0])
    assert upper_scale(np.zeros(5)).vmax == 1.0 and upper_scale(np.zeros(5), np.full(5, 2.9)).vmax == 3.0


# --- The whole bed and the subspace in three dimensions --------------------------------------------------


def test_whole_bed_is_drawn_three_times_with_one_scale_of_displacement(pair):
    truth, prediction, _ = pair
    views = solid_views(truth, prediction, 9, start_positions(300))
    assert list(views) == ["simulated (MPM)", "network", "network, its error"]
    pictures = [pixels(view) for view in views.values()]
    assert pictures[0].shape == pictures[1].shape
    assert not np.array_equal(pictures[0], pictures[1])
    bars = [view.axes[-1].get_xlim() for view in views.values()]
    assert bars[0] == bars[1]


def test_subspace_shows_both_paths_and_the_body(pair):
    truth, prediction, basis = pair
    paths = (latent_path(truth, basis), latent_path(prediction, basis))
    assert paths[0] == pytest.approx(basis.transform(truth.positions()).numpy())
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
    assert CAMERA @ CAMERA.T == pytest.approx(np.eye(3))
    assert np.linalg.det(CAMERA) == pytest.approx(1.0)
    assert project([0.0, 0.0, 1.0])[1] > 0.0  # up is up
    assert project([0.0, -1.0, 0.0])[2] > project([0.0, 1.0, 0.0])[2]  # −y is in front


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_nearer_particle_hides_the_other_whatever_the_order(order):
    centres = np.array([[0.5, 0.5, 0.0], [0.5, 0.5, 1.0]])[list(order)]
    together = DepthBuffer([0, 0], [1, 1], 40)
    together.spheres(centres, 0.2, np.stack([BLUE, RED])[list(order)])
    red, _, blue = together.colour[20, 20]
    assert red > 0.5 and blue == 0.0


def test_a_face_hides_what_is_behind_it_and_not_what_is_in_front():
    face = np.array([[[-5.0, -5.0, 0.5], [5.0, -5.0, 0.5], [0.0, 9.0, 0.5]]])
    edge_on = np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 0.0, 9.0]]])
    buffer = DepthBuffer([0, 0], [1, 1], 50)
    buffer.spheres(np.array([[0.25, 0.5, 0.0], [0.75, 0.5, 1.0]]), 0.1, np.stack([BLUE, BLUE]))
    buffer.triangles(np.concatenate([face, edge_on]), RED)
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


def test_hull_of_a_square_and_of_two_points():
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=float)
    inside = np.random.default_rng(0).uniform(0.1, 0.9, (20, 2))
    assert sorted(hull(np.vstack([square, inside, square])).tolist()) == sorted(square.tolist())
    assert len(hull(np.array([[0.0, 0.0], [1.0, 1.0]]))) == 2


def test_hull_of_a_cube_of_flat_points_and_of_points_on_a_line():
    inside = np.random.default_rng(0).uniform(0.2, 0.8, (5, 3))
    triangles = hull_triangles(np.concatenate([CUBE, inside]))
    assert len(triangles) == 12 and area(triangles) == pytest.approx(6.0)
    assert np.unique(triangles.reshape(-1, 3), axis=0) == pytest.approx(np.unique(CUBE, axis=0))
    assert area(hull_triangles((CUBE * [1.0, 1.0, 0.0])[::2])) == pytest.approx(1.0)
    assert hull_triangles(np.outer(np.arange(4.0), [1.0, 2.0, 3.0])).shape == (0, 3, 3)


def u_profile():
    """Vertices (16, 3) and outward triangles of a U, open towards +x, 3 × 3 from the side, walls 1, 1 wide."""
    side = np.array([(0, 0), (3, 0), (3, 1), (1, 1), (1, 2), (3, 2), (3, 3), (0, 3)], float)
    vertices = np.concatenate([np.insert(side, 1, y, axis=1) for y in (0.0, 1.0)])
    caps = [(0, 1, 3), (1, 2, 3), (0, 3, 4), (0, 4, 7), (4, 5, 7), (5, 6, 7)]
    walls = [(i, i + 8, (i + 1) % 8) for i in range(8)] + [
        ((i + 1) % 8, i + 8, (i + 1) % 8 + 8) for i in range(8)
    ]
    return vertices, np.array([*caps, *[(c + 8, b + 8, a + 8) for a, b, c in caps], *walls])


# --- The body of a recorded scene ------------------------------------------------------------------------

REST = np.array([[0.3, 0.2, 0.1, 0.0, 0.0, 0.0, 1.0]])


@pytest.mark.parametrize("grousers", [{}, {"grousers": 6, "grouser_height": 0.01, "grouser_thickness": 0.02}])
def test_sinkage_is_that_of_the_scene(grousers):
    scene = Wheel(clearance=0.002, **grousers)
    poses = scene.body_poses()[:5]
    assert sinkage(scene.to_dict(), poses) == pytest.approx(-0.002)
    assert (sinkage(scene.to_dict(), poses) == scene.sinkage(poses)).all()


def test_a_wheel_is_its_rims_and_from_the_side_a_circle():
    run = SimpleNamespace(scene=WHEEL, pose=REST)
    corners = body_corners(run, 0) - REST[0, :3]
    assert np.hypot(corners[:, 0], corners[:, 2]) == pytest.approx(0.075)
    assert np.abs(corners[:, 1]) == pytest.approx(0.04)
    assert area(hull_triangles(corners)) == pytest.approx(np.pi * 0.15 * (0.08 + 0.075), rel=0.01)
    assert np.linalg.norm(body_silhouette(run, 0)[0] - REST[0, [0, 2]], axis=1) == pytest.approx(0.075)


@pytest.mark.parametrize("edge", ["level", "bevel"])
def test_a_plate_is_drawn_with_its_edge(edge):
    scene = Excavation(blade=Plate(edge=edge), rake=30.0, depth=0.06)
    run = SimpleNamespace(scene=scene.to_dict(), pose=scene.body_poses(), mesh=None)
    for frame in (0, 100):
        (outline,) = body_silhouette(run, frame)
        assert outline[:, 1].min() == pytest.approx(scene.lowest_points(run.pose[[frame]])[0])
        low = np.sort(outline[:, 1])[:2]
        assert np.ptp(low) == pytest.approx(0.0 if edge == "level" else 0.028, abs=1e-9)


def test_a_turned_wheel_is_from_the_side_as_wide_as_it_is_thick():
    """Pushed sideways it is a box of its width and height; from above it is turned the same way."""
    scene = Wheel(diameter=0.15, width=0.08, slip_angle=90.0)
    run = SimpleNamespace(scene=scene.to_dict(), pose=scene.body_poses()[:1])
    for axes, size in (((0, 2), [0.08, 0.15]), ((0, 1), [0.08, 0.15])):
        assert np.ptp(body_silhouette(run, 0, axes)[0], axis=0) == pytest.approx(size)


@pytest.mark.parametrize("slip_angle", [0.0, 30.0])
def test_grousers_are_drawn_at_their_angle_down_to_the_sinkage(slip_angle):
    shape = {"grousers": 4, "grouser_height": 0.01, "grouser_thickness": 0.004}
    scene = Wheel(diameter=0.2, width=0.08, slip_angle=slip_angle, **shape)
    run = SimpleNamespace(scene=scene.to_dict(), pose=scene.body_poses())
    outline = np.concatenate(body_silhouette(run, 0))
    assert outline[:, 1].min() == pytest.approx(-scene.sinkage(run.pose)[0])
    corners = body_triangles(run, 0).reshape(-1, 3)
    assert (corners[:, 2].min(), np.ptp(corners[:, 2])) == pytest.approx((outline[:, 1].min(), 0.22))

    frame = int(np.argmax(scene.times() > scene.settle)) + 5  # it has turned a little
    (first, second, *_), axes = grousers(run, frame), rotation_matrices(run.pose[frame, 3:])
    own = (first - run.pose[frame, :3]) @ axes
    assert np.abs(axes - rotation_matrices(run.pose[0, 3:])).max() > 0.01
    assert own.min(axis=0) == pytest.approx([0.0, -0.04, -0.002])
    assert own.max(axis=0) == pytest.approx([0.11, 0.04, 0.002])
    own = (second - run.pose[frame, :3]) @ axes
    assert own[:, 2].max() == pytest.approx(0.11)  # at the body's +z


def test_a_cylinder_on_a_path_is_drawn_as_a_wheel():
    shape = {"grousers": 4, "grouser_height": 0.01, "grouser_thickness": 0.004}
    tool = {"shape": "cylinder", "diameter": 0.2, "width": 0.08} | shape
    run = SimpleNamespace(scene={"kind": "body", "tool": tool}, pose=REST, mesh=None)
    assert np.ptp(np.concatenate(body_silhouette(run, 0)), axis=0) == pytest.approx(0.22)
    assert np.linalg.norm(body_silhouette(run, 0)[0] - REST[0, [0, 2]], axis=1) == pytest.approx(0.1)


def test_a_blade_is_its_box(pair):
    run = pair[0]
    corners = body_corners(run, 3)
    assert corners.mean(axis=0) == pytest.approx(run.pose[3, :3])
    distance = np.linalg.norm(corners - run.pose[3, :3], axis=1)
    assert distance == pytest.approx(0.5 * np.linalg.norm(PLATE))
    (outline,) = body_silhouette(run, 0)
    sides = np.linalg.norm(np.roll(outline, -1, axis=0) - outline, axis=1)
    assert np.sort(sides) == pytest.approx([PLATE[0]] * 2 + [PLATE[2]] * 2, rel=1e-6)
    assert outline.mean(axis=0) == pytest.approx(run.pose[0, [0, 2]])


def test_other_bodies_are_the_vertices_of_their_mesh_or_their_recorded_points():
    points = np.random.default_rng(0).normal(size=(2, 8, 3))
    run = SimpleNamespace(scene={"kind": "body"}, body_points=points, pose=REST, mesh=None)
    assert np.array_equal(body_corners(run, 1), points[1])
    run.mesh = (points[0], None)
    assert body_corners(run, 0) == pytest.approx(points[0] + REST[0, :3])


def shape_area(polygons):
    x, y = np.moveaxis(np.array(polygons), -1, 0)
    return 0.5 * np.abs((x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1)).sum(axis=1)).sum()


def test_a_mesh_that_is_not_convex_is_drawn_as_it_is():
    vertices, triangles = u_profile()
    run = SimpleNamespace(scene={"kind": "body"}, pose=REST, mesh=(vertices, triangles))
    assert body_triangles(run, 0) == pytest.approx(vertices[triangles] + REST[0, :3])
    assert shape_area(body_silhouette(run, 0)) == pytest.approx(7.0)  # its hull: 9
    assert shape_area(body_silhouette(run, 0, (0, 1))) >= 3.0 - 1e-9


def test_the_cut_of_a_mesh_goes_around_its_walls():
    vertices, triangles = u_profile()
    run = SimpleNamespace(scene={"kind": "body"}, pose=REST, mesh=(vertices, triangles))
    start, end = body_cut(run, 0, 0.7).swapaxes(0, 1)
    enclosed = 0.5 * (start[:, 0] * end[:, 1] - start[:, 1] * end[:, 0]).sum()
    assert abs(enclosed) == pytest.approx(7.0)
    assert len(body_cut(run, 0, 1.3)) == len(body_cut(run, 0, 0.1)) == 0  # it lies beside


def test_a_view_shows_what_is_between_the_walls_of_a_mesh(pair):
    """A U with a plate on one side, as a bucket with a cheek: where the cheek is, one sees the soil before it."""
    vertices, triangles = u_profile()
    cheek = 0.5 * CUBE * [6.0, 0.2, 6.0] + [0.0, 0.9, 0.0]
    hidden = ConvexHull(cheek)
    faces = hidden.simplices.copy()
    normals = np.cross(*(cheek[faces[:, k]] - cheek[faces[:, 0]] for k in (1, 2)))
    inwards = np.einsum("ij,ij->i", normals, hidden.equations[:, :3]) < 0.0
    faces[inwards] = faces[inwards][:, ::-1]
    mesh = 0.1 * np.concatenate([vertices, cheek]), np.concatenate([triangles, faces + len(vertices)])
    run = SimpleNamespace(
        scene={"kind": "body"},
        pose=np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]]),
        mesh=mesh,
        force=np.zeros((1, 3)),
        time=np.zeros(1),
        positions=lambda frame: np.array([[[0.25, 0.05, 0.15]]]),
        velocities=lambda frame: np.zeros((1, 1, 3)),
    )
    scales = Scales(np.array([True]), 0.05, Normalize(0.0, 1.0), 0.0, (0.0, 0.3), (0.0, 0.3), 0.02)
    figure = figures.new_figure(3.0, 3.0, None)
    axis = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    draw_view(axis, "", run, 0, scales, 3.0)
    picture = pixels(figure)
    height, width = picture.shape[:2]
    for place, colour in (
        ((0.25, 0.05), STEEL),
        ((0.05, 0.15), STEEL),
        ((0.15, 0.15), BEHIND),
        ((0.25, 0.15), SPEED(0.0)),
    ):
        column, row = round(place[0] / 0.3 * width), round((1.0 - place[1] / 0.3) * height)
        assert picture[row, column, :3] == pytest.approx(to_rgb(colour), abs=0.01)


def test_a_mesh_of_very_many_triangles_is_made_simpler_and_looks_the_same():
    vertices, triangles = u_profile()
    fine = vertices[triangles]
    while len(fine) <= 4 * MOST_TRIANGLES:
        a, b, c = np.moveaxis(fine, 1, 0)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        fine = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3, 3)
    coarse = simpler(fine)
    assert len(coarse) < 2 * MOST_TRIANGLES < len(fine)
    assert area(coarse) == pytest.approx(area(fine), rel=0.05)


def test_a_view_shows_a_bounded_number_of_particles():
    bed = np.random.default_rng(0).uniform(size=(3 * MOST_PARTICLES, 3)) * [1.0, 0.01, 1.0]
    assert middle_slice(bed).sum() == MOST_PARTICLES


def test_a_force_that_points_out_of_the_picture_is_drawn_in_it(pair):
    """From the foot of the tool downwards: matplotlib leaves an arrow out whose head is outside."""
    run, down = pair[0], np.tile([0.0, 0.0, -1000.0], (20, 1))
    scales = common_scales([run], [10], run.positions(0)[0].astype(float))._replace(arrow=1e-3)
    axis = figures.new_figure(4.0, 3.0).subplots()
    draw_view(axis, "run", changed(run, force=down), 10, scales, 4.0)
    (arrow,) = (text for text in axis.texts if getattr(text, "arrow_patch", None))
    assert scales.z_limits[0] <= arrow.xy[1] <= scales.z_limits[1] and arrow.get_annotation_clip() is False
    assert arrow.xyann[1] - arrow.xy[1] == pytest.approx(1.0)


def test_soil_at_rest_looks_at_rest(pair):
    """Its jitter does not set the colours."""
    run, start = pair[0], pair[0].positions(0)[0].astype(float)
    still = changed(
        run, positions=lambda _: run.positions(0) + 1e-4, velocities=lambda _: 1e-4 * run.velocities(0)
    )
    assert common_scales([still], [1], start).speed.vmax == LEAST_SPEED
    colours = plot.surface_figure(still, 1, start).axes[0].images[0]
    assert 2e3 * particle_spacing(start) <= colours.norm.vmax < 5e3 * particle_spacing(start)


def test_a_particle_in_the_air_leaves_the_map_its_colours(pair):
    bed = np.stack(np.meshgrid(*[0.01 * np.arange(n) for n in (30, 30, 3)], indexing="ij"), -1).reshape(-1, 3)
    flying = bed.copy()
    flying[0, 2] += 5.0
    tops = [
        plot.surface_figure(changed(pair[0], positions=lambda _, soil=soil: soil[None]), 1, bed)
        .axes[0]
        .images[0]
        .norm.vmax
        for soil in (bed, flying)
    ]
    assert tops[1] == tops[0]


def changed(run, **parts):
    names = "positions velocities force pose scene body_points mesh time producer".split()
    return SimpleNamespace(**{name: getattr(run, name) for name in names} | parts)
