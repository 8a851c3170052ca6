"""Prescribed paths of a blade's tip and of a body given by samples."""

from __future__ import annotations

import numpy as np

from .errors import SceneError
from .rotation import slerp

__all__ = ["CUT_LENGTH", "MOTIONS", "RAMP_SPEED", "curved", "ramp", "sampled_poses"]

MOTIONS = ("curved", "ramp", "rest", "path")

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


def sampled_poses(samples: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Poses at `time` (T,) [s] between samples (rows t, x, y, z, qx, qy, qz, qw), shape (T, 7).

    Positions are interpolated linearly, rotations along the shortest way; the body rests before the first
    and after the last sample.
    """
    samples = np.asarray(samples, dtype=float)
    if samples.ndim != 2 or samples.shape[1] != 8 or len(samples) < 1:
        raise SceneError(
            f"the path has shape {samples.shape}; it needs rows of 8 numbers: t, x, y, z, qx, qy, qz, qw"
        )
    bad = np.argwhere(~np.isfinite(samples))
    if len(bad):
        raise SceneError(
            f"the path holds a value that is not finite in row {bad[0][0] + 1}, column {bad[0][1] + 1}"
        )
    if np.any(np.diff(samples[:, 0]) <= 0.0):
        row = int(np.argmax(np.diff(samples[:, 0]) <= 0.0)) + 2
        raise SceneError(f"the path's times must increase; row {row} does not come after the row before it")
    norm = np.linalg.norm(samples[:, 4:], axis=1)
    if np.any(np.abs(norm - 1.0) > 1e-3):
        raise SceneError(
            f"the path's quaternion in row {int(np.argmax(np.abs(norm - 1.0) > 1e-3)) + 1} is not of length 1"
        )
    t = samples[:, 0]
    time = np.clip(time, t[0], t[-1])
    position = np.stack([np.interp(time, t, samples[:, 1 + axis]) for axis in range(3)], axis=-1)
    right = np.clip(np.searchsorted(t, time, side="right"), 1, max(1, len(t) - 1))
    left = right - 1
    right = np.minimum(right, len(t) - 1)
    span = np.where(t[right] > t[left], t[right] - t[left], 1.0)
    rotation = slerp(samples[left, 4:], samples[right, 4:], (time - t[left]) / span)
    return np.concatenate([position, rotation], axis=-1)
