"""Leakage: what it counts, and that plates do not leak."""

import numpy as np
import pytest
from leakage import leakage, leaked, pushed_plate

from mpm_warp import Frame, Plate, Solver
from mpm_warp.poses import about_y
from sgns_testing.scenes import cut

PLATE = Plate(thickness=0.02, width=0.2, length=0.1, edge="square")


def frame(positions, pose=(0, 0, 0, 0, 0, 0, 1)):
    nothing = np.zeros((len(positions), 3), dtype=np.float32)
    return Frame(
        index=0, time=0.0, position=np.array(positions, dtype=np.float32), velocity=nothing,
        body_pose=np.array(pose, dtype=float), body_points=np.zeros((0, 3)), force=np.zeros(3),
        torque=np.zeros(3),
    )  # fmt: skip


def test_what_counts_as_a_leak():
    start = [[0.01, 0, 0], [-0.01, 0, 0], [0.01, 0.15, 0], [0.01, 0, 0.2], [0.01, 0, 0.045], [0.03, 0, 0]]
    end = [[-0.01, 0, 0], [0.02, 0, 0], [-0.01, 0.15, 0], [-0.01, 0, 0.2], [-0.01, 0, 0.045], [0.02, 0, 0]]
    frames = [frame(start), frame(end)]
    np.testing.assert_array_equal(leaked(frames, PLATE), [-1, 1, 0, 0, -1, 0])
    np.testing.assert_array_equal(leaked(frames, PLATE, edge=0.01), [-1, 1, 0, 0, 0, 0])
    np.testing.assert_array_equal(leaked([*frames, frames[0]], PLATE), 0)  # it all came back
    assert leakage(frames, PLATE) == pytest.approx(3 / 4)  # the last one met the plate and stayed in front


def test_a_plate_that_moves_through_resting_soil_leaks():
    """Turned and moved: the same motion seen from the body."""
    soil = [[0.05, 0.02, 0.0], [0.05, 0.3, 0.0]]
    q = about_y(0.3)
    frames = [frame(soil, (x, 0, 0, *q)) for x in (0.0, 0.1)]
    np.testing.assert_array_equal(leaked(frames, PLATE), [-1, 0])


@pytest.mark.parametrize(("cells", "margin"), [(2.0, -0.75), (1.5, -0.5), (1.5, -0.25), (0.5, -0.25)])
def test_plates_do_not_leak(cells, margin):
    """A plate goes down 4 cm and then 10 cm forward: nothing comes through more than half a cell from its edges, and at
    the default margin nothing at all."""
    scene = pushed_plate(cells, margin)
    frames = list(Solver(scene).frames())
    assert -np.mean([f.force[0] for f in frames[40:]]) > 20.0
    assert leakage(frames, scene.body, edge=0.01 if margin < cut().contact_margin else 0.0) == 0.0


def test_a_plate_with_an_edge_does_not_leak():
    scene = pushed_plate(2.0, -0.375, edge="bevel")
    frames = list(Solver(scene).frames())
    assert -np.mean([f.force[0] for f in frames[40:]]) > 20.0
    assert leakage(frames, scene.body) == 0.0


def test_half_way_through_a_ground_edge_is_the_middle_of_its_wedge():
    plate = Plate(thickness=0.02, width=0.2, length=0.1, edge="bevel")
    ground = -0.05 + (0.01 - np.array([0.005, -0.005])) * 3.0**0.5  # its face at these x
    ways = [
        (
            (0.005, ground[0] + 0.001),
            (-0.005, ground[1] + 0.001),
        ),  # along the ground face, pressed in by 0.5 mm
        ((0.011, -0.04), (-0.011, -0.04)),  # through the wedge, below the middle of the ground face
        ((-0.011, -0.04), (0.011, -0.04)),
        ((0.011, -0.051), (-0.011, -0.051)),  # below the tip
        ((0.011, -0.047), (-0.011, -0.047)),  # 3 mm above it
        ((0.011, 0.0), (-0.011, 0.0)),
    ]
    frames = [frame([[x, 0.0, z] for x, z in places]) for places in zip(*ways, strict=True)]
    np.testing.assert_array_equal(leaked(frames, plate), [0, -1, 1, 0, -1, -1])
    np.testing.assert_array_equal(leaked(frames, plate, edge=0.005), [0, -1, 1, 0, 0, -1])
