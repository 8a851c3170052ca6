"""Glass beads on a rough slope: the steady profile of mu(I), kept or not."""

from __future__ import annotations

import numpy as np

from mpm_warp import Bed, Effects, Incline, Material, Solver, Walls

BEADS = Material(
    youngs_modulus=1.0e6,
    grain_density=2450.0,
    packing=0.6,
    grain_diameter=0.003,
    static_friction=0.3819,
    limit_friction=0.6435,
)
THICKNESS = 0.03  # [m]


def endless(height: float, spacing: float, **values) -> Bed:
    """A layer of soil without end in x and y."""
    size, walls = (4 * spacing, 4 * spacing, height), Walls("periodic", "periodic")
    return Bed(size=size, spacing=spacing, walls=walls, **values)


def layer(spacing: float, particles_per_cell: float, courant: float = 0.6, **changes) -> Incline:
    """A layer 3 cm thick at 26 degrees, endless in x and y, in Bagnold's profile."""
    bed = endless(THICKNESS, spacing, particles_per_cell=particles_per_cell, headroom=0.006)
    values = {"tilt": 26.0, "duration": 2.0, "frame_rate": 20.0, "courant": courant, "material": BEADS}
    return Incline(**({"bed": bed} | values | changes))


def profile(scene: Incline, effects: Effects | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Heights of the layers of particles [m], their mean speed at the end and the steady one [m/s]."""
    frame = list(Solver(scene, effects).frames())[-1]
    height = scene.initial_positions()[:, 2] + THICKNESS
    rows = np.unique(height.round(9))
    speed = [frame.velocity[np.isclose(height, row), 0].mean() for row in rows]
    return rows, np.array(speed), scene.steady_velocity(rows)


CASES = [  # grid spacing [m], particles per cell, share of the largest time step
    (0.003, 1, 0.6),
    (0.003, 1, 0.15),
    (0.003, 8, 0.6),
    (0.003, 8, 0.15),
    (0.0015, 1, 0.6),
    (0.0015, 8, 0.6),
    (0.0015, 8, 0.15),
]


def measure() -> list[dict]:
    rows = []
    for spacing, ppc, courant in CASES:
        layers = zip(*profile(layer(spacing, ppc, courant)), strict=True)
        case = {"spacing": spacing, "particles_per_cell": ppc, "courant": courant}
        rows += [case | {"height": z, "speed": speed, "theory": steady} for z, speed, steady in layers]
    return rows
