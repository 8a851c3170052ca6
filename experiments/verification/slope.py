"""A layer at rest is tilted: it starts where tan(tilt) exceeds mu_s, and then slides as a block on its base would."""

from __future__ import annotations

import math

import numpy as np
from bagnold import endless

from mpm_warp import Effects, Material, Scene, Solver

SOIL = Material()


def acceleration(tilt: float, particles_per_cell: float, duration: float = 0.3) -> float:
    """Acceleration down the slope [m/s^2] of the upper half over the second half of `duration`, friction mu_s."""
    bed = endless(0.1, 0.01, particles_per_cell=particles_per_cell, headroom=0.03)
    scene = Scene(bed=bed, material=SOIL, tilt=tilt, duration=duration, frame_rate=50.0)
    upper = scene.initial_positions()[:, 2] > -0.5 * bed.size[2]
    frames = Solver(scene, Effects(rate_dependence=False)).frames()
    speed = np.array([f.velocity[upper, 0].mean() for f in frames])
    late = len(speed) // 2
    return float(np.polyfit(scene.times()[late:], speed[late:], 1)[0])


def expected(tilt: float) -> float:
    """g cos(tilt) (tan(tilt) - mu_s) above the friction angle, 0 below [m/s^2]."""
    angle = math.radians(tilt)
    return 9.81 * math.cos(angle) * max(0.0, math.tan(angle) - SOIL.static_friction)


def measure() -> list[dict]:
    return [
        {
            "tilt": tilt,
            "particles_per_cell": ppc,
            "acceleration": acceleration(tilt, ppc),
            "theory": expected(tilt),
        }
        for ppc in (1, 8)
        for tilt in (25.0, 30.0, 34.0, 35.0, 36.0, 36.5, 37.0, 37.5, 38.0, 39.0, 41.0, 44.0)
    ]
