"""What goes through a thin plate, and its draft, against the plate's thickness and where contact begins.

    python experiments/stability/leakage.py

Writes leakage.csv beside this script; under a minute on one core.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from mpm_warp import Excavation, Plate, SceneError, Solver
from mpm_warp.diagnostics import leakage

HERE = Path(__file__).resolve().parent
sys.path[1:1] = [str(HERE.parent), str(HERE.parents[1] / "support")]

from common import write_rows  # noqa: E402

from sgns_testing.scenes import cut  # noqa: E402

THICKNESSES = (2.2, 2.0, 1.5, 1.2, 1.0, 0.5)  # [grid spacings]
MARGINS = (-0.75, -0.5, -0.25)  # [grid spacings]
PATH = ((0.0, 0.104, 0.105), (0.2, 0.104, 0.06), (0.7, 0.204, 0.06))  # time [s], x and z [m]
CUTTING = 0.4  # the draft is the mean from here on [s]


def pushed_plate(thickness: float, margin: float) -> Excavation:
    """A plate that goes 4 cm down and then 10 cm forward, as in test_plates_do_not_leak."""
    return cut(
        blade=Plate(length=0.2, width=0.193, thickness=thickness * cut().bed.spacing),
        contact_margin=margin,
        motion="path",
        path=tuple((t, x, 0.2, z, 0, 0, 0, 1) for t, x, z in PATH),
        duration=0.7,
        frame_rate=100.0,
    )


def measure(thickness: float, margin: float) -> dict[str, float | str]:
    """Shares of the soil that go through the outline and further than half a spacing from its edges; draft [N]."""
    row: dict[str, float | str] = {"thickness": thickness, "contact_margin": margin}
    try:
        scene = pushed_plate(thickness, margin)
        frames = list(Solver(scene).frames())
    except SceneError as error:
        return row | {"refused": str(error)}
    row["through"] = leakage(frames, scene.body)
    row["through_inside"] = leakage(frames, scene.body, 0.5 * scene.bed.spacing)
    return row | {"draft": -float(np.mean([f.force[0] for f in frames if f.time >= CUTTING]))}


if __name__ == "__main__":
    write_rows(HERE / "leakage.csv", [measure(one, other) for one in THICKNESSES for other in MARGINS])
