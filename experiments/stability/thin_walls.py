"""What goes through thin walls of a mesh, with contact at the mesh and where the solver puts it.

    python experiments/stability/thin_walls.py

A sheet goes 4 cm down and then 10 cm forward through a bed on a grid of 20 mm. Writes thin_walls.csv beside this
script; five minutes on one core.
"""

from __future__ import annotations

import sys
from pathlib import Path
from unittest.mock import patch

import numpy as np
from leakage import CUTTING, PATH, leakage

HERE = Path(__file__).resolve().parent
sys.path[1:1] = [str(HERE.parent), str(HERE.parents[1] / "support")]

from common import write_rows  # noqa: E402

from mpm_warp import Bed, Body, Box, MeshBody, Solver  # noqa: E402
from sgns_testing.meshes import box_corners, box_triangles  # noqa: E402

THICKNESSES = (0.5, 1.0, 2.0, 4.0)  # [mm]
DENSITIES = (4.0, 8.0, 27.0)  # [particles per cell]
SPEEDS = (0.2, 1.0)  # [m/s]


def pushed_sheet(thickness: float, density: float, speed: float) -> Body:
    """A sheet of `thickness` [m] as a mesh, in `density` particles per cell, at `speed` [m/s]."""
    size = np.array([thickness, 0.193, 0.2])
    slower = 0.2 / speed
    return Body(
        bed=Bed(size=(0.48, 0.4, 0.16), spacing=0.02, headroom=0.3, particles_per_cell=density),
        tool=MeshBody.of_mesh(box_corners(size, -0.5 * size), box_triangles()),
        path=tuple((t * slower, x, 0.2, z, 0, 0, 0, 1) for t, x, z in PATH),
        duration=0.7 * slower,
        frame_rate=100.0 / slower,
    )


def measure(thickness: float, density: float, speed: float, thickened: bool) -> dict[str, float]:
    """Share of the soil that goes through the sheet more than half a spacing from its edges, and the draft [N]."""
    scene = pushed_sheet(thickness, density, speed)
    if thickened:
        frames = list(Solver(scene).frames())
    else:
        with patch("mpm_warp.rigid_body.thickening", return_value=None):
            frames = list(Solver(scene).frames())
    looked_at = Box(size=(0.01, 0.193, 0.2))  # soil within 1 cm of the sheet has met it
    late = [f.force[0] for f in frames if f.time >= CUTTING * 0.2 / speed]
    return {
        "thickness_mm": 1e3 * thickness,
        "particles_per_cell": density,
        "speed": speed,
        "thickened": int(thickened),
        "through": leakage(frames, looked_at),
        "through_inside": leakage(frames, looked_at, 0.5 * scene.bed.spacing),
        "draft": -float(np.mean(late)),
    }


if __name__ == "__main__":
    cases = [
        (1e-3 * t, n, v, on) for t in THICKNESSES for n in DENSITIES for v in SPEEDS for on in (False, True)
    ]
    write_rows(HERE / "thin_walls.csv", [measure(*case) for case in cases])
