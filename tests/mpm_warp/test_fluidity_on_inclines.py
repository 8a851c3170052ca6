"""The whole solver with cooperative flow: uniform layers of glass beads on an endless incline."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_bvp

from mpm_warp import Bed, Effects, Incline, Material, Solver, Walls

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
    bed = Bed(
        size=(4 * spacing, 4 * spacing, height),
        spacing=spacing,
        headroom=0.6 * height,
        walls=Walls("periodic", "periodic"),
    )
    values = {
        "duration": duration,
        "frame_rate": 1.0 / duration,
        "tilt": math.degrees(angle),
        "flowing": False,
    }
    solver = Solver(Incline(bed=bed, material=material, **values), effects)
    z = (solver.scene.initial_positions()[:, 2] + height).round(7)
    solver.particles.velocity.assign(np.column_stack([start(z), 0.0 * z, 0.0 * z]))
    *_, last = solver.frames()
    rows = np.unique(z)
    return rows, np.array([last.velocity[z == row, 0].mean() for row in rows])


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
