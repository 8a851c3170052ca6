"""Soil that came apart: what it knows of its volume."""

from dataclasses import dataclass

import numpy as np
import pytest

from mpm_warp import Bed, Effects, Scene, Solver, Walls

GROWTH = 1e-3  # 1/s, just enough for a sign


@dataclass(frozen=True)
class Expanding(Scene):
    """Soil without gravity that expands slowly everywhere."""

    kind: str = "expanding"

    def initial_velocities(self) -> np.ndarray:
        positions = self.filled[0]
        return GROWTH * (positions - positions.mean(axis=0))


@dataclass(frozen=True)
class Stretched(Bed):
    """A lattice drawn apart in all directions about the middle of the bin's floor, which grows with it."""

    stretch: float = 1.0

    @property
    def filled(self):
        positions, volume = Bed.filled.func(self)
        middle = np.array([0.5 * self.size[0], 0.5 * self.size[1], -self.size[2]])
        near = np.all(np.abs((positions - middle) * self.stretch)[:, :2] < 0.5 * self.size[0], axis=1)
        return (middle + self.stretch * (positions - middle))[near], volume


def stretched(stretch):
    """A wide lattice under much room."""
    size = (0.32, 0.32, 0.16)
    return Stretched(size, 0.02, particles_per_cell=8, headroom=0.3, initial_stress="none", stretch=stretch)


def after_a_frame(kind, bed, effects=None, precision="float32"):
    """The solver of a scene without gravity, and its last frame."""
    solver = Solver(kind(bed=bed, gravity=0.0, duration=1.0 / 60.0), effects, precision=precision)
    *_, last = solver.frames()
    return solver, last


def density_of(solver):
    """Of the nodes, over that of dense soil."""
    grid = solver.grid
    return solver._before.numpy()[:-1, 3].reshape(grid.nx, grid.ny, grid.nz)


@pytest.mark.parametrize("stretch", [1.1, 1.5])
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_loose_soil_is_as_loose_as_the_grid_sees(stretch, precision):
    """Away from walls and edges, where some is pressed together; what is left is the lattice's own noise."""
    solver, last = after_a_frame(Expanding, stretched(stretch), precision=precision)
    inner = np.all(np.abs(last.position - [0.16, 0.16, -0.09]) < [0.07, 0.07, 0.04], axis=1)
    ln_j = solver.particles.log_volume.numpy()
    loose = inner & (ln_j > 0.0)
    assert loose.sum() > 0.9 * inner.sum()
    np.testing.assert_allclose(ln_j[loose], 3.0 * np.log(stretch), atol=0.03)


def test_without_separation_volume_is_integrated_alone():
    solver, _ = after_a_frame(Expanding, stretched(1.5), Effects(separation=False))
    assert np.abs(solver.particles.log_volume.numpy()).max() < 10.0 * GROWTH


@pytest.mark.parametrize(
    ("change", "share"), [({"particles_per_cell": 4}, 1.0), ({"arrangement": "poisson"}, 0.5)]
)
def test_soil_near_dense_soil_keeps_its_own_volume(change, share):
    """A bed that has just begun to expand is dense, up to its surface: ln J is what it integrates. Random points fill
    80 % of a bed; its density is measured by that, and half of them are judged."""
    bed = Bed(size=(0.2, 0.2, 0.1), spacing=0.02, initial_stress="none", **change)
    assert (0.75 < bed.filling < 0.85) == (bed.arrangement == "poisson")
    solver, _ = after_a_frame(Expanding, bed)
    assert np.quantile(solver.particles.log_volume.numpy(), share) < 3.0 * GROWTH


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize(
    ("walls", "symmetry"), [("slip", False), ("slip", True), ("periodic", False), (0.5, False)]
)
def test_an_undisturbed_bed_is_dense_up_to_its_walls(walls, symmetry, precision):
    """At walls and floor, across a seam and a plane of symmetry: every node below the surface sees a density of 1."""
    x_walls, y_walls = walls, "slip" if symmetry else walls
    bed = Bed(size=(0.2, 0.24, 0.1), spacing=0.02, initial_stress="none", walls=Walls(x_walls, y_walls))
    solver, _ = after_a_frame(Scene, bed, Effects(symmetry=symmetry), precision)
    grid, density = solver.grid, density_of(solver)
    heights = float(grid.origin[2]) + bed.spacing * np.arange(grid.nz)
    below = (heights > -0.1 - 1e-6) & (heights < -1e-6)
    inside = []
    for axis, count in enumerate((grid.nx, grid.ny)):
        places = float(grid.origin[axis]) + bed.spacing * np.arange(count)
        inside.append((places > -1e-6) & (places < bed.size[axis] + 1e-6))
    known = density[np.ix_(*inside, below)]
    assert known.shape == (11, 9 if symmetry else 13, 5)
    np.testing.assert_allclose(known, 1.0, rtol=1e-5)


@pytest.mark.parametrize("symmetry", [False, True])
@pytest.mark.parametrize("beyond", [0.1, 0.25, 0.45])
def test_walls_that_lie_within_a_cell_are_dense_too(beyond, symmetry):
    """Nodes on walls that stand beyond the bin, as far as a bed of 27 particles per cell tells [cells]."""
    size = 0.2 - 2.0 * beyond * 0.02
    kind = {"particles_per_cell": 27, "initial_stress": "none", "walls": Walls("slip", "slip")}
    bed = Bed(size=(size, size, 0.06), spacing=0.02, **kind)
    solver, _ = after_a_frame(Scene, bed, Effects(symmetry=symmetry))
    grid, density = solver.grid, density_of(solver)
    at_height = grid.low[2] + 1
    middle_y = (grid.high[1] + (grid.low[1] if not symmetry else 2)) // 2
    walls = [density[x, middle_y, at_height] for x in (grid.low[0], grid.high[0])]
    walls.append(density[grid.nx // 2, grid.high[1], at_height])
    walls.append(density[grid.low[0], grid.high[1], at_height])  # in an edge
    np.testing.assert_allclose(walls, density[grid.nx // 2, middle_y, at_height], rtol=0.05)


@dataclass(frozen=True)
class Rain(Bed):
    """The particles of a bed, drawn apart upwards."""

    @property
    def filled(self):
        positions, volume = Bed.filled.func(self)
        return np.add(positions, [0.0, 0.0, self.size[2]]) * [1.0, 1.0, 12.0], volume


@dataclass(frozen=True)
class Scattered(Scene):
    """Soil that starts with random velocities."""

    kind: str = "scattered"

    def initial_velocities(self) -> np.ndarray:
        return 0.3 * np.random.default_rng(0).uniform(-1.0, 1.0, self.filled[0].shape)


def test_grains_that_fell_one_by_one_lie_as_dense_as_a_bed():
    """Half of them below half of the bed's height; 12 % too high where each integrates its landing alone."""
    size, walls = (0.16, 0.16, 0.08), Walls("slip", "slip")
    bed = Rain(size, 0.02, particles_per_cell=4, headroom=3.0, initial_stress="none", walls=walls)
    *_, last = Solver(Scattered(bed=bed, duration=2.0)).frames()
    assert np.median(last.position[:, 2] + 0.08) == pytest.approx(0.04, rel=0.06)
