"""Fluidity and nonlocality in a whole solver: what is off costs nothing, precisions, symmetry, seams, inclines."""

import math

import numpy as np
import pytest
import stopping
from scipy.integrate import solve_bvp

from mpm_warp import Bed, Effects, Incline, Material, Scene, Solver, SolverStopped, Walls
from sgns_testing.scenes import cut
from sgns_testing.solvers import change

STEADY, DYNAMIC = Effects(nonlocality=True), Effects(fluidity=True, nonlocality=True)
PRESSURE = 1000.0


@pytest.mark.parametrize("at_walls", ["free", "zero"])
@pytest.mark.parametrize("effects", [STEADY, DYNAMIC])
def test_a_periodic_seam_is_nowhere(effects, at_walls):
    """Random flow, and the same flow moved on by 3 and 2 cells through the seams: the same excess on each particle."""
    bed = Bed(
        size=(0.06, 0.08, 0.06),
        spacing=0.01,
        headroom=0.02,
        initial_stress="none",
        walls=Walls("periodic", "periodic"),
    )
    material = Material(grain_diameter=0.02, fluidity_at_walls=at_walls)
    scene = Scene(bed=bed, material=material, gravity=0.0, duration=0.1)
    cells = (6, 8, 6)
    # The particles of the lattice in the order of their cells.
    order = np.lexsort(np.round(scene.initial_positions() / 0.01 - 0.5).astype(int).T[::-1])
    mu = np.random.default_rng(0).uniform(0.3, 0.94, cells)

    def excess(moved):
        solver = Solver(scene, effects, precision="float64")
        e, flow = np.zeros((len(order), 6)), np.roll(mu, moved, axis=(0, 1)).ravel()
        e[order, 4] = flow * PRESSURE / (2.0 * material.shear_modulus)
        solver.particles.elastic_strain.assign(e)
        solver.particles.log_volume.fill_(-PRESSURE / material.bulk_modulus)
        if effects.fluidity:
            g = np.zeros(len(order))
            g[order] = 10.0 * flow
            solver.particles.fluidity.assign(g)
        for launch in (*solver._remap.begin, *solver._steps.begin, *solver._steps.step):
            launch.launch()
        found = solver.particles.excess.numpy()[order].reshape(cells)
        return np.roll(found, [-m for m in moved], axis=(0, 1))

    still = excess((0, 0))
    assert still.std() > 0.05  # there is something to be moved
    np.testing.assert_allclose(excess((3, 2)), still, atol=1e-9 * np.abs(still).max())


def test_stops_where_the_fluidity_is_no_number():
    """Its soil would be elastic and look sound."""
    solver = Solver(cut(duration=0.1, material=Material(grain_diameter=5e-3)), STEADY)
    frames = solver.frames()
    next(frames), next(frames)
    change(solver._cooperative_field, np.nan, at=(..., 3))  # which the steady form's sweeps go on from
    with pytest.raises(SolverStopped, match="its fluidity is not finite"):
        list(frames)


# --- Uniform layers of glass beads on an endless incline ---------------------------------------------------

GRAIN = 3e-3


def speed_in_theory(material, effects, angle, height):
    """Heights and velocity of the steady layer: the one-dimensional equation of g with mu = tan(angle)."""
    z = np.linspace(0.0, height, 300)
    mu, span = math.tan(angle), material.limit_friction - material.static_friction
    growth = span / (material.limit_friction - mu) * (mu - material.static_friction)
    length = material.nonlocal_amplitude * GRAIN

    def quadratic(z):
        pressure = material.packing * 9.81 * math.cos(angle) * np.maximum(height - z, 1e-9)  # over rho_s
        return span * mu * GRAIN / (material.reference_inertial_number * np.sqrt(pressure))

    def slope(z, y):
        if effects.fluidity:
            return np.vstack([y[1], (quadratic(z) * y[0] ** 2 - growth * y[0]) / length**2])
        return np.vstack([y[1], (y[0] - growth / quadratic(z)) * growth / length**2])

    guess = growth / quadratic(z) * (1.0 - np.exp(-z / length))
    found = solve_bvp(
        slope, lambda a, b: np.array([a[0], b[1]]), z, np.vstack([guess, 0.0 * z]), max_nodes=20000
    )
    assert found.success
    g = found.sol(z)[0]
    return z, np.concatenate([[0.0], np.cumsum(0.5 * mu * (g[1:] + g[:-1]) * np.diff(z))])


def flow(material, effects, angle, height, start, duration, spacing):
    """Heights of the particles' rows above the base and their velocity along the incline, at the start `start`(z)."""
    spacing = height / round(height / spacing)
    bed = Bed(
        size=(4 * spacing, 4 * spacing, height),
        spacing=spacing,
        headroom=0.6 * height,
        walls=Walls("periodic", "periodic"),
    )
    values = {"duration": duration, "frame_rate": 1.0 / duration, "tilt": math.degrees(angle)}
    solver = Solver(Incline(bed=bed, material=material, flowing=False, **values), effects)
    z = (solver.scene.initial_positions()[:, 2] + height).round(7)
    solver.particles.velocity.assign(np.column_stack([start(z), 0.0 * z, 0.0 * z]))
    *_, last = solver.frames()
    rows = np.unique(z)
    return rows, np.array([last.velocity[z == row, 0].mean() for row in rows])


@pytest.mark.parametrize("effects", [STEADY, DYNAMIC], ids=["steady", "dynamic"])
def test_speed_profile(effects):
    """26 degrees, 6 grains: the layer keeps to the profile of the one-dimensional equation, far from the local one."""
    angle, height, material = math.radians(26.0), 6 * GRAIN, stopping.beads("saturating")
    z, theory = speed_in_theory(material, effects, angle, height)
    inertial = 0.278 * (math.tan(angle) - 0.3819) / (0.6435 - math.tan(angle))
    bagnold = 2.0 * inertial / (3.0 * GRAIN) * math.sqrt(0.6 * 9.81 * math.cos(angle)) * height**1.5
    assert theory[-1] < 0.75 * bagnold
    rows, found = flow(material, effects, angle, height, lambda h: np.interp(h, z, theory), 0.3, 0.5 * GRAIN)
    np.testing.assert_allclose(found, np.interp(rows, z, theory), atol=0.03 * theory[-1])


@pytest.mark.parametrize(("grains", "flows"), [(2.4, False), (2.7, False), (3.1, True)])
def test_layers_stop_below_the_stopping_height(grains, flows):
    """24.23 degrees, linear law: 2.89 grains."""
    angle = math.radians(24.23)
    assert stopping.stopping_height("linear", 24.23) == pytest.approx(2.889, abs=2e-3)
    _, found = flow(
        stopping.beads("linear"), DYNAMIC, angle, grains * GRAIN, lambda h: 10.0 * h, 0.15, GRAIN / 3
    )
    assert (found[-1] > 1e-3) == flows
    assert found[-1] < 1e-4 or flows
