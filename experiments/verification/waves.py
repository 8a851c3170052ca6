"""Elastic waves in a periodic bar, one period, against the exact standing start."""

from __future__ import annotations

import math

import numpy as np

from mpm_warp import Bed, Effects, Material, Scene, Solver, Walls

ELASTIC = Effects(yielding=False, rate_dependence=False, separation=False)
LENGTH = 0.16  # of the bar and the wave [m]


def error_after_a_period(kind: str, cells: int, particles_per_cell: float, courant: float = 0.4) -> float:
    """Relative L2 error of the particles' velocities in a standing wave after one period.

    Args:
        kind: `compression` (moves along the bar) or `shear` (moves across it).
        cells: grid spacings in a wavelength.
    """
    h = LENGTH / cells
    # Without Poisson's ratio a compression wave needs no lateral stress, so the free surface is no matter.
    soil = Material(poissons_ratio=0.0)
    axis = 0 if kind == "compression" else 1
    speed = soil.wave_speed if axis == 0 else math.sqrt(soil.shear_modulus / soil.bulk_density)
    period = LENGTH / speed
    bed = Bed(
        size=(LENGTH, 4 * h, 4 * h),
        spacing=h,
        particles_per_cell=particles_per_cell,
        initial_stress="none",
        headroom=2 * h,
        walls=Walls("periodic", "periodic", "slip"),
    )
    scene = Scene(
        bed=bed,
        material=soil,
        gravity=0.0,
        duration=period,
        frame_rate=1.0 / period,
        courant=courant,
        elastic_damping=0.0,
    )
    solver = Solver(scene, ELASTIC, precision="float64")
    start = np.zeros((solver.particle_count, 3))
    start[:, axis] = 1e-4 * speed * np.sin(2.0 * math.pi * scene.initial_positions()[:, 0] / LENGTH)
    solver.particles.velocity.assign(start)
    for _ in solver.frames():
        pass
    return float(np.linalg.norm(solver.particles.velocity.numpy() - start) / np.linalg.norm(start))


def measure() -> list[dict]:
    return [
        {
            "wave": kind,
            "particles_per_cell": ppc,
            "cells": cells,
            "error": error_after_a_period(kind, cells, ppc),
        }
        for kind in ("compression", "shear")
        for ppc in (1, 8)
        for cells in (8, 16, 32, 64)
    ]
