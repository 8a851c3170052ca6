"""What the network is told about the prescribed body: where it is and how it moves, frame by frame.

Shapes: T frames, M body points, N body nodes (1 for "pose", M for "points"), K motion components (6 or 3).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from sgns.errors import UserError
from sgns.poses import rotation_matrices, rotation_vectors

__all__ = ["BODY_NODES", "BodyTrack", "body_track"]

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
