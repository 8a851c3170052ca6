"""Columns and slopes: what the scenes hold and refuse, and that soil on them does what it must."""

import math
from dataclasses import replace
from itertools import pairwise

import bagnold
import numpy as np
import pytest

from mpm_warp import Bed, Column, Incline, Other, Solver, Sphere

LAYER = bagnold.layer(0.003, 1, material=replace(bagnold.BEADS, youngs_modulus=1.0e5), duration=0.5)
"""Glass beads, 3 cm thick, on a slope of 26 degrees: ten cells high, one particle per cell."""


def column(**kw) -> Column:
    bed = Bed(size=(0.4, 0.4, 0.06), spacing=0.01, headroom=0.03)
    return Column(**({"bed": bed, "radius": 0.06, "duration": 0.5, "frame_rate": 20.0} | kw))


def test_the_steady_flow_is_bagnolds():
    """The numbers of glass beads 3 cm thick at 26 degrees."""
    assert LAYER.inertial_number == pytest.approx(0.1889, abs=1e-4)
    assert LAYER.steady_velocity(np.array([0.03]))[0] == pytest.approx(0.5017, abs=1e-4)
    heights = (np.arange(3000) + 0.5) * 1e-5
    assert LAYER.steady_velocity(heights).mean() == pytest.approx(0.3010, abs=1e-4)
    soil, rate = LAYER.material, np.gradient(LAYER.steady_velocity(heights), 1e-5)
    pressure = soil.bulk_density * 9.81 * math.cos(math.radians(26.0)) * (0.03 - heights)
    inertial = rate * soil.grain_diameter * np.sqrt(soil.grain_density / pressure)
    np.testing.assert_allclose(inertial[10:-300], LAYER.inertial_number, rtol=1e-3)


def test_the_steady_flow_stays():
    """Started in Bagnold's profile, the layer keeps it."""
    frame = list(Solver(LAYER).frames())[-1]
    exact = LAYER.steady_velocity(frame.position[:, 2] + 0.03)
    np.testing.assert_allclose(frame.velocity[:, 0], exact, atol=0.02 * exact.max())
    assert np.abs(frame.velocity[:, 1:]).max() < 0.01 * exact.max()
    travelled = frame.position[:, 0] - LAYER.initial_positions()[:, 0]
    np.testing.assert_allclose(travelled, 0.5 * exact, atol=0.02 * 0.5 * exact.max())


def test_a_stone_in_the_steady_flow_takes_the_place_of_soil():
    stone = Other(tool=Sphere(diameter=0.004), position=(0.003, 0.003, -0.01))
    scene = Incline(others=(stone,))
    assert len(scene.displaced) > 0
    steady = scene.steady_velocity(scene.initial_positions()[:, 2] + 0.03)
    np.testing.assert_array_equal(scene.initial_velocities()[:, 0], steady)


def test_a_column_spreads_and_stops_below_the_angle_of_repose():
    """It ends lower and wider, no soil is lost, and no slope is steeper than friction allows."""
    scene = column()
    frames = list(Solver(scene).frames())
    start, end = frames[0], frames[-1]
    away = [np.hypot(f.position[:, 0] - 0.2, f.position[:, 1] - 0.2) for f in (start, end)]
    assert away[1].max() > away[0].max() + 0.01
    assert end.position[:, 2].max() < start.position[:, 2].max()
    assert end.position[:, 2].min() > -0.06
    assert np.linalg.norm(end.velocity, axis=1).max() < 0.15
    rings = np.linspace(0.0, away[1].max(), 12)
    tops = [end.position[(away[1] >= a) & (away[1] < b), 2].max(initial=-0.06) for a, b in pairwise(rings)]
    slope = -np.polyfit(0.5 * (rings[1:] + rings[:-1])[3:], tops[3:], 1)[0]
    assert 0.1 < slope < scene.material.static_friction


def test_a_column_is_round_and_as_heavy_as_it_should_be():
    scene = column(bed=Bed(size=(0.4, 0.4, 0.06), spacing=0.005, headroom=0.03))
    positions, volume = scene.filled
    assert np.hypot(*(positions[:, :2] - 0.2).T).max() <= 0.06
    assert len(positions) * volume == pytest.approx(scene.soil_volume, rel=0.02)
    slab = column(shape="slab")
    assert np.ptp(slab.filled[0][:, 1]) > 0.38
    assert len(slab.filled[0]) * slab.filled[1] == pytest.approx(slab.soil_volume)
    inside = column(others=(Other(tool=Sphere(diameter=0.04), position=(0.2, 0.2, -0.03)),))
    assert len(inside.displaced) > 0
    assert len({one.arrangement_hash for one in (scene, slab, column(), inside)}) == 4


def test_the_flow_finds_its_speed():
    """Slowed down by a tenth, it comes back towards the steady profile."""
    scene = replace(LAYER, duration=1.0)
    solver = Solver(scene)
    frames = solver.frames()
    steady = next(frames).velocity[:, 0].mean()
    solver.particles.velocity.assign(0.9 * solver.particles.velocity.numpy())
    speed = [f.velocity[:, 0].mean() / steady for f in frames]
    assert speed[0] < 0.93
    assert speed[-1] > 0.95
