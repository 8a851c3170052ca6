"""Poses: position of the centre of mass [m] and unit quaternion (x, y, z, w), body to world."""

from __future__ import annotations

import numpy as np

from .state import SceneError

# --- Unit quaternions (x, y, z, w), body to world, in numpy ---------------------------------------------


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


# --- Prescribed paths of a blade's tip and of a body given by samples -----------------------------------


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


# --- Poses of a body: rotations, points carried along, and the check of what a person gives -------------
# A pose is the position of the centre of mass [m] and a unit quaternion x, y, z, w, body -> world.
# Shapes: T frames, M body points.


def rotation_matrices(quaternions: np.ndarray) -> np.ndarray:
    """Rotation matrices of unit quaternions x, y, z, w of shape (..., 4); shape (..., 3, 3)."""
    x, y, z, w = np.moveaxis(quaternions, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def rotation_vectors(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """World-frame rotation vectors [rad], shape (..., 3), that turn quaternions `before` (..., 4) into `after`."""
    a, aw, b, bw = after[..., :3], after[..., 3:], -before[..., :3], before[..., 3:]
    vector = aw * b + bw * a + np.cross(a, b)
    scalar = aw * bw - np.sum(a * b, axis=-1, keepdims=True)
    # q and -q are one rotation: take the short way.
    vector = np.where(scalar < 0, -vector, vector)
    sine = np.linalg.norm(vector, axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, np.abs(scalar))
    return vector * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-300), 2.0)


def in_world_frame(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Body points (M, 3) [m] carried along poses (T, 7); shape (T, M, 3) [m]."""
    return np.einsum("tij,mj->tmi", rotation_matrices(poses[:, 3:]), points) + poses[:, None, :3]


def in_body_frame(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """World points (M, 3) [m] seen from a pose (7,); shape (M, 3) [m]."""
    return (points - pose[:3]) @ rotation_matrices(pose[3:])


def quaternions(matrices: np.ndarray) -> np.ndarray:
    """Unit quaternions x, y, z, w of rotation matrices (..., 3, 3), with w >= 0; shape (..., 4)."""
    m = np.asarray(matrices)
    trace = np.trace(m, axis1=-2, axis2=-1)
    # Four times the products of two components each; the row of the largest component is the accurate one.
    table = np.empty((*m.shape[:-2], 4, 4))
    table[..., :3, :3] = m + np.swapaxes(m, -1, -2)
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        table[..., i, i] = 1.0 + 2.0 * m[..., i, i] - trace
        table[..., i, 3] = table[..., 3, i] = m[..., k, j] - m[..., j, k]
    table[..., 3, 3] = 1.0 + trace
    best = np.argmax(np.diagonal(table, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(table, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., 3:] < 0, -q, q)


def fitted_poses(points: np.ndarray, world: np.ndarray) -> np.ndarray:
    """The poses (T, 7) in which body points (M, 3) [m] lie nearest to world points (T, M, 3) [m] (Kabsch 1976); a place
    that is not finite where these are not."""
    with np.errstate(over="ignore", invalid="ignore"):
        middle, there = points.mean(axis=0), world.mean(axis=1)
        product = np.einsum("mi,tmj->tij", points - middle, world - there[:, None])
    # The decomposition fails where one of many is not finite.
    sound = np.isfinite(product).all(axis=(1, 2), keepdims=True)
    u, _, vt = np.linalg.svd(np.where(sound, product, 0.0))
    turn = np.ones((len(world), 3))
    turn[:, 2] = np.sign(np.linalg.det(u @ vt))
    rotation = np.swapaxes((u * turn[:, None]) @ vt, -1, -2)
    return np.concatenate([there - rotation @ middle, quaternions(rotation)], axis=1)
