"""What the network is told about the body: where it is and how it moves, frame by frame.

A tool's motion is prescribed. A wheel's height follows from the soil: of the node "pose" the network then predicts
the height, of the nodes "points" everything.

Shapes: T frames, M body points, N body nodes (1 for "pose", M for "points"), K motion components (6 or 3).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from sgns.errors import UserError
from sgns.poses import rotation_matrices, rotation_vectors

__all__ = ["BODY_NODES", "BodyTrack", "body_track", "free_axes", "nearest_rigid"]

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

    def displaced(self, offset: Tensor) -> BodyTrack:
        """The track with offsets [m] of its positions, shape (..., T + 1, N, 3): those of the frame before the first
        and of every frame. Motions follow."""
        motion = self.motion.clone()
        motion[..., :3] += offset.diff(dim=-3)
        return self._replace(position=self.position + offset[..., 1:, :, :], motion=motion)

    def moved_last(self, displacement: Tensor) -> BodyTrack:
        """The track whose last frame lies a displacement [m] (..., N, 3) from the one before."""
        position = torch.cat(
            [self.position[..., :-1, :, :], (self.position[..., -2, :, :] + displacement).unsqueeze(-3)],
            dim=-3,
        )
        last = torch.cat([displacement, self.motion[..., -1, :, 3:]], dim=-1).unsqueeze(-3)
        return self._replace(position=position, motion=torch.cat([self.motion[..., :-1, :, :], last], dim=-3))


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


def free_axes(predicted: bool, body_nodes: str) -> Tensor:
    """Which axes of a body node's position the network predicts, shape (3,) of ones and zeros.

    Of a predicted body the node "pose" has a free height, as the axle of a wheel that is driven along a prescribed
    way; "points" are free particles that know of no way.
    """
    if not predicted:
        return torch.zeros(3, dtype=torch.float64)
    return torch.tensor([0.0, 0.0, 1.0] if body_nodes == "pose" else [1.0, 1.0, 1.0], dtype=torch.float64)


def nearest_rigid(reference: Tensor, points: Tensor) -> Tensor:
    """The rigidly moved reference that lies nearest to some points (Kabsch 1976), in the sense of least squares.

    Args:
        reference: Points of the body in any one pose [m], shape (..., M, 3).
        points: Where they are said to be [m], shape (..., M, 3).

    Returns:
        Shape (..., M, 3); not finite where the points are not.
    """
    here, there = reference.mean(-2, keepdim=True), points.mean(-2, keepdim=True)
    product = (reference - here).transpose(-1, -2) @ (points - there)
    # The decomposition fails where one of many is not finite; there `there` is not finite either, and what comes out.
    sound = product.isfinite().flatten(-2).all(-1)[..., None, None]
    u, _, vh = torch.linalg.svd(torch.where(sound, product, 0.0))
    # A reflection is no motion: turn the direction of least extent round.
    flip = torch.ones_like(u[..., 0])
    flip[..., 2] = torch.sign(torch.linalg.det(u @ vh))
    return (reference - here) @ ((u * flip.unsqueeze(-2)) @ vh) + there
