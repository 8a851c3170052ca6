"""A sphere dropped into a deep bed: how deep its crater is, over the height that it falls in all.

Uehara et al., Phys. Rev. Lett. 90 (2003) 194301: d = 0.14 / mu (rho_s / rho_g)^(1/2) D^(2/3) H^(1/3), with the density
rho_s of the sphere and rho_g of the bed, and H from where it is let go to where it stops.
"""

from __future__ import annotations

import numpy as np

from mpm_warp import Bed, Material, Other, Scene, Solver, Sphere

DIAMETER, DENSITY = 0.04, 2650.0
DROPS = (0.04, 0.16, 0.64)  # above the bed [m]
FASTER = 1e-3  # what is slower than this has stopped [m/s]
SPACINGS = (0.0125, 0.01)


def depth(drop: float, spacing: float) -> float:
    """Of the sphere's lowest point when it stops [m]; it begins at the surface with the speed of its fall."""
    bed = Bed(
        size=(0.2, 0.2, 0.1), spacing=spacing, particles_per_cell=4.0, headroom=0.12, arrangement="jittered"
    )
    stone = Other(
        tool=Sphere(diameter=DIAMETER),
        position=(0.1, 0.1, 0.5 * DIAMETER),
        velocity=(0.0, 0.0, -np.sqrt(2.0 * Scene.gravity * drop)),
        density=DENSITY,
    )
    scene = Scene(bed=bed, others=(stone,), duration=0.5, frame_rate=100.0)
    low = []
    for frame in Solver(scene).frames():
        low.append(frame.other_poses[0, 2] - 0.5 * DIAMETER)
        if len(low) > 5 and low[-1] - low[-2] > -FASTER / scene.frame_rate:
            break
    return -low[-1]


def measure() -> list[dict]:
    soil = Material()
    rows = []
    for spacing in SPACINGS:
        deep = np.array([depth(drop, spacing) for drop in DROPS])
        fall = deep + DROPS
        share = 0.14 / soil.static_friction * np.sqrt(DENSITY / soil.bulk_density)
        theory = share * DIAMETER ** (2 / 3) * fall ** (1 / 3)
        exponent, _ = np.polyfit(np.log(fall), np.log(deep), 1)
        rows += [
            {"spacing": spacing, "drop": a, "fall": b, "depth": c, "theory": d, "exponent": exponent}
            for a, b, c, d in zip(DROPS, fall, deep, theory, strict=True)
        ]
    return rows
