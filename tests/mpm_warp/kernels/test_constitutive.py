"""The stress update at a single point, against exact answers (float64) and in float32."""

import math
from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

from mpm_warp import Effects, Material
from mpm_warp.kernels.constitutive import constitutive
from mpm_warp.kernels.fluidity import soil_parameters, soil_struct

SAND = Material(youngs_modulus=15e6)
ALL = Effects()
ELASTIC = Effects(yielding=False, rate_dependence=False, separation=False)
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


class Point:
    """Runs the Warp functions on many single points."""

    def __init__(self, real=wp.float64, effects=ALL, material=SAND):
        law, Soil = constitutive(real, effects), soil_struct(real)
        vec6, mat33 = law.vec6, law.mat33
        update, trial, volume = law.update, law.strain_trial, law.volume_step

        @wp.kernel(module="unique", enable_backward=False)
        def steps(
            e: wp.array(dtype=vec6),
            j: wp.array(dtype=real),
            a: wp.array(dtype=mat33),
            dt: real,
            n: int,
            soil: Soil,
        ):
            p = wp.tid()
            for _ in range(n):
                state = update(e[p], j[p], a[p], dt, soil, real(0.0))
                e[p] = vec6(state[0], state[1], state[2], state[3], state[4], state[5])
                j[p] = state[6]

        @wp.kernel(module="unique", enable_backward=False)
        def trials(e: wp.array(dtype=vec6), j: wp.array(dtype=real), a: wp.array(dtype=mat33)):
            p = wp.tid()
            e[p] = trial(e[p], a[p])
            j[p] = volume(a[p])

        self._steps, self._trials, self.types = steps, trials, (vec6, real, mat33)
        self.soil = soil_parameters(real, material, 1.0)

    def _arrays(self, strain, ln_j, a):
        six = np.array([[s[i, k] for i, k in PAIRS] for s in strain])
        vec6, real, mat33 = self.types
        return (
            wp.array(six, dtype=vec6, device="cpu"),
            wp.array(ln_j, dtype=real, device="cpu"),
            wp.array(a, dtype=mat33, device="cpu"),
        )

    @staticmethod
    def _full(six):
        full = np.empty((len(six), 3, 3))
        for n, (i, k) in enumerate(PAIRS):
            full[:, i, k] = full[:, k, i] = six[:, n]
        return full

    def update(self, strain, ln_j, a, dt, n=1):
        e, j, a = self._arrays(strain, ln_j, a)
        wp.launch(self._steps, len(ln_j), [e, j, a, dt, n, self.soil], device="cpu")
        return self._full(e.numpy()), j.numpy()

    def trial(self, strain, a):
        e, j, a = self._arrays(strain, np.zeros(len(a)), a)
        wp.launch(self._trials, len(a), [e, j, a], device="cpu")
        return self._full(e.numpy()), j.numpy()


NOTHING = np.zeros((1, 3, 3))


def sheared(step):
    """dt times the velocity gradient of simple shear."""
    a = NOTHING.copy()
    a[0, 0, 2] = step
    return a


def shear_stress(strain):
    return math.sqrt(2.0) * SAND.shear_modulus * np.linalg.norm(strain, axis=(1, 2))


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
    found, volume = Point().trial(strain, a)
    exact = np.array([exact_trial(s, x) for s, x in zip(strain, a, strict=True)])
    assert np.abs(found - exact).max() < tolerance * step
    np.testing.assert_allclose(volume, np.log(np.linalg.det(np.eye(3) + a)), rtol=1e-6, atol=1e-12)


def test_float32_keeps_slow_straining():
    """Ten thousand steps of 1e-7 on a strain of 1e-4: what a stored deformation gradient would lose."""
    steps, rate = 10_000, 1e-7
    strain = np.array([np.diag([1e-4, -1e-4, 0.0])])
    single, double = (
        Point(real, ELASTIC).update(strain, np.array([-1e-3]), sheared(rate), 1e-4, steps)[0]
        for real in (wp.float32, wp.float64)
    )
    assert np.abs(single - double).max() < 1e-3 * np.abs(double).max()


@pytest.mark.parametrize("law", ["saturating", "linear"])
@pytest.mark.parametrize("rate", [0.1, 10.0, 1000.0])
def test_simple_shear_reaches_mu_of_i(rate, law):
    """Steady simple shear at constant volume: tau / p = mu(I) exactly, at any rate."""
    pressure, dt, material = 1000.0, 1e-5, replace(SAND, rate_law=law)
    ln_j = np.array([-pressure / SAND.bulk_modulus])
    # Enough strain to pass the elastic range (p / G is about 2e-4), whatever the rate.
    steps = int(2e-2 / (rate * dt)) + 2000
    strain, after = Point(material=material).update(NOTHING, ln_j, sheared(rate * dt), dt, steps)
    assert after == pytest.approx(ln_j, rel=1e-9)
    number = (
        rate * SAND.grain_diameter * math.sqrt(SAND.grain_density / pressure) / SAND.reference_inertial_number
    )
    share = number if law == "linear" else number / (1.0 + number)
    mu = SAND.static_friction + (SAND.limit_friction - SAND.static_friction) * share
    # The plastic rate equals the shear rate up to the elastic strain's small rotation.
    assert shear_stress(strain)[0] / pressure == pytest.approx(mu, rel=2e-4)


def test_without_rate_dependence_friction_is_static():
    point = Point(effects=Effects(rate_dependence=False))
    strain, _ = point.update(NOTHING, np.array([-1e-4]), sheared(1e-3), 1e-5, 2000)
    assert shear_stress(strain)[0] == pytest.approx(SAND.static_friction * SAND.bulk_modulus * 1e-4, rel=1e-9)


def test_update_converges_in_the_step():
    """Start of shear at a fixed strain: the error falls in proportion to the step."""
    ln_j, rate, total = np.array([-5e-5]), 50.0, 4e-4 / 50.0
    found = []
    for n in (10, 20, 40, 5120):
        found.append(Point().update(NOTHING, ln_j, sheared(rate * total / n), total / n, n)[0])
    errors = [np.abs(f - found[-1]).max() for f in found[:-1]]
    assert errors[0] > 1e-12
    assert errors[1] < 0.7 * errors[0]
    assert errors[2] < 0.7 * errors[1]


def test_frame_indifference():
    """Turning strain and motion turns the answer."""
    rng = np.random.default_rng(1)
    q = Rotation.random(rng=rng).as_matrix()
    strain, a = random_strains(rng, 10, 1e-4), 1e-4 * rng.normal(size=(10, 3, 3))
    ln_j = np.full(10, -1e-4)
    plain, j = Point().update(strain, ln_j, a, 1e-4)
    turned, j_turned = Point().update(q @ strain @ q.T, ln_j, q @ a @ q.T, 1e-4)
    np.testing.assert_allclose(turned, q @ plain @ q.T, atol=1e-16)
    np.testing.assert_allclose(j, j_turned, rtol=1e-12)


def test_separated_soil_has_no_stress_and_forgets_its_strain():
    strain = np.array([np.diag([1e-4, -1e-4, 0.0])])
    a = np.array([1e-3 * np.eye(3)])
    found, ln_j = Point().update(strain, np.array([-1e-3]), a, 1e-4, 1)
    assert ln_j[0] > 0
    assert not found.any()


@pytest.mark.parametrize("real", [wp.float32, wp.float64])
def test_return_stays_between_the_two_frictions(real):
    """mu_s p < tau < mu_2 p after yielding, at any pressure down to nothing."""
    rng = np.random.default_rng(2)
    ln_j = -(10.0 ** rng.uniform(-12, -2, 200))
    strain, after = Point(real).update(random_strains(rng, 200, 0.02), ln_j, np.zeros((200, 3, 3)), 1e-4)
    ratio = shear_stress(strain) / (-SAND.bulk_modulus * after)
    assert np.all(ratio > SAND.static_friction * (1 - 1e-5))
    assert np.all(ratio < SAND.limit_friction * (1 + 1e-5))
