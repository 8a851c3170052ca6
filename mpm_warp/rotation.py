"""Unit quaternions (x, y, z, w), body to world, in numpy."""

from __future__ import annotations

import numpy as np

__all__ = ["about_y", "angular_velocity", "multiply", "rotate", "slerp"]


def about_y(angle: float) -> np.ndarray:
    """Rotation by `angle` [rad] about +y, shape (4,)."""
    return np.array([0.0, np.sin(0.5 * angle), 0.0, np.cos(0.5 * angle)])


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Product a b (first b, then a), shape (..., 4)."""
    av, aw, bv, bw = a[..., :3], a[..., 3:], b[..., :3], b[..., 3:]
    vector = aw * bv + bw * av + np.cross(av, bv)
    return np.concatenate([vector, aw * bw - np.sum(av * bv, axis=-1, keepdims=True)], axis=-1)


def rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Vectors v (..., 3) turned by q (..., 4)."""
    t = 2.0 * np.cross(q[..., :3], v)
    return v + q[..., 3:] * t + np.cross(q[..., :3], t)


def angular_velocity(before: np.ndarray, after: np.ndarray, dt: float) -> np.ndarray:
    """World-frame angular velocity [rad/s] that turns `before` into `after` in dt, shape (..., 3)."""
    conjugate = before * np.array([-1.0, -1.0, -1.0, 1.0])
    step = multiply(after, conjugate)
    step = np.where(step[..., 3:] < 0.0, -step, step)
    sine = np.linalg.norm(step[..., :3], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, step[..., 3:])
    # angle / sine tends to 2 for small angles.
    return step[..., :3] * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-300), 2.0) / dt


def slerp(a: np.ndarray, b: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Shortest-way interpolation between quaternions a and b (..., 4) at t (...) in [0, 1]."""
    dot = np.sum(a * b, axis=-1, keepdims=True)
    b = np.where(dot < 0.0, -b, b)
    angle = np.arccos(np.clip(np.abs(dot), 0.0, 1.0))
    sine = np.sin(angle)
    t = np.asarray(t)[..., None]
    small = sine < 1e-8
    safe = np.where(small, 1.0, sine)
    wa = np.where(small, 1.0 - t, np.sin((1.0 - t) * angle) / safe)
    wb = np.where(small, t, np.sin(t * angle) / safe)
    q = wa * a + wb * b
    return q / np.linalg.norm(q, axis=-1, keepdims=True)
