"""How tools move: the published cuts; how a wheel's load, place and forces are read."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from .settings import short
from .state import SceneError

CUT_LENGTH = 0.4
"""Horizontal travel of the published cuts [m]."""
RAMP_SPEED = 0.025
"""Speed of both components while the published ramp motion goes down and comes up [m/s]."""
_CURVE_END = 0.95  # the published curved motion stops at this share of its period


def cut_time(speed: float) -> float:
    """Time of a cut of 0.4 m [s]; the published scripts round 0.4 / 0.15 to 2.6 s."""
    return 2.6 if abs(speed - 0.15) < 1e-9 else CUT_LENGTH / speed


def curved(time: np.ndarray, depth: float, speed: float) -> np.ndarray:
    """Displacement (dx, dz) of the tip on the published curved motion, shape (T, 2) [m].

    z falls along half an ellipse of depth `depth` [m] while x advances at `speed` [m/s]; both stop at 95 %
    of the period. The slope at the start is infinite.
    """
    period = cut_time(speed)
    t = np.clip(time, 0.0, _CURVE_END * period)
    return np.stack([speed * t, -(2.0 * depth / period) * np.sqrt(t * (period - t))], axis=-1)


def ramp(time: np.ndarray, depth: float, speed: float) -> np.ndarray:
    """Displacement (dx, dz) of the tip on the published ramp-horizontal-ramp motion, shape (T, 2) [m].

    Down at 45 degrees (2.5 cm/s each way) to `depth` [m], along x at `speed` [m/s], up at 45 degrees to the
    starting height, then rest.
    """
    down = depth / RAMP_SPEED
    across = cut_time(speed)
    first = np.clip(time, 0.0, down)
    second = np.clip(time - down, 0.0, across)
    third = np.clip(time - down - across, 0.0, down)
    return np.stack([RAMP_SPEED * (first + third) + speed * second, RAMP_SPEED * (third - first)], axis=-1)


# --- Wheels ---------------------------------------------------------------------------------------------


def sinkage(scene: Mapping[str, Any], poses: np.ndarray) -> np.ndarray:
    """Depth of a wheel's lowest point below the undisturbed surface [m], shape (T,) for its poses (T, 7).

    Its `scene` is plain data, such as a run file's; published ones say nothing of grousers.
    """
    return 0.5 * scene["diameter"] + scene.get("grouser_height", 0.0) - poses[:, 2]


def along_and_across(scene: Mapping[str, Any], vectors: np.ndarray) -> np.ndarray:
    """Parts of a wheel's forces or torques, world frame, shape (..., 3): along its heading, along its axle, and up.

    Its `scene` is plain data, as for `sinkage`.
    """
    angle = math.radians(scene.get("slip_angle", 0.0))
    c, s = math.cos(angle), math.sin(angle)
    return vectors @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def as_loads(rows: Any) -> tuple[tuple[float, float], ...]:
    """The rows of a load over time, checked."""
    for number, row in enumerate(rows, 1):
        numbers = isinstance(row, (list, tuple, np.ndarray)) and len(row) == 2
        if not numbers or not all(
            isinstance(v, (int, float, np.number)) and not isinstance(v, bool) and math.isfinite(v)
            for v in row
        ):
            raise SceneError(
                f"row {number} of scene.load is {short(row)}; it needs a time [s] and a load [N]"
            )
        if not row[1] > 0:
            raise SceneError(f"row {number} of scene.load is {short(row)}; a wheel needs more than 0 N")
        if number > 1 and not row[0] > rows[number - 2][0]:
            raise SceneError(
                f"row {number} of scene.load does not come after the row before it; times increase"
            )
    if len(rows) == 0:
        raise SceneError(
            "scene.load is empty; it must be a number above 0 N, or rows of a time [s] and a load [N]"
        )
    return tuple((float(time), float(load)) for time, load in rows)
