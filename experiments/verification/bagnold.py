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


def layer(spacing: float, particles_per_cell: float, courant: float = 0.6, **changes) -> Incline:
    """A layer 3 cm thick at 26 degrees, endless in x and y, in Bagnold's profile."""
    bed = Bed(
        size=(4 * spacing, 4 * spacing, THICKNESS),
        spacing=spacing,
        particles_per_cell=particles_per_cell,
        headroom=0.006,
        walls=Walls("periodic", "periodic"),
    )
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
        scene = layer(spacing, ppc, courant)
        for height, speed, steady in zip(*profile(scene), strict=True):
            rows.append(
                {
                    "spacing": spacing,
                    "particles_per_cell": ppc,
                    "courant": courant,
                    "height": height,
                    "speed": speed,
                    "theory": steady,
                }
            )
    return rows


def draw(figure, rows: list[dict]) -> None:
    axes = figure.subplots(1, 2, sharey=True)
    for axis, ppc in zip(axes, (1, 8), strict=True):
        for spacing, _, courant in [c for c in CASES if c[1] == ppc]:
            key = (spacing, ppc, courant)
            found = [r for r in rows if (r["spacing"], r["particles_per_cell"], r["courant"]) == key]
            axis.plot(
                [r["speed"] for r in found],
                [1e3 * r["height"] for r in found],
                "o-" if courant > 0.5 else "s--",
                ms=3,
                label=f"dx {1e3 * spacing:g} mm, courant {courant}",
            )
        height = np.linspace(0.0, THICKNESS, 200)
        axis.plot(layer(0.003, 1).steady_velocity(height), 1e3 * height, "k-", lw=1, label="theory")
        axis.set_title(f"{ppc} per cell")
        axis.set_xlabel("speed after 2 s [m/s]")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    axes[0].set_ylabel("height [mm]")
