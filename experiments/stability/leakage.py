"""What goes through a thin plate, and its draft, against its edge, its thickness and where contact begins.

    python experiments/stability/leakage.py

Writes leakage.csv beside this script; two minutes on one core.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from functools import partial
from itertools import pairwise, product
from pathlib import Path
from typing import Literal

import numpy as np

from mpm_warp import Excavation, Frame, Plate, SceneError, Solver
from mpm_warp.bodies import Tool
from mpm_warp.poses import rotate

HERE = Path(__file__).resolve().parent
sys.path[1:1] = [str(HERE.parent), str(HERE.parents[1] / "support")]

from common import write_rows  # noqa: E402

from sgns_testing.scenes import cut  # noqa: E402

EDGES: tuple[Literal["square", "bevel"], ...] = ("square", "bevel")
THICKNESSES = (2.2, 2.0, 1.5, 1.2, 1.0, 0.5)  # [grid spacings]
MARGINS = (-0.75, -0.5, -0.375, -0.25)  # [grid spacings]
PATH = ((0.0, 0.104, 0.105), (0.2, 0.104, 0.06), (0.7, 0.204, 0.06))  # time [s], x and z [m]
CUTTING = 0.4  # the draft is the mean from here on [s]


def leaked(frames: Sequence[Frame], body: Tool, edge: float = 0.0) -> np.ndarray:
    """How often each particle crossed a thin body, shape (n,), int.

    Counted are crossings of the surface half-way between a body's front (+x) and its back, where the nearer side
    changes, within the body's outline in y and z: +1 towards the front, -1 towards the back. It is the plane x = 0; at
    the ground end of a plate, whose ground face belongs to the back, it is the middle of the wedge. So soil that slides
    along a face, pressed in as contact allows, does not count. Nor does a particle that comes back, or one that flows
    around an edge or over the top. Between frames a particle is taken to move in a straight line relative to the body.

    Args:
        frames: of one run, in order.
        body: whose outline counts; its shape is taken as the box around it, but a plate's end as it is cut.
        edge: width of a strip along the outline's edges that does not count [m]. Contact may begin inside the body,
            and then soil flows around an edge that lies that far inside.
    """
    _, half_y, top = body.half_size - edge
    crossings = np.zeros(len(frames[0].position), dtype=int)
    for before, now in pairwise(map(partial(_seen_from, body), frames)):
        crossed = np.flatnonzero(before[:, 3] * now[:, 3] < 0.0)
        a, b = before[crossed], now[crossed]
        at = a + (a[:, 3] / (a[:, 3] - b[:, 3]))[:, None] * (b - a)
        inside = (np.abs(at[:, 1]) < half_y) & (at[:, 2] > body.tip[2] + edge) & (at[:, 2] < top)
        crossings[crossed[inside]] += np.sign(b[inside, 3]).astype(int)
    return crossings


def leakage(frames: Sequence[Frame], body: Tool, edge: float = 0.0) -> float:
    """Share of the soil that met a thin body and went through it [-].

    Soil that met it: particles that crossed it, or were in some frame within the box around it widened by its thickness
    to either side. `edge` as in `leaked`.
    """
    through = leaked(frames, body, edge) != 0
    near = body.half_size * [3.0, 1.0, 1.0]
    met = through | np.any(
        [np.all(np.abs(_seen_from(body, f)[:, :3]) < near, axis=1) for f in frames], axis=0
    )
    return float(through.sum() / max(1, met.sum()))


def _seen_from(body: Tool, frame: Frame) -> np.ndarray:
    """Places in the body frame [m], and how much nearer the back is than the front [m], shape (n, 4)."""
    back = frame.body_pose[3:] * [-1.0, -1.0, -1.0, 1.0]
    seen = rotate(back, frame.position.astype(float) - frame.body_pose[:3])
    half = body.half_size[0]
    behind = -seen[:, 0] - half
    if isinstance(body, Plate) and body.edge == "bevel":
        tip, heel = body.section[0], body.section[3]
        (x, z), length = heel - tip, math.dist(heel, tip)
        behind = np.maximum(behind, ((seen[:, 0] - tip[0]) * -z + (seen[:, 2] - tip[1]) * x) / length)
    return np.column_stack([seen, seen[:, 0] - half - behind])


def pushed_plate(thickness: float, margin: float, edge: Literal["square", "bevel"] = "square") -> Excavation:
    """A plate that goes 4 cm down and then 10 cm forward."""
    return cut(
        blade=Plate(length=0.2, width=0.193, thickness=thickness * cut().bed.spacing, edge=edge),
        contact_margin=margin,
        motion="path",
        path=tuple((t, x, 0.2, z, 0, 0, 0, 1) for t, x, z in PATH),
        duration=0.7,
        frame_rate=100.0,
    )


def measure(edge: Literal["square", "bevel"], thickness: float, margin: float) -> dict[str, float | str]:
    """Shares of the soil that go through the outline and further than half a spacing from its edges; draft [N]."""
    row: dict[str, float | str] = {"edge": edge, "thickness": thickness, "contact_margin": margin}
    try:
        scene = pushed_plate(thickness, margin, edge)
        frames = list(Solver(scene).frames())
    except SceneError as error:
        return row | {"refused": str(error)}
    row["through"] = leakage(frames, scene.body)
    row["through_inside"] = leakage(frames, scene.body, 0.5 * scene.bed.spacing)
    return row | {"draft": -float(np.mean([f.force[0] for f in frames if f.time >= CUTTING]))}


if __name__ == "__main__":
    write_rows(HERE / "leakage.csv", [measure(*case) for case in product(EDGES, THICKNESSES, MARGINS)])
