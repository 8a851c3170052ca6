"""Bodies and mesh files: what they are, what they refuse."""

import math

import numpy as np
import pytest

from mpm_warp import Body, Box, Cylinder, Excavation, MeshBody, Plate, Scene, SceneError
from mpm_warp.poses import about_y, in_world_frame
from mpm_warp.preview import Preview
from sgns_testing.meshes import BOX_FACES, box_corners, box_triangles, write_obj, write_stl, write_text_stl

SIZE = (0.1, 0.2, 0.3)
CORNERS = box_corners(SIZE, (5.0, -2.0, 1.0))


@pytest.mark.parametrize("form", ["obj", "stl", "text stl"])
def test_a_mesh_is_about_its_centre_of_mass(tmp_path, form):
    writers = {
        "obj": lambda: write_obj(tmp_path / "a.obj", CORNERS, BOX_FACES),
        "stl": lambda: write_stl(tmp_path / "a.stl", CORNERS, box_triangles()),
        "text stl": lambda: write_text_stl(tmp_path / "a.STL", CORNERS, box_triangles()),
    }
    body = MeshBody(file=str(writers[form]()))
    vertices, triangles = body.mesh
    assert vertices.shape == (8, 3)
    assert triangles.shape == (12, 3)
    assert not body.warnings()
    np.testing.assert_allclose(np.abs(vertices), np.tile(np.array(SIZE) / 2, (8, 1)), atol=1e-6)


def test_a_mesh_that_was_turned_says_so(tmp_path):
    file = write_stl(tmp_path / "in.stl", CORNERS, box_triangles()[:, ::-1])
    assert "faced inwards" in MeshBody(file=str(file)).warnings()[0]


@pytest.mark.parametrize(
    ("faces", "words"),
    [
        (BOX_FACES[1:], "not closed: 4 of 17 edges"),
        ([], "holds no triangles"),
        ([(0, 1, 9)], "not a good OBJ file: a face names a vertex that is not there"),
    ],
)
def test_bad_meshes(tmp_path, faces, words):
    file = write_obj(tmp_path / "bad.obj", CORNERS, faces)
    with pytest.raises(SceneError, match=words):
        MeshBody(file=str(file))


def test_bad_mesh_files(tmp_path):
    cut_short = write_stl(tmp_path / "short.stl", CORNERS, box_triangles())
    cut_short.write_bytes(b"\0" * 80 + cut_short.read_bytes()[80:-7])
    with pytest.raises(SceneError, match="cut short"):
        MeshBody(file=str(cut_short))
    with pytest.raises(SceneError, match=r"allowed: \*.stl, \*.obj, \*.ply, \*.off, \*.glb, \*.3mf"):
        (tmp_path / "a.step").write_text("ISO-10303-21;")
        MeshBody(file=str(tmp_path / "a.step"))
    with pytest.raises(SceneError, match="cannot read"):
        MeshBody(file=str(tmp_path / "none.stl"))
    with pytest.raises(SceneError, match=r"tool\.file is missing"):
        MeshBody()
    flat = write_obj(tmp_path / "flat.obj", CORNERS * [1, 1, 0], BOX_FACES)
    with pytest.raises(SceneError, match=r"tool\.file"):
        MeshBody(file=str(flat))


def test_a_scene_knows_whether_its_mesh_is_the_same(tmp_path):
    file = write_obj(tmp_path / "box.obj", CORNERS, BOX_FACES)
    body = MeshBody(file=str(file))
    assert MeshBody(file=str(file), digest=body.digest) == body
    write_obj(file, CORNERS * 2.0, BOX_FACES)
    with pytest.raises(SceneError, match="is not the file this scene was made with"):
        MeshBody(file=str(file), digest=body.digest)


def test_nodes_lie_on_the_bodies(tmp_path):
    wheel = Cylinder(diameter=0.3, width=0.125)
    points = wheel.points()
    assert points.shape == (16, 3)
    np.testing.assert_allclose(np.hypot(points[:, 0], points[:, 2]), 0.15)
    np.testing.assert_allclose(np.abs(points[:, 1]), 0.0625)
    np.testing.assert_allclose(points.mean(axis=0), 0.0, atol=1e-12)
    assert Box().points().shape == (8, 3)
    file = write_obj(tmp_path / "box.obj", CORNERS, BOX_FACES)
    assert np.unique(MeshBody(file=str(file)).points().round(9), axis=0).shape == (8, 3)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda v, t: (v[:, :2], t), "vertices"),
        (lambda v, t: (v, t[:0]), "no triangles"),
        (lambda v, t: (v, t.astype(float)), "no triangles of whole numbers"),
        (lambda v, t: (v, t - 1), "vertex that is not there"),
        (lambda v, t: (v, t + 1), "vertex that is not there"),
        (lambda v, t: (v * np.nan, t), "not finite"),
        (lambda v, t: (v * 1e12, t), "beyond 1e\\+06 m"),
        (lambda v, t: (v, t[1:]), "not closed"),
        (lambda v, t: (v, t[:, ::-1]), "faces inwards"),
        (lambda v, t: (v + 0.01, t), "not about its centre of mass"),
        (lambda v, t: (v * [1, 1, 0], t), "encloses no volume"),
    ],
)
def test_a_known_mesh_is_checked(tmp_path, change, words):
    body = MeshBody(file=str(write_obj(tmp_path / "box.obj", CORNERS, BOX_FACES)))
    with pytest.raises(SceneError, match=words):
        MeshBody.of_mesh(*change(*body.mesh[:2]), file="box.obj")


TURN = (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))  # a quarter about z: x becomes y


@pytest.mark.parametrize(
    ("origin", "place"), [("com", (0, 0, 0)), ("tip", (0, 0, -0.15)), ("file", (-0.05, -0.1, -0.15))]
)
def test_a_path_may_be_that_of_another_point(tmp_path, origin, place):
    """In millimetres; the corner of the box is the file's origin."""
    file = write_obj(tmp_path / "box.obj", 1e3 * box_corners(SIZE), BOX_FACES)
    tool = MeshBody(file=str(file), unit="mm", origin=origin)
    np.testing.assert_allclose(tool.path_point, place, atol=1e-12)
    path = ((0.0, 0.4, 0.3, 0.4, *TURN), (1.0, 0.5, 0.3, 0.4, *TURN))
    scene = Body(tool=tool, path=path, duration=1.0)
    x, y, z = place
    np.testing.assert_allclose(scene.body_poses()[0, :3], np.array([0.4, 0.3, 0.4]) - [-y, x, z], atol=1e-12)
    file.unlink()  # what a run holds is enough
    again = Scene.from_dict(scene.to_dict(), scene.mesh)
    np.testing.assert_array_equal(again.body_poses(), scene.body_poses())
    assert again.to_dict() == scene.to_dict()
    assert any("centre of mass" in line and "mm" in line for line in Preview.of(scene).lines)


def test_a_box_and_a_cylinder_have_a_tip():
    assert Box(origin="tip").path_point.tolist() == [0.0, 0.0, -0.05]
    assert Cylinder(origin="tip").path_point.tolist() == [0.0, 0.0, -0.075]
    assert not Box().path_point.any()


def test_old_runs_keep_their_tool(tmp_path):
    """Those from before `unit`, `origin` and `centre`."""
    body = MeshBody(file=str(write_obj(tmp_path / "box.obj", CORNERS, BOX_FACES)))
    old = {"shape": "mesh", "file": "gone.obj", "scale": 1.0, "friction": 0.3, "digest": body.digest}
    data = {"kind": "body", "tool": old, "path": [[0.0, 0.4, 0.3, 0.4, 0, 0, 0, 1]]}
    scene = Scene.from_dict(data, body.mesh)
    assert not scene.body.path_point.any()
    np.testing.assert_array_equal(scene.mesh[0], body.mesh[0])


@pytest.mark.parametrize("rake", [-20.0, 0.0, 30.0])
@pytest.mark.parametrize("edge", ["square", "level", "bevel"])
def test_the_tip_of_a_plate_is_where_the_motion_says(edge, rake):
    """A square end reaches below it on one side, a level end and an edge do not."""
    scene = Excavation(blade=Plate(edge=edge), rake=rake, depth=0.06, motion="curved")
    poses = scene.body_poses()
    tip = in_world_frame(poses, scene.body.tip[None])[:, 0]
    assert tip[0] == pytest.approx([0.08, 0.3, 0.00665])
    below = tip[:, 2] - scene.lowest_points(poses)
    deeper = 0.5 * Plate.thickness * abs(math.sin(math.radians(rake))) if edge == "square" else 0.0
    if edge == "bevel" and rake < 0.0:
        assert (below < 1e-9).all()
    else:
        assert below == pytest.approx(deeper, abs=1e-9)
    end = in_world_frame(poses[:1], scene.body.corners)[0][[0, 3], 2]
    if edge == "level":
        assert end[0] == pytest.approx(end[1])
    points = scene.body_points()
    assert points[:, 0] == pytest.approx(0.014)
    assert points[:, 2].min() == pytest.approx(scene.body.section[0, 1])


def test_a_level_end_is_level_where_a_path_starts():
    rows = [(t, 0.2 + 0.1 * t, 0.3, 0.2 - 0.05 * t, *about_y(-math.radians(25.0))) for t in (0.0, 1.0)]
    scene = Excavation(blade=Plate(edge="level"), motion="path", path=rows, duration=1.0)
    assert scene.body.cut_angle == pytest.approx(25.0)
    assert scene.blade.cut_angle == 0.0  # a plate alone knows no path


def test_a_plate_too_short_for_its_edge():
    with pytest.raises(
        SceneError, match=r"blade.length is 0.04 m; an edge that is cut by 60 degrees needs more"
    ):
        Plate(length=0.04, thickness=0.028, edge="bevel")
