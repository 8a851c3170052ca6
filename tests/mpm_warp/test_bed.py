"""Floor and walls: sticking, sliding, friction, periodic ends, and a tilted bin."""

import math
from dataclasses import replace
from itertools import islice, product

import numpy as np
import pytest
import warp as wp
from scipy.spatial import cKDTree

from mpm_warp import Bed, Column, Effects, Preview, Scene, SceneError, Solver, Walls, arrange
from mpm_warp.bed import POISSON_RADIUS
from mpm_warp.discretisation import asymmetry, initial_stress
from mpm_warp.kernels.grid import grid_step
from sgns_testing.scenes import BlockBed, block, cut

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


# --- The surface at the start ---------------------------------------------------------------------------


def hill(x, y):
    return 0.04 * np.exp(-((x - 0.3) ** 2 + (y - 0.2) ** 2) / 0.01) - 0.01


@pytest.mark.parametrize(
    ("arrangement", "surface", "share"),
    [
        ("lattice", 20.0, 0.005),
        ("lattice", hill, 0.01),
        ("lattice", [[-0.05, 0.0], [0.05, 0.02]], 0.005),
        ("lattice", np.full((2, 2), -0.013), 0.005),
        ("jittered", hill, 0.01),
        ("poisson", hill, 0.03),
    ],
)
def test_the_mass_is_the_integral_of_the_map(arrangement, surface, share):
    size = (0.6, 0.4, 0.12)
    bed = Bed(size=size, spacing=0.03, particles_per_cell=2.0, arrangement=arrangement, surface=surface)
    positions, volume = bed.filled
    assert volume == bed.particle_volume
    x, y = np.meshgrid((np.arange(300) + 0.5) / 500, (np.arange(200) + 0.5) / 500, indexing="ij")
    exact = 0.6 * 0.4 * (0.12 + bed.surface_at(x.ravel(), y.ravel()).mean())
    assert bed.soil_volume == pytest.approx(exact, rel=1e-3)
    assert len(positions) * volume == pytest.approx(exact * bed.filling, rel=share)
    assert (positions[:, 2] < bed.surface_at(*positions[:, :2].T) + 0.5 * bed.particle_spacing).all()
    assert positions[:, 2].min() == pytest.approx(-0.12, abs=bed.particle_spacing)
    assert bed.arrangement_hash != replace(bed, surface=None).arrangement_hash
    assert Bed.from_dict(Scene(bed=bed).to_dict()["bed"]) == bed


def test_a_symmetric_map_is_a_symmetric_bed():
    def ridge(x, y):
        return 0.03 - 0.2 * np.hypot(x - 0.1, y - 0.2)

    assert asymmetry(Scene(bed=Bed(size=(0.4, 0.4, 0.12), spacing=0.02, surface=ridge))) is None


def test_a_map_is_stretched_over_the_bin_and_linear_between_its_points():
    bed = Bed(size=(0.6, 0.4, 0.12), surface=[[0.0, 0.02, 0.04], [0.03, 0.05, 0.07]])
    x, y = np.array([0.0, 0.6, 0.3, 0.6, 0.7]), np.array([0.0, 0.4, 0.1, 0.2, -1.0])
    np.testing.assert_allclose(bed.surface_at(x, y), [0.0, 0.07, 0.025, 0.05, 0.03], atol=1e-12)
    np.testing.assert_allclose(bed.slope_at(x[2:4], y[2:4]), [[0.05, 0.05], [0.1, 0.1]], atol=1e-9)
    slope = Bed(size=(0.6, 0.4, 0.12), surface=20.0)
    np.testing.assert_allclose(
        slope.surface_at(x[:2], y[:2]), [-0.3 * math.tan(math.radians(20)), 0.3 * math.tan(math.radians(20))]
    )


def test_a_flat_map_is_the_flat_bed():
    bed = Bed(size=(0.3, 0.2, 0.12), spacing=0.02, particles_per_cell=4.0)
    for one, same in ((bed, replace(bed, surface=0.0)), (bed, replace(bed, surface=np.zeros((3, 4))))):
        np.testing.assert_array_equal(one.filled[0], same.filled[0])
        for a, b in zip(initial_stress(Scene(bed=one)), initial_stress(Scene(bed=same)), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-12)


def heap(slope: float, **kw) -> Scene:
    """A ridge 6 cm high in a channel, with sides of a slope [degrees]."""
    fall = math.tan(math.radians(slope))
    bed = Bed(
        size=(0.4, 0.06, 0.08),
        spacing=0.01,
        headroom=0.1,
        surface=lambda x, y: np.maximum(-0.06, 0.03 - fall * np.abs(x - 0.2)),
        walls=Walls(y="slip"),
        particles_per_cell=4.0,
        **kw,
    )
    return Scene(bed=bed, duration=0.3, frame_rate=20.0)


def furthest(scene: Scene) -> float:
    """Way of the particle that moves furthest [m]."""
    first, *_, last = Solver(scene).frames()
    return float(np.linalg.norm(last.position - first.position, axis=1).max())


def test_a_heap_stands_below_its_friction_angle_and_flows_above():
    assert heap(25.0).warnings() == []
    assert furthest(heap(25.0)) < 1e-3
    (warning,) = heap(60.0).warnings()
    assert "bed.surface is up to 60 degrees steep, more than the soil's friction (37.2 degrees)" in warning
    assert furthest(heap(60.0)) > 0.01


def test_the_stress_below_a_slope_carries_it():
    """Without the shear stress of the slope the soil first gives way."""
    bed = Bed(size=(0.4, 0.06, 0.08), spacing=0.01, headroom=0.12, surface=20.0, walls=Walls(y="slip"))
    first, second = islice(Solver(Scene(bed=bed, frame_rate=200.0)).frames(), 2)
    inside = (first.position[:, 0] > 0.1) & (first.position[:, 0] < 0.3)
    assert np.abs(second.velocity[inside]).mean() < 2e-3  # 9.81 / 200 in free fall


@pytest.mark.parametrize(
    ("surface", "words"),
    [
        (70.0, "bed.surface is 70.0 degrees; allowed: -60 to 60, or a map of heights"),
        ("map.npy", "bed.surface is 'map.npy' degrees; allowed"),
        ([[0.0, 1.0], [0.0]], "is no map of heights; it needs 2 or more rows"),
        ([[0.0, 0.01]], "is no map of heights"),
        ([[0.0, "a"], [0.0, 0.0]], "is no map of heights"),
        ([[0.0, np.nan], [0.0, 0.0]], "not finite, in row 1, number 2"),
        (np.zeros((400, 400)), "has 400 x 400 heights; at most 100000"),
        ([[0.0, 0.3], [0.0, 0.0]], r"reaches from 0 to 0.3 m; allowed: from the floor \(-0.15 m\) to below"),
        ([[0.0, -0.2], [0.0, 0.0]], r"reaches from -0.2 to 0 m"),
        (np.full((2, 2), -0.15), r"a grid spacing of soil somewhere"),
    ],
)
def test_surfaces_that_are_refused(surface, words):
    with pytest.raises(SceneError, match=words):
        Bed(surface=surface)
    with pytest.raises(SceneError, match=r"bed.surface is given, but a scene of the kind column"):
        Column(bed=replace(Column().bed, surface=5.0))


def test_a_tool_in_a_heap_displaces_it():
    bed = replace(cut().bed, surface=hill, headroom=0.2)
    assert len(cut(bed=bed, clearance=0.01, start=0.6, motion="rest").displaced) > 0
    assert len(cut(bed=bed, clearance=0.08, start=0.6, motion="rest").displaced) == 0
    assert Preview.of(cut(bed=bed, clearance=0.01, start=0.6, motion="rest")).first_touch == 0.0
