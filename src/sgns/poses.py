"""Poses of a body: rotations, points carried along, and the check of what a person gives.

A pose is the position of the centre of mass [m] and a unit quaternion x, y, z, w, body -> world.
Shapes: T frames, M body points.
"""

from __future__ import annotations

import numpy as np

from sgns.errors import UserError

__all__ = [
    "check_poses",
    "fitted_poses",
    "in_body_frame",
    "in_world_frame",
    "quaternions",
    "rotation_matrices",
    "rotation_vectors",
]


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
    """The poses (T, 7) in which body points (M, 3) [m] lie nearest to world points (T, M, 3) [m] (Kabsch 1976)."""
    middle, there = points.mean(axis=0), world.mean(axis=1)
    u, _, vt = np.linalg.svd(np.einsum("mi,tmj->tij", points - middle, world - there[:, None]))
    turn = np.ones((len(world), 3))
    turn[:, 2] = np.sign(np.linalg.det(u @ vt))
    rotation = np.swapaxes((u * turn[:, None]) @ vt, -1, -2)
    return np.concatenate([there - rotation @ middle, quaternions(rotation)], axis=1)


def check_poses(poses: np.ndarray, what: str = "tool path") -> np.ndarray:
    """Poses as float64 with exactly unit quaternions.

    Args:
        poses: Centre of mass [m] and quaternion x, y, z, w, shape (T, 7) or (7,).
        what: How to call them in an error.

    Returns:
        Shape (T, 7).

    Raises:
        UserError: Wrong shape, a value that is not finite, or a quaternion off unit length by more than 1e-3.
    """
    try:
        poses = np.atleast_2d(np.asarray(poses, dtype=np.float64)).copy()
    except (TypeError, ValueError) as error:
        raise UserError(f"the {what} is not numeric; it needs rows x, y, z, qx, qy, qz, qw") from error
    if poses.ndim != 2 or poses.shape[1] != 7 or len(poses) == 0:
        raise UserError(
            f"the {what} has shape {poses.shape}; it needs rows x, y, z, qx, qy, qz, qw, shape (T, 7)"
        )
    bad = ~np.isfinite(poses).all(axis=1)
    if bad.any():
        frame = int(bad.argmax())
        raise UserError(
            f"the {what} is not finite at frame {frame}: {poses[frame].tolist()}; every pose must be finite"
        )
    length = np.linalg.norm(poses[:, 3:], axis=1)
    bad = np.abs(length - 1) > 1e-3
    if bad.any():
        frame = int(bad.argmax())
        raise UserError(
            f"the {what} has a quaternion of length {length[frame]:.4g} at frame {frame}; "
            "x, y, z, w must have length 1 (within 0.001)"
        )
    poses[:, 3:] /= length[:, None]
    return poses
