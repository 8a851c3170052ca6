"""Floor and walls: sticking, sliding, friction, periodic ends, and a tilted bin."""

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import warp as wp
from scipy.spatial import cKDTree

from mpm_warp import Bed, Effects, Scene, SceneError, Solver, Walls, arrange
from mpm_warp.bed import POISSON_RADIUS
from mpm_warp.kernels.grid import grid_step
from sgns_testing.scenes import BlockBed, block

# --- Floor and walls: sticking, sliding, friction, periodic ends, and a tilted bin ----------------------

ELASTIC = Effects(yielding=False, rate_dependence=False, separation=False)


def box_on_floor(walls: Walls, tilt: float = 0.0, duration: float = 0.1) -> Scene:
    """A block of 10 x 10 x 5 particles that stands on the floor and touches no wall."""
    bed = BlockBed(
        size=(0.3, 0.2, 0.1),
        spacing=0.01,
        low=(0.05, 0.05, -0.1),
        high=(0.15, 0.15, -0.05),
        initial_stress="none",
        headroom=0.1,
        walls=walls,
    )
    return Scene(bed=bed, tilt=tilt, duration=duration, frame_rate=100.0)


@pytest.mark.parametrize(("floor", "friction"), [("slip", 0.0), (0.1, 0.1), (0.3, 0.3)])
def test_soil_slides_down_a_slope(floor, friction):
    """a = g (sin(tilt) - friction cos(tilt)) once it slides, and it stays on the floor."""
    scene = box_on_floor(Walls(floor=floor), tilt=30.0, duration=0.2 if friction else 0.1)
    frames = list(Solver(scene, ELASTIC, precision="float64").frames())
    time, speed = scene.times(), np.array([f.velocity.mean(axis=0) for f in frames])
    tilt = math.radians(30.0)
    expected = 9.81 * (math.sin(tilt) - friction * math.cos(tilt))
    slope = np.polyfit(time[5:], speed[5:, 0], 1)[0]
    assert slope == pytest.approx(expected, rel=0.03 if friction else 1e-5)
    assert np.abs(speed[:, 1]).max() < 1e-9
    assert abs(speed[-5:, 2].mean()) < 0.01


@pytest.mark.parametrize("floor", ["no_slip", 0.5])
def test_a_layer_on_a_slope_below_its_friction_angle_stays_still(floor):
    """An endless layer on a slope of 20 degrees (tan = 0.36) starts in balance and stays."""
    bed = Bed(size=(0.08, 0.08, 0.1), spacing=0.02, headroom=0.04, walls=Walls("periodic", "periodic", floor))
    frame = list(Solver(Scene(bed=bed, tilt=20.0, duration=0.3)).frames())[-1]
    assert np.abs(frame.velocity).max() < 1e-3
    np.testing.assert_allclose(frame.position, bed.filled[0], atol=2e-4)


@pytest.mark.parametrize(("floor", "leaves"), [("no_slip", False), ("slip", False), (0.3, True)])
def test_only_a_wall_with_friction_lets_soil_go(floor, leaves):
    scene = replace(box_on_floor(Walls(floor=floor), duration=0.02), gravity=0.0)
    solver = Solver(scene, ELASTIC, precision="float64")
    solver.particles.velocity.assign(np.tile([0.0, 0.0, 0.5], (solver.particle_count, 1)))
    last = list(solver.frames())[-1]
    lowest = last.position[:, 2].min() - scene.initial_positions()[:, 2].min()
    assert (lowest > 0.5 * 0.5 * 0.02) == leaves


@pytest.mark.parametrize("axis", [0, 1])
def test_a_periodic_seam_is_nowhere(axis):
    """A block that crosses the seam moves as one in the middle of the bin does."""
    bed = replace(block().bed, walls=Walls(**{"xy"[axis]: "periodic"}))
    far = np.zeros(3)
    far[axis] = 0.07
    across = replace(bed, low=tuple(bed.low + far), high=tuple(bed.high + far))
    start, last = [], []
    for b in (bed, across):
        scene = Scene(bed=b, gravity=0.0, duration=0.1, frame_rate=100.0)
        solver = Solver(scene, precision="float64")
        x = solver.particles.position.numpy()
        middle = x.mean(axis=0)
        pushed = -2.0 * (x - middle)
        pushed[:, axis] += 0.6
        solver.particles.velocity.assign(pushed)
        frames = list(solver.frames())
        start.append(frames[0].position)
        last.append(frames[-1].position)
    assert last[1][:, axis].max() > 0.3  # it did cross, and its positions go on counting
    np.testing.assert_allclose(last[1] - start[1], last[0] - start[0], atol=1e-7)


def test_no_two_kinds_of_walls_share_a_kernel():
    """Warp takes kernels for the same, here and in its cache, whose text and functions are the same, whatever the names
    under which the text calls the functions."""
    kinds = ("no_slip", "slip", "friction", "periodic")
    walls = list(product(kinds, kinds, kinds[:3]))
    for form in ("alone", "together"):
        kernels = [getattr(grid_step(wp.float32, kinds).step, form) for kinds in walls]
        assert len({kernel.module.get_module_hash() for kernel in kernels}) == len(walls) == 48


# --- Beds: full, inside, reproducible -------------------------------------------------------------------

SIZE = (0.2, 0.15, 0.07)


@pytest.mark.parametrize("kind", ["lattice", "jittered", "poisson"])
def test_particles_are_in_the_bin_and_reproducible(kind):
    points, volume = arrange(kind, SIZE, 0.014, seed=3)
    assert np.all(points >= [0, 0, -SIZE[2]])
    assert np.all(points <= [SIZE[0], SIZE[1], 0])
    if kind != "poisson":
        assert len(points) * volume == pytest.approx(np.prod(SIZE), rel=1e-12)  # the bed is full
    arrange.cache_clear()
    np.testing.assert_array_equal(points, arrange(kind, SIZE, 0.014, seed=3)[0])


def test_the_papers_bed_has_29700_particles():
    assert len(arrange("lattice", (0.8, 0.6, 0.15), 0.8 / 60, 0)[0]) == 29700


def test_poisson_points_keep_their_distance_and_are_as_dense_as_the_published():
    """The published bed holds 0.797 of a full one; the share near walls and surface is the same as inside."""
    spacing = 0.01
    points, volume = arrange("poisson", SIZE, spacing, seed=0)
    nearest = cKDTree(points).query(points, k=2)[0][:, 1]
    assert nearest.min() >= POISSON_RADIUS * spacing * (1 - 1e-9)
    assert len(points) * volume / np.prod(SIZE) == pytest.approx(0.797, abs=0.02)
    top = np.mean(points[:, 2] > -2 * spacing) / (2 * spacing / SIZE[2])
    assert top == pytest.approx(1.0, abs=0.06)


def test_unknown_arrangement():
    with pytest.raises(SceneError, match="allowed: lattice, jittered, poisson"):
        arrange("heap", SIZE, 0.01, 0)


def test_momentum_along_periodic_axes_is_conserved():
    """On a slippery floor nothing takes momentum along x and y, however the soil is shaken."""
    bed = Bed(
        size=(0.06, 0.06, 0.06), spacing=0.01, headroom=0.05, walls=Walls("periodic", "periodic", "slip")
    )
    solver = Solver(Scene(bed=bed, duration=0.05, frame_rate=200.0), precision="float64")
    kick = np.random.default_rng(0).normal(size=(solver.particle_count, 3)) * 0.1
    solver.particles.velocity.assign(kick)
    list(solver.frames())
    after = solver.particles.velocity.numpy().sum(axis=0)
    np.testing.assert_allclose(after[:2], kick.sum(axis=0)[:2], atol=1e-12 * np.abs(kick).sum())
