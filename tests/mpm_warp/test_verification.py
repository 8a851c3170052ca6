"""The benchmarks of experiments/verification, small: waves, slopes, silo, passive wall; and the scaling symmetry."""

import math
from dataclasses import replace

import cohesion
import mckyes
import numpy as np
import passive
import pytest
import silo
import slope
import waves

from mpm_warp import Bed, Material, Plate, Solver
from sgns_testing.scenes import cut


@pytest.mark.parametrize("kind", ["compression", "shear"])
@pytest.mark.parametrize("particles_per_cell", [1, 8])
def test_elastic_waves_converge_with_second_order(kind, particles_per_cell):
    coarse, fine = (waves.error_after_a_period(kind, cells, particles_per_cell) for cells in (16, 32))
    assert fine < 0.03
    assert math.log2(coarse / fine) > 1.8


@pytest.mark.parametrize(("tilt", "tolerance"), [(30.0, 1e-3), (37.0, 1e-3), (38.0, 0.029), (41.0, 0.028)])
def test_a_layer_slides_as_a_block_above_its_friction_angle(tilt, tolerance):
    """tan 37.23 degrees is mu_s = 0.76. Friction is right to half a per cent."""
    assert slope.acceleration(tilt, 1, duration=0.2) == pytest.approx(slope.expected(tilt), abs=tolerance)


@pytest.mark.parametrize("filled", [1.0, 3.0])
def test_a_silos_walls_carry_its_weight(filled):
    """Janssen's pressure on the bottom; without friction it would be the weight, 1.7 times as much at 3 widths."""
    scene = silo.silo(filled * silo.WIDTH, 0.4, particles_per_cell=1.0)
    assert silo.bottom_pressure(scene) == pytest.approx(silo.janssen(scene), rel=0.1)


def test_a_smooth_wall_meets_the_passive_force():
    """Rankine with sin(phi) = mu_s: mean coefficient once the wall has moved by an eighth of the depth."""
    found = passive.coefficient(passive.retaining_wall(0.3))
    assert found[20:].mean() == pytest.approx(passive.expected(0.3), rel=0.05)


@pytest.mark.parametrize(("rake", "force"), [(0.0, 78.6), (3.8, 67.1), (30.8, 34.7), (45.0, 31.1)])
def test_the_wedge_is_that_of_the_earth_moving_equation(rake, force):
    """Five centimetres deep, 0.457 m wide, against values worked out apart from this code [N]."""
    along, down = mckyes.wedge(37.2, rake, 0.05, swept=0.0)
    assert 0.457 * math.hypot(along, down) == pytest.approx(force, rel=2e-3)


def test_a_buried_blade_meets_the_wedge():
    """Level end, ten degrees from vertical, six cells deep; in plane strain mu_s = sin(phi)."""
    draft, down = mckyes.force_per_width(mckyes.buried_blade("sin", rake=10.0, spacing=0.08 / 6))
    expected = mckyes.wedge(mckyes.ANGLE, 10.0, 0.08)
    assert draft == pytest.approx(expected[0], rel=0.1)
    assert down == pytest.approx(expected[1], abs=0.1 * expected[0])


def scaled_cut(length: float, gravity: float):
    """A cut with all lengths x `length` and gravity x `gravity`, and everything else so that nothing else changes."""
    rate, speed = math.sqrt(gravity / length), math.sqrt(gravity * length)
    assert speed == pytest.approx(rate * length)
    soil = Material()
    rows = [(0.0, 0.13, 0.2, 0.105, 0, 0, 0, 1), (0.1, 0.16, 0.2, 0.0607, 0, 0, 0, 1)]
    path = tuple((t / rate, length * x, length * y, length * z, *q) for t, x, y, z, *q in rows)
    return cut(
        bed=Bed(
            size=tuple(length * s for s in (0.48, 0.4, 0.16)), spacing=length * 0.02, headroom=length * 0.12
        ),
        blade=Plate(length=length * 0.2, width=length * 0.193, thickness=length * 0.044, edge="square"),
        material=replace(
            soil,
            youngs_modulus=soil.youngs_modulus * gravity * length,
            grain_diameter=soil.grain_diameter * length,
        ),
        gravity=9.81 * gravity,
        motion="path",
        path=path,
        duration=0.1 / rate,
        frame_rate=100.0 * rate,
    )


def test_exact_scaling():
    """Lengths x r, gravity x q, times x sqrt(r / q), E x q r, d x r: forces x q r^3, torques x q r^4."""
    r, q = 2.5, 0.3
    one, other = scaled_cut(1.0, 1.0), scaled_cut(r, q)
    frames = [list(Solver(s, precision="float64").frames()) for s in (one, other)]
    force = [np.array([f.force for f in run]) for run in frames]
    torque = [np.array([f.torque for f in run]) for run in frames]
    assert np.abs(force[0]).max() > 10.0
    np.testing.assert_allclose(force[1], q * r**3 * force[0], atol=1e-8 * np.abs(force[1]).max())
    np.testing.assert_allclose(torque[1], q * r**4 * torque[0], atol=1e-8 * np.abs(torque[1]).max())
    np.testing.assert_allclose(frames[1][-1].position, r * frames[0][-1].position, atol=1e-6 * r)


@pytest.mark.parametrize("scale", [0.1, 10.0, pytest.param(100.0, marks=pytest.mark.long)])
def test_similar_cuts_have_similar_forces_in_single_precision(scale):
    """Lengths x k, times x sqrt(k), E x k, every other setting left alone: forces x k^3. What is left is rounding, some
    1e-6 of the largest force here."""
    one, other = (
        np.array([f.force for f in Solver(scaled_cut(k, 1.0)).frames()]) / k**3 for k in (1.0, scale)
    )
    assert -one[:, 0].mean() > 10.0
    np.testing.assert_allclose(other, one, atol=1e-4 * np.abs(one).max())


def test_times_of_the_numerics_follow_grains_and_gravity():
    scene = cut()
    assert (scene.remap_limit, scene.memory_time) == (4.0e-3, 0.1)
    finer = replace(scene, material=Material(grain_diameter=0.25 * Material.grain_diameter), gravity=4 * 9.81)
    assert (finer.remap_limit, finer.memory_time) == pytest.approx((1.0e-3, 0.025))
    dust = replace(scene, material=Material(grain_diameter=1e-9))  # not in every step
    least = 0.04 * math.sqrt(scene.bed.spacing / 9.81)
    assert (dust.remap_limit, dust.memory_time) == pytest.approx((least, 12.5 * least))
    in_seconds = replace(finer, remap_time=0.0, velocity_memory=0.3)
    assert (in_seconds.remap_limit, in_seconds.memory_time) == (0.0, 0.3)
    assert replace(scene, gravity=0.0).remap_limit == 4.0e-3  # as on Earth


def test_a_column_bears_its_unconfined_strength():
    """2 c cos(phi) / (1 - sin(phi)), with the map that agrees in compression."""
    scene = cohesion.pressed_column(1000.0)
    assert cohesion.strength(scene) == pytest.approx(cohesion.unconfined(1000.0), rel=0.04)


@pytest.mark.parametrize(("height", "stands"), [(0.48, True), (1.1, False)])
def test_a_bank_stands_below_its_lower_bound_and_falls_above_the_upper(height, stands):
    """Heights in 4 c / gamma tan(45 + phi / 2), the upper bound; half of it is the lower."""
    moved = cohesion.settlement(cohesion.bank(height, cells=12))
    assert moved < 0.005 if stands else moved > 0.3


def test_cohesion_raises_the_draft_as_the_equation_says():
    found, known = cohesion.cohesive_draft(0.0, 1000.0, 0.02)
    assert found == pytest.approx(known, rel=0.15)


def test_the_wedge_of_weightless_cohesive_soil():
    """The least of c d cos(phi) / (sin(b) sin(a + b)), a the rake from horizontal and both angles of friction."""
    phi, rake, depth, c = 30.0, 10.0, 0.1, 1e8
    angle = math.radians(90.0 - rake + phi) + mckyes.WALL_ANGLE
    least = 2.0 * c * depth * math.cos(math.radians(phi)) / (1.0 + math.cos(angle))
    assert math.hypot(*mckyes.wedge(phi, rake, depth, cohesion=c)) == pytest.approx(least, rel=1e-3)
