"""Tools in the soil at the start: distances, what is left out, and that the rest stays calm."""

import numpy as np
import pytest

from mpm_warp import Bed, Body, Box, Cylinder, MeshBody, Scene, Solver, Wheel, effects_for
from mpm_warp.poses import about_y
from mpm_warp.tool_geometry import distances
from sgns_testing.meshes import box_corners, box_triangles
from sgns_testing.scenes import cut

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
