"""The fluidity at a single point, against exact answers and a reference integrator."""

import math
from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scipy.integrate import solve_ivp

from mpm_warp import Effects, Material
from mpm_warp.kernels.fluidity import SEED_INERTIAL_NUMBER, fluidity, soil_parameters, soil_struct
from sgns_testing.points import sheared, updated

SAND = Material()
LINEAR = replace(SAND, rate_law="linear")
DYNAMIC = Effects(fluidity=True)
BOTH_LAWS = pytest.mark.parametrize("material", [SAND, LINEAR], ids=["saturating", "linear"])
BOTH_PRECISIONS = pytest.mark.parametrize("real", [wp.float32, wp.float64])


class Laws:
    """Runs the Warp functions of fluidity.py on arrays of mu_trial, p and g (or the excess)."""

    def __init__(self, real=wp.float64):
        law, Soil = fluidity(real), soil_struct(real)
        coefficients, local, step = law.coefficients, law.local_fluidity, law.fluidity_step
        excess_law = law.friction_with_excess
        vec2 = wp.types.vector(2, real)

        @wp.kernel(module="unique", enable_backward=False)
        def run(
            mu: wp.array(dtype=real),
            p: wp.array(dtype=real),
            g: wp.array(dtype=real),
            dt: real,
            soil: Soil,
            dynamic: wp.array(dtype=vec2),
            steady: wp.array(dtype=vec2),
        ):
            n = wp.tid()
            ac = coefficients(p[n], dt, soil)
            dynamic[n] = step(mu[n], ac[0], ac[1], g[n], dt, soil)
            found = excess_law(mu[n], ac[0], ac[1], g[n], soil)
            steady[n] = vec2(found, local(found, ac[1], soil))

        self._run, self._real, self._vec2 = run, real, vec2

    def __call__(self, material, mu, p, g, dt):
        mu, p, g = np.broadcast_arrays(mu, p, g)
        real = self._real
        dynamic, steady = (wp.zeros(mu.size, dtype=self._vec2, device="cpu") for _ in range(2))
        inputs = [wp.array(v.ravel(), dtype=real, device="cpu") for v in (mu, p, g)]
        soil = soil_parameters(real, material, 1.0)
        wp.launch(self._run, mu.size, [*inputs, dt, soil, dynamic, steady], device="cpu")
        return dynamic.numpy().astype(float), steady.numpy().astype(float)


def coefficients(material, p, dt):
    """a and c of fluidity.py."""
    c = np.sqrt(p / material.grain_density) * material.reference_inertial_number / material.grain_diameter
    return material.shear_modulus * dt / p, c


def steepening(material, mu):
    if material.rate_law == "linear":
        return np.ones_like(mu)
    return (material.limit_friction - material.static_friction) / (material.limit_friction - mu)


def local_fluidity(material, mu, p):
    """g_loc of the rate law: I(mu) sqrt(p / rho_s) / (d mu)."""
    over = np.maximum(mu - material.static_friction, 0.0)
    span = material.limit_friction - material.static_friction
    c = coefficients(material, p, 1.0)[1]
    return c * over / (span * mu) * steepening(material, mu)


def shear(material, rate, pressure, time, dt, g=0.0, every=1):
    """mu and g of simple shear at constant volume from rest, at every n-th step."""
    strain, found = np.zeros((1, 3, 3)), []
    for _ in range(round(time / dt) // every):
        ln_j, a = -pressure / material.bulk_modulus, sheared(rate * dt)
        strain, _, g = updated(material, strain, ln_j, a, dt, every, g, DYNAMIC)
        found.append((2.0 * material.shear_modulus * strain[0, 0, 2] / pressure, g[0]))
    return np.array(found).T


@BOTH_LAWS
@pytest.mark.parametrize("rate", [0.1, 7.5, 300.0])
def test_steady_shear_reaches_mu_of_i(material, rate):
    """After the transient the dynamics rest at the rate law, at any rate."""
    mu, g = shear(material, rate, 1000.0, 0.05 + 0.15 / rate, 2e-5, every=25)
    inertial = rate * material.grain_diameter * math.sqrt(material.grain_density / 1000.0)
    span, i0 = material.limit_friction - material.static_friction, material.reference_inertial_number
    share = inertial / i0 if material.rate_law == "linear" else 1.0 / (1.0 + i0 / inertial)
    assert mu[-1] == pytest.approx(material.static_friction + span * share, rel=1e-4)
    assert g[-1] * mu[-1] == pytest.approx(rate, rel=2e-3)


@pytest.mark.parametrize(("material", "rate"), [(SAND, 0.5), (LINEAR, 7.5)], ids=["saturating", "linear"])
def test_start_of_shear_against_a_reference_integrator(material, rate):
    """Stress and fluidity of a sudden shear, elastic stress and g integrated together by a stiff solver."""
    p, g0, t_end = 1000.0, 0.1, 0.02
    modulus, t0 = material.shear_modulus, material.fluidity_time
    span = material.limit_friction - material.static_friction
    c = coefficients(material, p, 1.0)[1]

    def slope(_, state):
        mu, y = state
        g = math.exp(y)
        growth = steepening(material, np.float64(mu)) * (mu - material.static_friction)
        return modulus / p * (rate - mu * g), (growth - span / c * mu * g) / t0

    exact = solve_ivp(slope, (0.0, t_end), (0.0, math.log(g0)), "LSODA", rtol=1e-9, atol=1e-12, max_step=1e-5)
    errors = []
    for dt in (1e-5, 5e-6, 2.5e-6):
        mu, _ = shear(material, rate, p, t_end, dt, g0, every=10)
        at = np.interp(10 * dt * np.arange(1, len(mu) + 1), exact.t, exact.y[0])
        errors.append(np.abs(mu - at).mean())
    assert errors[2] < 0.01
    assert errors[1] < 0.6 * errors[0]
    assert errors[2] < 0.6 * errors[1]


@BOTH_PRECISIONS
@BOTH_LAWS
def test_step_solves_its_equation(material, real):
    """ln g_new - ln g = dt B(mu_new) / t0 and mu_new (1 + a g_new) = mu_trial, over many decades of everything."""
    rng = np.random.default_rng(0)
    n = 3000
    p = 10.0 ** rng.uniform(-3, 6, n)
    mu_trial = 10.0 ** rng.uniform(-2, 2, n)
    g = 10.0 ** rng.uniform(-6, 4, n)
    for dt in (1e-6, 1e-4, 1e-2):
        found, _ = Laws(real)(material, mu_trial, p, g, dt)
        mu, g_new = found.T
        assert np.all(np.isfinite(found)) and np.all(g_new > 0.0) and np.all(mu <= mu_trial * (1 + 1e-6))
        if material.rate_law == "saturating":
            assert np.all(mu <= material.limit_friction * (1 + 1e-6))
        if real is wp.float32:
            continue
        a, c = coefficients(material, p, dt)
        seeded = np.where(mu_trial > material.static_friction, SEED_INERTIAL_NUMBER * c / 0.278, 0.0)
        span = material.limit_friction - material.static_friction
        growth = steepening(material, mu) * (mu - material.static_friction) - span / c * mu * g_new
        residual = np.log(g_new / np.maximum(g, seeded)) - dt / material.fluidity_time * growth
        # Where mu is all but mu_2, or g at its floor, the equation cannot be evaluated.
        meant = g_new > 1e-29
        if material.rate_law == "saturating":
            meant &= mu < material.limit_friction * (1 - 1e-3)
        scale = 1.0 + np.abs(dt / material.fluidity_time * growth) + dt / material.fluidity_time * mu
        assert np.abs(residual / scale)[meant].max() < 1e-6
        assert meant.mean() > 0.2
        np.testing.assert_allclose(mu * (1.0 + a * g_new), mu_trial, rtol=1e-9)


@BOTH_PRECISIONS
@BOTH_LAWS
def test_limits_are_finite(material, real):
    """No pressure, mu at mu_s and at mu_2, no flow at all, and grains of no size."""
    mu_s, mu_2 = material.static_friction, material.limit_friction
    mu = np.array([0.0, mu_s, mu_s * (1 + 1e-7), mu_2, mu_2 * (1 - 1e-7), 1e6])[:, None]
    p = np.array([1e-30, 1e-12, 1.0, 1e7])
    for grain in (3e-4, 1e-12):
        for g in (0.0, 1e3):
            for found in Laws(real)(replace(material, grain_diameter=grain), mu, p, g, 1e-4):
                assert np.all(np.isfinite(found)) and np.all(found >= 0.0)


@BOTH_LAWS
def test_friction_with_excess_solves_its_equation(material):
    """mu (1 + a g) = mu_trial with g = max(g_loc(mu) + q, 0)."""
    rng = np.random.default_rng(2)
    n = 2000
    p, mu_trial = 10.0 ** rng.uniform(-2, 6, n), 10.0 ** rng.uniform(-2, 1.5, n)
    q = rng.choice([-1.0, 0.0, 1.0], n) * 10.0 ** rng.uniform(-6, 4, n)
    dt = 1e-4
    _, steady = Laws()(material, mu_trial, p, q, dt)
    mu, g_loc = steady.T
    a, _ = coefficients(material, p, dt)
    flows = g_loc + q > 0.0
    assert 0.2 < flows.mean() < 0.95
    left = mu * (1.0 + a * np.maximum(local_fluidity(material, mu, p) + q, 0.0))
    close = mu < material.limit_friction * (1 - 1e-3) if material.rate_law == "saturating" else mu > 0
    np.testing.assert_allclose(left[close], mu_trial[close], rtol=1e-5)
    assert np.all(mu <= mu_trial)


def test_soil_at_rest_is_not_seeded():
    """Below mu_s the seed does not act: the stress of soil at rest does not creep away."""
    found, _ = Laws()(SAND, 0.7, 1000.0, 0.0, 1e-4)
    assert found[0, 0] == pytest.approx(0.7, rel=1e-12)
    assert found[0, 1] < 1e-20


def test_soil_that_comes_together_flows_as_it_did_apart():
    mu, g = shear(SAND, 5.0, -0.01 * SAND.bulk_modulus, 1e-4, 1e-4)
    assert mu[0] == 0.0
    assert g[0] * SAND.static_friction == pytest.approx(5.0)
