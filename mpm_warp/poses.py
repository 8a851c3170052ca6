"""Poses: position of the centre of mass [m] and unit quaternion (x, y, z, w), body to world.

Shapes: T frames, M body points. SciPy refuses quaternions that are not finite or zero, which frames of damaged runs
and of simulations that blow up hold: what such frames go through is written out here.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from .state import SceneError


def about_y(angle: float) -> np.ndarray:
    """Rotation by `angle` [rad] about +y, shape (4,)."""
    return np.array([0.0, np.sin(0.5 * angle), 0.0, np.cos(0.5 * angle)])


def about_z_y(first: float, second: float) -> np.ndarray:
    """Rotation by `second` [rad] about +y, then by `first` [rad] about +z, shape (4,)."""
    (sz, sy), (cz, cy) = np.sin([0.5 * first, 0.5 * second]), np.cos([0.5 * first, 0.5 * second])
    return np.array([0.0 - sz * sy, cz * sy, sz * cy, cz * cy])


def rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Vectors v (..., 3) turned by q (..., 4)."""
    t = 2.0 * np.cross(q[..., :3], v)
    return v + q[..., 3:] * t + np.cross(q[..., :3], t)


def rotation_matrices(quaternions: np.ndarray) -> np.ndarray:
    """Rotation matrices of unit quaternions of shape (..., 4); shape (..., 3, 3)."""
    x, y, z, w = np.moveaxis(quaternions, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.ascontiguousarray(np.moveaxis(np.array(rows), (0, 1), (-2, -1)))  # quicker than stacks


def rotation_vectors(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """World-frame rotation vectors [rad], shape (T, 3), that turn quaternions `before` (T, 4) into `after` the short
    way."""
    return (Rotation.from_quat(after) * Rotation.from_quat(before).inv()).as_rotvec()


def in_world_frame(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Body points (M, 3) [m] carried along poses (T, 7); shape (T, M, 3) [m]."""
    return np.einsum("tij,mj->tmi", rotation_matrices(poses[:, 3:]), points) + poses[:, None, :3]


def in_body_frame(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """World points (M, 3) [m] seen from a pose (7,); shape (M, 3) [m]."""
    return (points - pose[:3]) @ rotation_matrices(pose[3:])


def fitted_rotations(points: np.ndarray, world: np.ndarray) -> np.ndarray:
    """The rotations that turn points (..., M, 3) into those nearest to world points (T, M, 3), both about their means,
    in the sense of least squares (Kabsch 1976); none where these are not finite. Shape (T, 3, 3)."""
    with np.errstate(over="ignore", invalid="ignore"):
        around = points - points.mean(axis=-2, keepdims=True)
        product = np.swapaxes(around, -1, -2) @ (world - world.mean(axis=-2, keepdims=True))
    # The decomposition fails where one of many is not finite.
    sound = np.isfinite(product).all(axis=(-2, -1), keepdims=True)
    u, _, vt = np.linalg.svd(np.where(sound, product, 0.0))
    # A reflection is no motion: turn the direction of least extent round.
    u[..., 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return np.swapaxes(u @ vt, -1, -2)


def fitted_poses(points: np.ndarray, world: np.ndarray) -> np.ndarray:
    """The poses (T, 7) in which body points (M, 3) [m] lie nearest to world points (T, M, 3) [m], with w >= 0; a place
    that is not finite where these are not."""
    rotation = fitted_rotations(points, world)
    with np.errstate(over="ignore", invalid="ignore"):
        place = world.mean(axis=1) - rotation @ points.mean(axis=0)
    return np.concatenate([place, Rotation.from_matrix(rotation).as_quat(canonical=True)], axis=1)


def sampled_poses(samples: np.ndarray, time: np.ndarray, name: str = "the path") -> np.ndarray:
    """Poses at `time` (T,) [s] between samples (rows t, x, y, z, qx, qy, qz, qw), shape (T, 7).

    Positions are interpolated linearly, rotations along the shortest way; the body rests before the first
    and after the last sample.

    Raises:
        SceneError: the samples are no such rows.
    """
    samples = np.asarray(samples, dtype=float)
    if samples.ndim != 2 or samples.shape[1] != 8 or len(samples) < 1:
        raise SceneError(
            f"{name} has shape {samples.shape}; it needs rows of 8 numbers: t, x, y, z, qx, qy, qz, qw"
        )
    bad = np.argwhere(~np.isfinite(samples))
    if len(bad):
        raise SceneError(
            f"{name} holds a value that is not finite in row {bad[0][0] + 1}, column {bad[0][1] + 1}"
        )
    t, quaternion = samples[:, 0], samples[:, 4:]
    late = np.diff(t) <= 0.0
    if late.any():
        row = int(np.argmax(late)) + 2
        raise SceneError(f"{name}'s times must increase; row {row} does not come after the row before it")
    odd = np.abs(np.linalg.norm(quaternion, axis=1) - 1.0) > 1e-3
    if odd.any():
        raise SceneError(f"{name}'s quaternion in row {int(np.argmax(odd)) + 1} is not of length 1")
    time = np.clip(time, t[0], t[-1])
    position = np.stack([np.interp(time, t, samples[:, 1 + axis]) for axis in range(3)], axis=-1)
    left = np.clip(np.searchsorted(t, time, side="right") - 1, 0, max(0, len(t) - 2))
    right = np.minimum(left + 1, len(t) - 1)
    part = (time - t[left]) / np.where(right > left, t[right] - t[left], 1.0)
    first, last = Rotation.from_quat(quaternion[left]), Rotation.from_quat(quaternion[right])
    turned = Rotation.from_rotvec(part[:, None] * (last * first.inv()).as_rotvec()) * first
    return np.concatenate([position, turned.as_quat()], axis=-1)
