"""The whole solver with cooperative flow: uniform layers of glass beads on an incline.

A narrow column stands for the layer: after every grid step the velocities are averaged along the incline and across
it, and the particles are put back there.
"""

import math

import numpy as np
import pytest
import warp as wp
from scipy.integrate import solve_bvp

from mpm_warp import Bed, Effects, Material, Scene, Solver
from mpm_warp.grid import grid_step
from mpm_warp.nonlocal_fluidity import NonlocalFluidity, wall_sink

GRAIN = 3e-3
STEADY, DYNAMIC = Effects(nonlocality=True), Effects(fluidity=True, nonlocality=True)


def beads(law):
    return Material(
        youngs_modulus=1e5,
        grain_density=2450.0,
        packing=0.6,
        grain_diameter=GRAIN,
        static_friction=0.3819,
        limit_friction=0.6435,
        rate_law=law,
    )


def speed_in_theory(material, effects, angle, height):
    """Heights and velocity of the steady layer: the one-dimensional equation of g with mu = tan(angle)."""
    z = np.linspace(0.0, height, 300)
    mu, span = math.tan(angle), material.limit_friction - material.static_friction
    steep = span / (material.limit_friction - mu) if material.rate_law == "saturating" else 1.0
    growth = steep * (mu - material.static_friction)
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
    bed = Bed(size=(4 * spacing, 4 * spacing, height), spacing=spacing, headroom=0.6 * height)
    solver = Solver(Scene(bed=bed, material=material, gravity=9.81 * math.cos(angle), duration=1.0), effects)
    grid, dt = solver._grid, solver.time_step
    shape, base = (grid.nx, grid.ny, grid.nz), grid.low[2]
    grid.low, grid.high = wp.vec3i(-1, -1, base), wp.vec3i(2**30, 2**30, 2**30)
    record = {"device": "cpu", "record_cmd": True}
    arrays = [grid, solver._nodes, solver._velocity, solver._substep]
    step = wp.launch(grid_step(solver._real), len(solver._nodes), arrays, **record)
    floor = wall_sink(shape, (-1, -1, base), (2**30,) * 3)
    particles = [solver._x, solver._e, solver._ln_j]
    term = NonlocalFluidity(
        solver._real, effects, solver.device, floor, particles, grid, solver._soil, solver._velocity
    )
    x, v = solver._x.numpy(), solver._v.numpy()  # these share memory with the solver
    nodes, velocity = (a.numpy().reshape(*shape, 4) for a in (solver._nodes, solver._velocity))
    at, z = x[:, :2].copy(), x[:, 2] + height
    z = z.round(7)
    v[:, 0] = start(z)
    for _ in range(round(duration / dt)):
        solver._launches[0].launch()
        total = nodes.sum(axis=(0, 1))
        mean = total[:, :3] / np.maximum(total[:, 3:], 1e-30)
        nodes[..., :3] = np.where(total[:, 3:] > 0.0, mean, 0.0) * nodes[..., 3:]
        step.launch()
        velocity[:, :, base + 1 :, 0] += 9.81 * math.sin(angle) * dt
        for launch in (*term.launches, solver._launches[-1]):
            launch.launch()
        x[:, :2] = at
    assert solver._stray.numpy()[0] == 0
    rows = np.unique(z)
    return rows, np.array([v[z == row, 0].mean() for row in rows])


@pytest.mark.parametrize("effects", [STEADY, DYNAMIC], ids=["steady", "dynamic"])
def test_speed_profile(effects):
    """26 degrees, 6 grains: the layer keeps to the profile of the one-dimensional equation, far from the local one."""
    angle, height, material = math.radians(26.0), 6 * GRAIN, beads("saturating")
    z, theory = speed_in_theory(material, effects, angle, height)
    inertial = 0.278 * (math.tan(angle) - 0.3819) / (0.6435 - math.tan(angle))
    bagnold = 2.0 * inertial / (3.0 * GRAIN) * math.sqrt(0.6 * 9.81 * math.cos(angle)) * height**1.5
    assert theory[-1] < 0.75 * bagnold
    rows, found = flow(material, effects, angle, height, lambda h: np.interp(h, z, theory), 0.3, 0.5 * GRAIN)
    np.testing.assert_allclose(found, np.interp(rows, z, theory), atol=0.03 * theory[-1])


@pytest.mark.parametrize(("grains", "flows"), [(2.4, False), (2.7, False), (3.1, True)])
def test_layers_stop_below_the_stopping_height(grains, flows):
    """24.23 degrees, linear law: 2.89 grains."""
    angle, material = math.radians(24.23), beads("linear")
    critical = 0.5 * math.pi * material.cooperativity_length(math.tan(angle)) / GRAIN
    assert critical == pytest.approx(2.889, abs=2e-3)
    _, found = flow(material, DYNAMIC, angle, grains * GRAIN, lambda h: 10.0 * h, 0.15, GRAIN / 3)
    assert (found[-1] > 1e-3) == flows
    assert found[-1] < 1e-4 or flows
