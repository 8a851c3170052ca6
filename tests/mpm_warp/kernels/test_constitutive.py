"""The stress update at a single point, against exact answers (float64) and in float32."""

import math
from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

from mpm_warp import Effects, Material
from sgns_testing.points import shear_stress, sheared, updated

SAND = Material(youngs_modulus=15e6)
ELASTIC = Effects(yielding=False, rate_dependence=False, separation=False)
NOTHING = np.zeros((1, 3, 3))


def random_strains(rng, n, size):
    s = rng.normal(size=(n, 3, 3))
    s = s + np.swapaxes(s, 1, 2)
    s -= np.trace(s, axis1=1, axis2=2)[:, None, None] * np.eye(3) / 3
    return size * s / np.linalg.norm(s, axis=(1, 2), keepdims=True)


def exact_trial(strain, a):
    f = np.eye(3) + a
    b = f @ expm(2 * strain) @ f.T
    log = 0.5 * np.real(logm(b))
    return log - np.trace(log) * np.eye(3) / 3


@pytest.mark.parametrize(
    ("size", "step", "tolerance"),
    [
        (1e-4, 1e-5, 1e-8),  # second order: off by size^2 of the step
        (8e-3, 1e-3, 1e-4),
        (1.5e-2, 2e-3, 1e-5),  # series
        (0.3, 0.1, 1e-12),  # eigenvalues
    ],
)
def test_trial_strain_is_the_matrix_logarithm(size, step, tolerance):
    """In each of the three ranges the change of strain is right within the stated share of the step."""
    rng = np.random.default_rng(0)
    strain, a = random_strains(rng, 20, size), rng.normal(size=(20, 3, 3))
    a *= step / np.linalg.norm(a, axis=(1, 2), keepdims=True)
    found, volume, _ = updated(SAND, strain, 0.0, a, 1e-4, effects=ELASTIC)
    exact = np.array([exact_trial(s, x) for s, x in zip(strain, a, strict=True)])
    assert np.abs(found - exact).max() < tolerance * step
    np.testing.assert_allclose(volume, np.log(np.linalg.det(np.eye(3) + a)), rtol=1e-6, atol=1e-12)


def test_float32_keeps_slow_straining():
    """Ten thousand steps of 1e-7 on a strain of 1e-4: what a stored deformation gradient would lose."""
    steps, rate = 10_000, 1e-7
    strain = np.array([np.diag([1e-4, -1e-4, 0.0])])
    single, double = (
        updated(SAND, strain, -1e-3, sheared(rate), 1e-4, steps, effects=ELASTIC, real=real)[0]
        for real in (wp.float32, wp.float64)
    )
    assert np.abs(single - double).max() < 1e-3 * np.abs(double).max()


@pytest.mark.parametrize("law", ["saturating", "linear"])
@pytest.mark.parametrize("rate", [0.1, 10.0, 1000.0])
def test_simple_shear_reaches_mu_of_i(rate, law):
    """Steady simple shear at constant volume: tau / p = mu(I) exactly, at any rate."""
    pressure, dt, material = 1000.0, 1e-5, replace(SAND, rate_law=law)
    ln_j = -pressure / SAND.bulk_modulus
    # Enough strain to pass the elastic range (p / G is about 2e-4), whatever the rate.
    steps = int(2e-2 / (rate * dt)) + 2000
    strain, after, _ = updated(material, NOTHING, ln_j, sheared(rate * dt), dt, steps)
    assert after[0] == pytest.approx(ln_j, rel=1e-9)
    number = (
        rate * SAND.grain_diameter * math.sqrt(SAND.grain_density / pressure) / SAND.reference_inertial_number
    )
    share = number if law == "linear" else number / (1.0 + number)
    mu = SAND.static_friction + (SAND.limit_friction - SAND.static_friction) * share
    # The plastic rate equals the shear rate up to the elastic strain's small rotation.
    assert shear_stress(SAND, strain)[0] / pressure == pytest.approx(mu, rel=2e-4)


def test_without_rate_dependence_friction_is_static():
    effects = Effects(rate_dependence=False)
    strain, *_ = updated(SAND, NOTHING, -1e-4, sheared(1e-3), 1e-5, 2000, effects=effects)
    assert shear_stress(SAND, strain)[0] == pytest.approx(
        SAND.static_friction * SAND.bulk_modulus * 1e-4, rel=1e-9
    )


def test_update_converges_in_the_step():
    """Start of shear at a fixed strain: the error falls in proportion to the step."""
    rate, total = 50.0, 4e-4 / 50.0
    found = [
        updated(SAND, NOTHING, -5e-5, sheared(rate * total / n), total / n, n)[0] for n in (10, 20, 40, 5120)
    ]
    errors = [np.abs(f - found[-1]).max() for f in found[:-1]]
    assert errors[0] > 1e-12
    assert errors[1] < 0.7 * errors[0]
    assert errors[2] < 0.7 * errors[1]


def test_frame_indifference():
    """Turning strain and motion turns the answer."""
    rng = np.random.default_rng(1)
    q = Rotation.random(rng=rng).as_matrix()
    strain, a = random_strains(rng, 10, 1e-4), 1e-4 * rng.normal(size=(10, 3, 3))
    plain, j, _ = updated(SAND, strain, -1e-4, a, 1e-4)
    turned, j_turned, _ = updated(SAND, q @ strain @ q.T, -1e-4, q @ a @ q.T, 1e-4)
    np.testing.assert_allclose(turned, q @ plain @ q.T, atol=1e-16)
    np.testing.assert_allclose(j, j_turned, rtol=1e-12)


def test_separated_soil_has_no_stress_and_forgets_its_strain():
    strain = np.array([np.diag([1e-4, -1e-4, 0.0])])
    a = np.array([1e-3 * np.eye(3)])
    found, ln_j, _ = updated(SAND, strain, -1e-3, a, 1e-4)
    assert ln_j[0] > 0
    assert not found.any()


# --- cohesion ---------------------------------------------------------------------------------------------------

ANGLE = 35.0
DAMP = replace(SAND, friction_angle=ANGLE, friction_map="triaxial", cohesion=1000.0)
STATIC = Effects(rate_dependence=False)


def along_an_axis(stress):
    """A step that gives soil at rest this stress along z and none across [Pa], tension positive; shape (1, 3, 3)."""
    nu = SAND.poissons_ratio
    return stress / SAND.youngs_modulus * np.array([np.diag([-nu, -nu, 1.0])])


def axial(strain, ln_j):
    """Stress along z [Pa]."""
    return 2.0 * SAND.shear_modulus * strain[0, 2, 2] + SAND.bulk_modulus * ln_j[0]


def pulled(*stresses, effects=STATIC):
    """What is left of these stresses along z, put on one after the other [Pa]."""
    steps = np.array([along_an_axis(stress) for stress in stresses])
    return axial(*updated(DAMP, NOTHING, 0.0, steps, 1e-5, effects=effects)[:2])


def test_unconfined_strength_is_that_of_mohr_and_coulomb():
    """2 c cos(phi) / (1 - sin(phi)), with the map that agrees in triaxial compression."""
    phi = math.radians(ANGLE)
    strength = 2.0 * DAMP.cohesion * math.cos(phi) / (1.0 - math.sin(phi))
    assert pulled(-0.99 * strength) == pytest.approx(-0.99 * strength, rel=1e-3)
    strain, ln_j, _ = updated(DAMP, NOTHING, 0.0, along_an_axis(-1.5 * strength), 1e-5, effects=STATIC)
    effective = DAMP.cohesive_pressure - DAMP.bulk_modulus * ln_j[0]
    assert shear_stress(DAMP, strain)[0] == pytest.approx(DAMP.static_friction * effective, rel=1e-9)
    assert abs(axial(strain, ln_j)) < 1.4 * strength


def test_soil_tears_where_it_yields_in_tension():
    """tau = mu (p_c + p) with p = -T / 3 and tau = T / sqrt(3)."""
    mu = DAMP.static_friction
    limit = math.sqrt(3.0) * mu * DAMP.cohesive_pressure / (1.0 + mu / math.sqrt(3.0))
    assert pulled(0.99 * limit) == pytest.approx(0.99 * limit, rel=1e-3)
    strain, ln_j, _ = updated(DAMP, NOTHING, 0.0, along_an_axis(1.01 * limit), 1e-5, effects=STATIC)
    assert ln_j[0] > 0.0 and not strain.any()


def test_torn_soil_bears_no_tension_until_it_is_compressed():
    mu = DAMP.static_friction
    limit = math.sqrt(3.0) * mu * DAMP.cohesive_pressure / (1.0 + mu / math.sqrt(3.0))
    torn, part, more = (along_an_axis(share * limit) for share in (1.1, -0.5, -0.7))
    strain, ln_j, _ = updated(DAMP, NOTHING, 0.0, np.array([torn, part]), 1e-5, effects=STATIC)
    assert 0.0 < ln_j[0] < DAMP.cohesive_pressure / DAMP.bulk_modulus and not strain.any()
    strain, ln_j, _ = updated(DAMP, NOTHING, 0.0, np.array([torn, part, more]), 1e-5, effects=STATIC)
    assert ln_j[0] < 0.0 and strain.any()
    again = np.array([torn, part, more, along_an_axis(0.4 * limit)])
    strain, ln_j, _ = updated(DAMP, NOTHING, 0.0, again, 1e-5, effects=STATIC)
    assert ln_j[0] > 0.0 and strain.any()


@pytest.mark.parametrize(
    "effects", [STATIC, Effects(), Effects(fluidity=True), Effects(nonlocality=True)], ids=str
)
@pytest.mark.parametrize("law", ["saturating", "linear"])
def test_cohesion_shears_like_so_much_more_pressure(effects, law):
    """At constant volume the shear stress is that of dry soil under p + p_c, in every law of flow."""
    damp, pressure, excess = replace(DAMP, rate_law=law), 1000.0, 0.5 if effects.nonlocality else 0.0
    dry = replace(damp, cohesion=0.0)
    found, known = (
        updated(soil, NOTHING, -p / soil.bulk_modulus, sheared(1e-5), 1e-5, 300, excess, effects)[0]
        for soil, p in ((damp, pressure), (dry, pressure + damp.cohesive_pressure))
    )
    assert shear_stress(dry, known)[0] > dry.static_friction * pressure
    np.testing.assert_allclose(found, known, rtol=1e-9)
