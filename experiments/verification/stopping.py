"""Layers of glass beads on a rough slope with cooperative flow: below (pi / 2) xi they stop."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from bagnold import BEADS

from mpm_warp import Bed, Effects, Incline, Material, Solver, Walls

EFFECTS = Effects(fluidity=True, nonlocality=True)
CASES = (  # rate law, cells in a grain, tilts [degrees]
    ("linear", 3, (23.0, 24.0, 26.0, 28.0, 30.0)),
    ("saturating", 3, (23.0, 24.0, 26.0)),
    ("linear", 6, (28.0,)),
)
SHARES = (0.92, 1.06, 1.12)  # of the stopping height in theory


def beads(law: str) -> Material:
    return replace(BEADS, youngs_modulus=1.0e5, nonlocal_amplitude=0.48, rate_law=law)


def stopping_height(law: str, tilt: float | np.ndarray) -> np.ndarray:
    """(pi / 2) xi, in grains."""
    soil = beads(law)
    xi = [soil.cooperativity_length(math.tan(math.radians(t))) for t in np.atleast_1d(tilt)]
    return 0.5 * math.pi * np.array(xi) / soil.grain_diameter


def final_speed(law: str, tilt: float, grains: float, cells_per_grain: float) -> float:
    """Of the surface of a layer `grains` high that was set in motion at 3 1/s [m/s]."""
    soil = beads(law)
    height = grains * soil.grain_diameter
    spacing = height / round(grains * cells_per_grain)
    bed = Bed(
        size=(4 * spacing, 4 * spacing, height),
        spacing=spacing,
        headroom=0.6 * height,
        walls=Walls("periodic", "periodic"),
    )
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
            theory = float(stopping_height(law, tilt)[0])
            grains = theory * np.array(SHARES)
            speed = np.array([final_speed(law, tilt, g, cells) for g in grains])
            # Close above the stopping height the speed grows from zero in proportion to what is above it.
            slope = (speed[2] - speed[1]) / (grains[2] - grains[1])
            rows += [
                {
                    "law": law,
                    "cells_per_grain": cells,
                    "tilt": tilt,
                    "grains": g,
                    "speed": v,
                    "stopping_height": grains[1] - speed[1] / slope,
                    "theory": theory,
                }
                for g, v in zip(grains, speed, strict=True)
            ]
    return rows


def draw(figure, rows: list[dict]) -> None:
    heights, speeds = figure.subplots(1, 2)
    tilts = np.linspace(22.5, 31.0, 200)
    for (law, cells, _), marker, colour in zip(CASES, "osD", ("C0", "C1", "C2"), strict=True):
        found = [r for r in rows if (r["law"], r["cells_per_grain"]) == (law, cells)]
        label = f"{law}, {cells} cells in a grain"
        if cells == 3:
            heights.plot(tilts, stopping_height(law, tilts), colour, lw=1, label=f"(π/2) ξ, {law}")
        heights.plot(
            [r["tilt"] for r in found],
            [r["stopping_height"] for r in found],
            marker,
            color=colour,
            ms=5,
            label=label,
        )
        for tilt in sorted({r["tilt"] for r in found}):
            layers = [r for r in found if r["tilt"] == tilt]
            share = [r["grains"] / r["theory"] for r in layers]
            speed = [1e3 * r["speed"] for r in layers]
            speeds.plot(share, speed, marker + "-", color=colour, ms=4, lw=0.5)
    heights.set_xlabel("tilt [degrees]")
    heights.set_ylabel("height at which flow stops [grains]")
    speeds.set_xticks((1.0, *SHARES))
    speeds.axvline(1.0, color="k", ls=":", lw=1)
    speeds.set_xlabel("height of the layer / (π/2) ξ")
    speeds.set_ylabel("final speed of the surface [mm/s]")
    heights.legend(fontsize=8)
    for axis in (heights, speeds):
        axis.grid(alpha=0.3)
