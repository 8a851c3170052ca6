"""What the network is told about the prescribed body: where it is and how it moves, frame by frame.

Shapes: T frames, M body points, N body nodes (1 for "pose", M for "points"), K motion components (6 or 3).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from sgns.errors import UserError

__all__ = ["BODY_NODES", "BodyTrack", "body_track", "check_poses", "in_body_frame", "in_world_frame"]

BODY_NODES = ("pose", "points")


class BodyTrack(NamedTuple):
    """The body along a path.

    Attributes:
        position: Centre of mass, or the points [m], shape (..., T, N, 3).
        orientation: First two columns of the rotation matrix, body -> world [1], shape (..., T, N, 6); for
            "points", which show it themselves, shape (..., T, N, 0).
        motion: Movement since the previous frame, zero in the first: displacement [m], followed for "pose" by
            the rotation vector [rad]; shape (..., T, N, K).
    """

    position: Tensor
    orientation: Tensor
    motion: Tensor

    def frames(self, index: slice | Tensor) -> BodyTrack:
        """The track at some frames."""
        return BodyTrack(*(part[..., index, :, :] for part in self))


def body_track(poses: np.ndarray, points: np.ndarray | None, body_nodes: str) -> BodyTrack:
    """Describe a path as the network sees it.

    Args:
        poses: Centre of mass [m] and unit quaternion x, y, z, w, shape (T, 7).
        points: Body points in the world frame [m], shape (T, M, 3); only read for "points".
        body_nodes: "pose" (one node) or "points" (one node per point).

    Returns:
        The track, float64.
    """
    if body_nodes == "points":
        if points is None or points.shape[1] == 0:
            raise UserError(
                "model.body_nodes=points needs body points and the runs have none; use model.body_nodes=pose"
            )
        position = torch.as_tensor(np.array(points, dtype=np.float64))
        motion = torch.zeros_like(position)
        motion[1:] = position[1:] - position[:-1]
        return BodyTrack(position, position[..., :0], motion)
    poses = np.asarray(poses, dtype=np.float64)
    columns = rotation_matrices(poses[:, 3:])[:, :, :2]
    motion = np.zeros((len(poses), 6))
    motion[1:, :3] = poses[1:, :3] - poses[:-1, :3]
    motion[1:, 3:] = rotation_vectors(poses[:-1, 3:], poses[1:, 3:])
    return BodyTrack(
        torch.tensor(poses[:, None, :3]),
        torch.tensor(columns.transpose(0, 2, 1).reshape(len(poses), 1, 6)),
        torch.tensor(motion[:, None]),
    )


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
    """World-frame rotation vector [rad] that turns `before` into `after`, quaternions (..., 4); shape (...,
    3)."""
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
