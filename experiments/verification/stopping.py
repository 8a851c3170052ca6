"""Layers of glass beads on a rough slope with cooperative flow: below (pi / 2) xi they stop."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from bagnold import BEADS, endless

from mpm_warp import Effects, Incline, Material, Solver

EFFECTS = Effects(fluidity=True, nonlocality=True)
CASES = (  # rate law, cells in a grain, tilts [degrees]
    ("linear", 3, (23.0, 24.0, 26.0, 28.0, 30.0)),
    ("saturating", 3, (23.0, 24.0, 26.0)),
    ("linear", 6, (28.0,)),
)
SHARES = (0.92, 1.06, 1.12)  # of the stopping height in theory


def beads(law: str) -> Material:
    return replace(BEADS, youngs_modulus=1.0e5, nonlocal_amplitude=0.48, rate_law=law)


def stopping_height(law: str, tilt: float) -> float:
    """(pi / 2) xi, in grains."""
    soil = beads(law)
    return 0.5 * math.pi * soil.cooperativity_length(math.tan(math.radians(tilt))) / soil.grain_diameter


def final_speed(law: str, tilt: float, grains: float, cells_per_grain: float) -> float:
    """Of the surface of a layer `grains` high that was set in motion at 3 1/s [m/s]."""
    soil = beads(law)
    height = grains * soil.grain_diameter
    spacing = height / round(grains * cells_per_grain)
    bed = endless(height, spacing, headroom=0.6 * height)
    # Eight times the time in which a layer 6 % too high grows out of nothing.
    slowing = soil.nonlocal_amplitude * soil.grain_diameter
    slowing /= soil.cooperativity_length(math.tan(math.radians(tilt)))
    duration = 8.0 * soil.fluidity_time / (slowing**2 * (1.0 - 1.06**-2))
    duration = 0.01 * math.ceil(100.0 * max(duration, 0.25))  # inertia takes its time, too
    scene = Incline(bed=bed, material=soil, tilt=tilt, flowing=False, duration=duration, frame_rate=100.0)
    solver = Solver(scene, EFFECTS)
    depth = -scene.initial_positions()[:, 2]
    solver.particles.velocity.assign(np.column_stack([3.0 * (height - depth), 0.0 * depth, 0.0 * depth]))
    *_, last = solver.frames()
    return float(last.velocity[depth < spacing, 0].mean())


def measure() -> list[dict]:
    rows = []
    for law, cells, tilts in CASES:
        for tilt in tilts:
            theory = stopping_height(law, tilt)
            grains = theory * np.array(SHARES)
            speed = np.array([final_speed(law, tilt, g, cells) for g in grains])
            # Close above the stopping height the speed grows from zero in proportion to what is above it.
            slope = (speed[2] - speed[1]) / (grains[2] - grains[1])
            case = {"law": law, "cells_per_grain": cells, "tilt": tilt}
            found = {"stopping_height": grains[1] - speed[1] / slope, "theory": theory}
            rows += [case | {"grains": g, "speed": v} | found for g, v in zip(grains, speed, strict=True)]
    return rows
