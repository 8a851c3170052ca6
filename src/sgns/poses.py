"""Poses of a body: rotations, points carried along, and the check of what a person gives.

A pose is the position of the centre of mass [m] and a unit quaternion x, y, z, w, body -> world.
Shapes: T frames, M body points.
"""

from __future__ import annotations

import numpy as np

from sgns.errors import UserError
from sgns.given import real_array

__all__ = [
    "check_pose",
    "check_poses",
    "first_pose",
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


def check_pose(pose: np.ndarray, what: str = "tool pose") -> np.ndarray:
    """One pose as float64 with an exactly unit quaternion.

    Args:
        pose: Centre of mass [m] and quaternion x, y, z, w, shape (7,).
        what: How to call it in an error.

    Returns:
        Shape (7,), a copy.

    Raises:
        UserError: As `check_poses`; several poses are refused, too.
    """
    return require_poses(pose_rows(pose, what, "x, y, z, qx, qy, qz, qw, shape (7,)", 1), what, "")[0]


def first_pose(poses: np.ndarray, what: str = "first pose") -> np.ndarray:
    """As `check_pose`, of a pose (7,) or of the first of some (T, 7), the others not looked at."""
    return require_poses(pose_rows(poses, what)[:1], what, "")[0]


def check_poses(poses: np.ndarray, what: str = "tool path") -> np.ndarray:
    """Poses as float64 with exactly unit quaternions.

    Args:
        poses: Centre of mass [m] and quaternion x, y, z, w, shape (T, 7) or (7,).
        what: How to call them in an error.

    Returns:
        Shape (T, 7), a copy.

    Raises:
        UserError: No real numbers, wrong shape, a value that is not finite, or a quaternion off unit length by more
            than 1e-3.
    """
    return require_poses(pose_rows(poses, what), what)


def pose_rows(
    poses: np.ndarray,
    what: str,
    needs: str = "rows x, y, z, qx, qy, qz, qw, shape (T, 7)",
    most: int = 2,
) -> np.ndarray:
    """A float64 copy of what has the shape of poses, (T, 7) or (7,), of at most so many axes; shape (T, 7)."""
    poses = real_array(poses, what, needs)
    if not 1 <= poses.ndim <= most or poses.shape[-1] != 7 or len(poses) == 0:
        raise UserError(f"the {what} has shape {poses.shape}; it needs {needs}")
    return np.atleast_2d(poses)


def require_poses(poses: np.ndarray, what: str, where: str = " at frame {}") -> np.ndarray:
    """Poses (T, 7), whose quaternions are made exactly unit in place, or a UserError that says where they are none."""
    bad = ~np.isfinite(poses).all(axis=1)
    if bad.any():
        frame = int(bad.argmax())
        raise UserError(
            f"the {what} is not finite{where.format(frame)}: {poses[frame].tolist()}; every pose must be finite"
        )
    with np.errstate(over="ignore"):  # the length is refused below
        length = np.linalg.norm(poses[:, 3:], axis=1)
    bad = np.abs(length - 1) > 1e-3
    if bad.any():
        frame = int(bad.argmax())
        raise UserError(
            f"the {what} has a quaternion of length {length[frame]:.4g}{where.format(frame)}; "
            "x, y, z, w must have length 1 (within 0.001)"
        )
    poses[:, 3:] /= length[:, None]
    return poses
