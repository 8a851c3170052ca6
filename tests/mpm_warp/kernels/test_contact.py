"""What contact does to the soil, whatever the body."""

from dataclasses import replace

import numpy as np
import pytest

from mpm_warp import Bed, Box, Cylinder, MeshBody, Push, Scene, SceneError, Solver
from sgns_testing.meshes import BOX_FACES, box_corners, write_obj

BED = Bed(size=(0.32, 0.24, 0.10), spacing=0.02, headroom=0.1)


def path(z: float, speed: float, duration: float = 1.0, sinking: float = 0.0, x: float = 0.16):
    rows = [[t, x + speed * t, 0.12, z - sinking * t, 0, 0, 0, 1] for t in (0.0, duration)]
    return tuple(tuple(r) for r in rows)


def forces(scene, precision="float32"):
    return np.array([f.force for f in Solver(scene, precision=precision).frames()])


@pytest.mark.parametrize("speed", [0.002, 0.05])
@pytest.mark.parametrize("friction", [0.0, 0.1, 0.3])
def test_sliding_friction_is_coulombs_at_any_speed(speed, friction):
    """A lid over the whole bed, pressed 0.1 mm into it, slides 4 mm: horizontal force / vertical force = its friction,
    however slowly it moves. The soil below is stronger."""
    lid = Box(size=(0.31, 0.23, 0.06), friction=friction)
    duration = 0.004 / speed
    height = (
        0.03 - 0.01 - 0.0001
    )  # the highest particles' centres lie half a particle spacing below the surface
    scene = Push(
        bed=BED,
        tool=lid,
        path=path(height, speed, duration, x=0.158),
        duration=duration,
        contact_margin=-0.5,  # contact begins when a particle's centre is at the surface
        frame_rate=10.0 / duration,
    )
    late = forces(scene)[-5:].mean(axis=0)
    assert late[2] > 10.0
    assert -late[0] / late[2] == pytest.approx(friction, abs=0.003)
    assert abs(late[1]) < 1e-3 * late[2]


def test_a_mesh_box_feels_what_a_box_feels(tmp_path):
    size = (0.062, 0.104, 0.10)  # no particle is equally near to two faces
    file = write_obj(tmp_path / "box.obj", 1e3 * box_corners(size, (1.0, 2.0, 3.0)), BOX_FACES)
    one = Push(bed=BED, tool=Box(size=size), path=path(0.052, 0.1, sinking=0.2), duration=0.15)
    two = replace(one, tool=MeshBody(file=str(file), scale=1e-3))
    a, b = forces(one), forces(two)
    assert np.abs(a[:, [0, 2]]).max(axis=0).min() > 1.0
    np.testing.assert_allclose(b, a, atol=0.01 * np.abs(a).max())


def test_a_cylinder_pushed_sideways_is_symmetric():
    sinking = path(0.03, 0.1, sinking=0.2)
    scene = Push(bed=BED, tool=Cylinder(diameter=0.06, width=0.10), path=sinking, duration=0.2)
    force = forces(scene, "float64")
    assert force[-1, 0] < -1.0
    assert np.abs(force[:, 1]).max() < 1e-8 * np.abs(force).max()


@pytest.mark.parametrize("tool", [Box(), Cylinder(grousers=5, grouser_height=0.01, grouser_thickness=0.01)])
def test_a_body_scene_survives_plain_data(tool):
    scene = Push(bed=BED, tool=tool, path=path(0.2, 0.1))
    assert Scene.from_dict(scene.to_dict()) == scene
    assert len(scene.body_points()) == len(tool.points())
    assert scene.mesh is None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"path": None}, "scene.path is missing"),
        ({"path": path(-0.2, 0.1)}, "the body leaves the bin at 0.000 s: z = "),
        (
            {"tool": Box(size=(0.1, 0.1, 0.01)), "contact_margin": -1.0},
            "a body of 0.01 m is too thin for a grid of 0.02 m",
        ),
    ],
)
def test_what_a_body_scene_refuses(change, words):
    with pytest.raises(SceneError, match=words):
        Push(**({"bed": BED, "path": path(0.2, 0.1)} | change))


@pytest.mark.parametrize("tool", [{"shape": "cone"}, {}, 3])
def test_unknown_shapes(tool):
    data = Push(bed=BED, path=path(0.2, 0.1)).to_dict() | {"tool": tool}
    with pytest.raises(SceneError, match=r"scene.tool.shape is .*; allowed: box, cylinder, mesh"):
        Scene.from_dict(data)


def test_a_mesh_scene_survives_plain_data_with_its_mesh(tmp_path):
    """Data that a mesh was read for may come from any file, and open none."""
    file = write_obj(tmp_path / "box.obj", box_corners((0.06, 0.1, 0.1)), BOX_FACES)
    scene = Push(bed=BED, tool=MeshBody(file=str(file)), path=path(0.2, 0.1))
    with pytest.raises(SceneError, match="does not come with these data"):
        Scene.from_dict(scene.to_dict())
    data = scene.to_dict()
    data["tool"].pop("digest")
    assert Scene.from_dict(data) == scene
    file.unlink()
    again = Scene.from_dict(scene.to_dict(), scene.mesh)
    assert again == scene
    np.testing.assert_array_equal(again.body_points(), scene.body_points())
