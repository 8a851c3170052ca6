"""What goes through a thin plate, and its draft, against the plate's thickness and where contact begins.

    python experiments/stability/leakage.py

Writes leakage.csv beside this script; under a minute on one core.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from mpm_warp import Excavation, Frame, Plate, SceneError, Solver
from mpm_warp.bodies import Tool
from mpm_warp.poses import rotate

HERE = Path(__file__).resolve().parent
sys.path[1:1] = [str(HERE.parent), str(HERE.parents[1] / "support")]

from common import write_rows  # noqa: E402

from sgns_testing.scenes import cut  # noqa: E402

THICKNESSES = (2.2, 2.0, 1.5, 1.2, 1.0, 0.5)  # [grid spacings]
MARGINS = (-0.75, -0.5, -0.25)  # [grid spacings]
PATH = ((0.0, 0.104, 0.105), (0.2, 0.104, 0.06), (0.7, 0.204, 0.06))  # time [s], x and z [m]
CUTTING = 0.4  # the draft is the mean from here on [s]


def leaked(frames: Sequence[Frame], body: Tool, edge: float = 0.0) -> np.ndarray:
    """How often each particle crossed a thin body, shape (n,), int.

    Counted are crossings of the plane x = 0 of the body frame, half-way through a plate's thickness, where the crossing
    lies within the body's outline in y and z: +1 towards the body's front (+x), -1 towards its back. A particle that
    comes back counts nothing, and one that flows around an edge or over the top does not count either. Between frames a
    particle is taken to move in a straight line relative to the body.

    Args:
        frames: of one run, in order.
        body: whose outline counts; its shape is taken as the box around it, but a plate's end as it is cut.
        edge: width of a strip along the outline's edges that does not count [m]. Contact may begin inside the body,
            and then soil flows around an edge that lies that far inside.
    """
    _, half_y, top = body.half_size - edge
    # Below the middle of a ground face the plane lies behind the plate.
    end = 0.5 * (body.section[0, 1] + body.section[3, 1]) if isinstance(body, Plate) else -body.half_size[2]
    crossings = np.zeros(len(frames[0].position), dtype=int)
    for before, now in pairwise(map(_seen_from_body, frames)):
        crossed = np.flatnonzero(before[:, 0] * now[:, 0] < 0.0)
        a, b = before[crossed], now[crossed]
        at = a + (a[:, 0] / (a[:, 0] - b[:, 0]))[:, None] * (b - a)
        inside = (np.abs(at[:, 1]) < half_y) & (at[:, 2] > end + edge) & (at[:, 2] < top)
        crossings[crossed[inside]] += np.sign(b[inside, 0]).astype(int)
    return crossings


def leakage(frames: Sequence[Frame], body: Tool, edge: float = 0.0) -> float:
    """Share of the soil that met a thin body and went through it [-].

    Soil that met it: particles that crossed it, or were in some frame within the box around it widened by its thickness
    to either side. `edge` as in `leaked`.
    """
    through = leaked(frames, body, edge) != 0
    near = body.half_size * [3.0, 1.0, 1.0]
    met = through | np.any([np.all(np.abs(_seen_from_body(f)) < near, axis=1) for f in frames], axis=0)
    return float(through.sum() / max(1, met.sum()))


def _seen_from_body(frame: Frame) -> np.ndarray:
    back = frame.body_pose[3:] * [-1.0, -1.0, -1.0, 1.0]
    return rotate(back, frame.position.astype(float) - frame.body_pose[:3])


def pushed_plate(thickness: float, margin: float, edge: str = "square") -> Excavation:
    """A plate that goes 4 cm down and then 10 cm forward."""
    return cut(
        blade=Plate(length=0.2, width=0.193, thickness=thickness * cut().bed.spacing, edge=edge),
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
