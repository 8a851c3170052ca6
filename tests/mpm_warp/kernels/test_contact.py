"""What contact does to the soil, whatever the body."""

from dataclasses import replace

import numpy as np
import pytest

from mpm_warp import Bed, Body, Box, Effects, Excavation, MeshBody, Plate, Scene, SceneError, Solver
from sgns_testing.meshes import BOX_FACES, box_corners, write_obj

BED = Bed(size=(0.32, 0.24, 0.10), spacing=0.02, headroom=0.1)


def path(z: float, speed: float, duration: float = 1.0, sinking: float = 0.0, x: float = 0.16):
    rows = [[t, x + speed * t, 0.12, z - sinking * t, 0, 0, 0, 1] for t in (0.0, duration)]
    return tuple(tuple(r) for r in rows)


def forces(scene):
    return np.array([f.force for f in Solver(scene).frames()])


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
    scene = Body(
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


@pytest.mark.parametrize("symmetry", [False, True])
def test_a_plate_that_stops_nodes_takes_the_momentum_of_those_in_it(symmetry):
    """In one step without gravity: nodes of soil at rest within a plate get its velocity along the normal of the end,
    or above it of the nearest face, and along the face what Coulomb's friction allows of it, where it moves that way;
    no others do."""
    velocity, rate = np.array([0.5, 0.0, -0.4]), 20_000.0
    place = np.array([0.1565, 0.12, 0.0577])
    rows = tuple((t, *(place + velocity * t), 0, 0, 0, 1) for t in (0.0, 1.0))
    scene = Excavation(
        bed=BED,
        blade=Plate(length=0.2, width=0.13, thickness=0.05, edge="square"),
        motion="path",
        path=rows,
        contact="nodes",
        contact_margin=0.0,
        gravity=0.0,
        frame_rate=rate,
        duration=1.0 / rate,
    )
    solver = Solver(scene, Effects(symmetry=symmetry), precision="float64")
    assert solver.substeps_per_frame == 1
    force = list(solver.frames())[1].force

    h = BED.spacing
    mass = {}
    for x in np.add(scene.initial_positions(), (0.0, 0.0, BED.size[2])):  # nodes: whole multiples of h
        base = np.floor(x / h - 0.5).astype(int)
        f = x / h - base
        w = np.array([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2])
        for i, j, k in np.ndindex(3, 3, 3):
            node = (base[0] + i, base[1] + j, base[2] + k)
            mass[node] = mass.get(node, 0.0) + w[i, 0] * w[j, 1] * w[k, 2]
    particle = scene.filled[1] * scene.material.bulk_density
    wanted = np.zeros(3)
    for node, share in mass.items():
        q = np.array(node) * h - (0.0, 0.0, BED.size[2]) - place
        depth = np.abs(q) - scene.body.half_size
        if depth.max() < 0.0:
            at_end = q[2] + scene.body.half_size[2] < h
            normal = np.sign(q) * (np.arange(3) == (2 if at_end else depth.argmax()))
            pushed = velocity @ normal
            if pushed > 0.0:
                along = velocity - pushed * normal
                size = np.linalg.norm(along)
                change = pushed * normal + along * min(1.0, scene.blade.friction * pushed / size)
                wanted -= share * particle * change
    assert abs(wanted[[0, 2]]).min() > 0.0
    np.testing.assert_allclose(force / rate, wanted, rtol=1e-9, atol=1e-12)


def test_a_mesh_box_feels_what_a_box_feels(tmp_path):
    size = (0.062, 0.104, 0.10)  # no particle is equally near to two faces
    file = write_obj(tmp_path / "box.obj", 1e3 * box_corners(size, (1.0, 2.0, 3.0)), BOX_FACES)
    one = Body(bed=BED, tool=Box(size=size), path=path(0.052, 0.1, sinking=0.2), duration=0.15)
    two = replace(one, tool=MeshBody(file=str(file), scale=1e-3))
    a, b = forces(one), forces(two)
    assert np.abs(a[:, [0, 2]]).max(axis=0).min() > 1.0
    np.testing.assert_allclose(b, a, atol=0.01 * np.abs(a).max())


def test_a_mesh_scene_survives_plain_data_with_its_mesh(tmp_path):
    """Data that a mesh was read for may come from any file, and open none."""
    file = write_obj(tmp_path / "box.obj", box_corners((0.06, 0.1, 0.1)), BOX_FACES)
    scene = Body(bed=BED, tool=MeshBody(file=str(file)), path=path(0.2, 0.1))
    with pytest.raises(SceneError, match="a mesh, which these data do not hold"):
        Scene.from_dict(scene.to_dict())
    data = scene.to_dict()
    data["tool"].pop("digest")
    assert Scene.from_dict(data) == scene
    file.unlink()
    again = Scene.from_dict(scene.to_dict(), scene.mesh)
    assert again == scene
    np.testing.assert_array_equal(again.body_points(), scene.body_points())
