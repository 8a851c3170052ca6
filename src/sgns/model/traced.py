"""A simulator's step and its decoder as modules that torch can trace: tensors in, tensors out, nothing but operations
that other runtimes have, too (see `sgns.export`).

Letters: B beds side by side, d history positions, r modes, N body nodes, M body points, K context numbers, n particles.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from mpm_warp.poses import rotation_matrices
from sgns.model.dynamics import Dynamics
from sgns.model.features import BodyTrack, Pace
from sgns.reduction.basis import Basis


def _turning() -> Tensor:
    """With it the 16 products q qᵀ of a unit quaternion, in which its rotation matrix is quadratic, are that matrix
    less one, (16, 9)."""
    unit = np.eye(4)

    def less_one(q: np.ndarray) -> np.ndarray:
        return (rotation_matrices(q) - np.eye(3)).reshape(*q.shape[:-1], 9)

    alone = less_one(unit)
    return torch.from_numpy(0.5 * (less_one(unit[:, None] + unit) - alone[:, None] - alone).reshape(16, 9))


def _between() -> Tensor:
    """With it the 16 products of two unit quaternions, after and before, are after · before⁻¹, (16, 4)."""
    after, before = np.broadcast_arrays(np.eye(4)[:, None], np.eye(4))
    (v, w), (p, q) = ((part[..., :3], part[..., 3:]) for part in (after, before))
    parts = [q * v - w * p - np.cross(v, p), (after * before).sum(-1, keepdims=True)]
    return torch.from_numpy(np.concatenate(parts, axis=-1).reshape(16, 4))


def _products(a: Tensor, b: Tensor) -> Tensor:
    """Of the components of two quaternions (..., 4), shape (..., 16)."""
    return (a.unsqueeze(-1) * b.unsqueeze(-2)).flatten(-2)


class _Network(nn.Module):
    """An `EncodeProcessDecode` on its one graph, without what is written for torch alone."""

    into: Tensor

    def __init__(self, network: Any, edge_index: Tensor, node_count: int) -> None:
        super().__init__()
        self.network = network
        self.sender, self.receiver = edge_index
        into = nn.functional.one_hot(self.receiver, node_count).T.float()
        self.register_buffer("into", into.contiguous())
        self.degree = into.sum(1, keepdim=True)

    def forward(self, nodes: Tensor, edges: Tensor, edge_index: Tensor) -> Tensor:
        return self.network.rearranged(nodes, edges, self)

    def spread(self, edges: Tensor, receiver: Tensor, sender: Tensor) -> Tensor:
        """As of `IndexedAdjacency`."""
        return edges + receiver.index_select(1, self.receiver) + sender.index_select(1, self.sender)

    def gather(self, edges: Tensor) -> Tensor:
        """As of `IndexedAdjacency`, as a product with zeros and ones."""
        return self.into @ edges


def _traceable(dynamics: Dynamics, body_points: int) -> Dynamics:
    """The same dynamics; the weights are shared. A wheel of points is kept rigid by `Step.fitted`."""
    if dynamics.settings.kind != "network":
        return dynamics
    alone: Any = dynamics.with_modes(dynamics.num_modes)
    nodes = 1 if alone.settings.body_nodes == "pose" else body_points
    edges = alone.edge_index(alone.num_modes, nodes, torch.device("cpu"))
    alone.network = _Network(alone.network, edges, alone.num_modes + nodes)
    alone.settings = replace(alone.settings, rigid=False)
    return alone


class Step(nn.Module):
    """One frame: state (B, S), pose (B, 7) and, if there is any, context (B, K) in; next state, modes, force, torque
    and, of a wheel, its pose out.

    The state holds d latent positions, d poses of the frames that the soil took a step into, force and torque; and,
    with a pace, the pose of the frame before and how many frames the tool has been slow. Zeros are a bed that has not
    begun: its step puts the tool at its pose, and the soil at its start.

    Args:
        dynamics: Network or polynomials.
        points: Body points in the body frame [m], shape (M, 3).
        start: Of the soil at rest [m], shape (r, 3).
        pace: When the soil takes a step; None: into every frame.
    """

    turning: Tensor
    between: Tensor
    points: Tensor
    start: Tensor

    def __init__(self, dynamics: Dynamics, points: np.ndarray, start: Tensor, pace: Pace | None) -> None:
        super().__init__()
        self.dynamics = _traceable(dynamics, len(points))
        self.body_nodes = dynamics.settings.body_nodes
        self.d, self.r = dynamics.history, dynamics.num_modes
        self.predicts_body = dynamics.predicts_body
        self.pace = pace
        for name, value in (
            ("turning", _turning()),
            ("between", _between()),
            ("points", torch.as_tensor(points)),
            ("start", start.expand(self.d, -1, -1).clone()),
        ):
            self.register_buffer(name, value)

    @property
    def layout(self) -> dict[str, int]:
        """How many numbers of the state each part has, in their order."""
        parts = {"latent": 3 * self.d * self.r, "poses": 7 * self.d, "force": 3, "torque": 3}
        return parts | ({} if self.pace is None else {"pose": 7, "slow": 1})

    def forward(self, state: Tensor, pose: Tensor, context: Tensor | None = None) -> tuple[Tensor, ...]:
        parts = dict(zip(self.layout, state.split(list(self.layout.values()), dim=1), strict=True))
        begun = parts["poses"][:, -4:].abs().sum(1, keepdim=True) > 0
        latent = torch.where(
            begun[..., None, None], parts["latent"].unflatten(1, (self.d, self.r, 3)), self.start
        )
        poses = torch.where(begun[..., None], parts["poses"].unflatten(1, (self.d, 7)), pose[:, None])
        window = torch.cat([poses, pose[:, None]], dim=1)
        body = self.track(window)
        step = self.dynamics.advance(latent, body, context)
        placed = pose
        if self.predicts_body:
            there = body.position[:, -2] + step.displacement
            placed = torch.cat([there[:, 0], pose[:, 3:]], dim=1)
            if self.body_nodes == "points":
                placed = self.fitted(there, poses[:, -1, 3:])
        moves, rest = begun, []
        if self.pace is not None:
            before = torch.where(begun, parts["pose"], pose)
            here, shown, stepped = self.markers(torch.stack([pose, before, poses[:, -1]], dim=1)).unbind(1)
            slow = torch.where(begun, parts["slow"], float(self.pace.settling)) + 1.0
            slow = torch.where(self.reaches(here, shown), torch.zeros_like(slow), slow)
            moves = begun & ((slow < self.pace.settling) | self.reaches(here, stepped))
            rest = [pose, torch.where(begun, slow, float(self.pace.settling))]
        latent = torch.where(
            moves[..., None, None], torch.cat([latent[:, 1:], step.latent[:, None]], 1), latent
        )
        placed_poses = torch.cat([poses[:, 1:], placed[:, None]], dim=1)
        poses = torch.where(moves[..., None], placed_poses, poses)
        force = torch.where(moves, step.force, parts["force"])
        torque = torch.where(moves, step.torque, parts["torque"])
        following = torch.cat([latent.flatten(1), poses.flatten(1), force, torque, *rest], dim=1)
        out = following, latent[:, -1], force, torque
        return (*out, poses[:, -1]) if self.predicts_body else out

    def world(self, poses: Tensor) -> tuple[Tensor, Tensor]:
        """Rotation matrices (..., 3, 3) of poses (..., 7), and the body points there [m], (..., M, 3)."""
        q = poses[..., 3:]
        rotation = (_products(q, q) @ self.turning + torch.eye(3, dtype=q.dtype).flatten()).unflatten(
            -1, (3, 3)
        )
        # No product with a transposed matrix: onnxruntime 1.21 and older refuse those of doubles.
        turned = (rotation.unsqueeze(-3) * self.points.unsqueeze(-2)).sum(-1)
        return rotation, turned + poses[..., None, :3]

    def track(self, poses: Tensor) -> BodyTrack:
        """What the dynamics see of poses (B, d + 1, 7), without the first; as `sgns.model.features.body_track`."""
        rotation, world = self.world(poses)
        if self.body_nodes == "points":
            return BodyTrack(world[:, 1:], world[:, 1:, :, :0], world[:, 1:] - world[:, :-1])
        # The part of the rotation between two poses along its axis; the shorter way round.
        turned = _products(poses[:, 1:, 3:], poses[:, :-1, 3:]) @ self.between
        sine, cosine = turned[..., :3].square().sum(-1, keepdim=True).sqrt(), turned[..., 3:].abs()
        # onnxruntime has no arctangent of doubles; what networks are told is rounded to floats anyway.
        half = torch.atan((sine / cosine).float()).double()
        sign = torch.where(turned[..., 3:] < 0.0, -2.0, 2.0)
        vector = turned[..., :3] * (sign * half / sine.clamp_min(1e-12))
        motion = torch.cat([poses[:, 1:, :3] - poses[:, :-1, :3], vector], dim=-1)
        columns = rotation[:, 1:, :, :2].transpose(-1, -2).flatten(-2)
        return BodyTrack(poses[:, 1:, None, :3], columns[:, :, None], motion[:, :, None])

    def markers(self, poses: Tensor) -> Tensor:
        """As `sgns.model.features.markers`, of poses (..., 7)."""
        return torch.cat([poses[..., None, :3], self.world(poses)[1]], dim=-2)

    def reaches(self, here: Tensor, there: Tensor) -> Tensor:
        """Whether a marker is as far from where it was as a tool moves that is not slow, (B, 1)."""
        assert self.pace is not None
        return (here - there).square().sum(-1).amax(-1, keepdim=True).sqrt() >= self.pace.least

    def fitted(self, world: Tensor, near: Tensor) -> Tensor:
        """The poses (B, 7) in which the body points lie nearest to world points (B, M, 3) [m], as
        `mpm_warp.poses.fitted_poses`; their quaternions are at less than half a turn from `near` (B, 4).

        The quaternion is the eigenvector of the largest eigenvalue of a symmetric matrix (Horn, J. Opt. Soc. Am. A 4,
        629, 1987), which squaring the matrix leaves over.
        """
        here, there = self.points - self.points.mean(0), world.mean(1)
        product = ((world - there[:, None])[..., None] * here[:, None]).sum(1)
        matrix = (product.flatten(1) @ self.turning.T).unflatten(1, (4, 4))
        matrix = matrix / matrix.square().sum((1, 2), keepdim=True).sqrt()
        matrix = matrix + torch.eye(4, dtype=world.dtype)  # no eigenvalue is negative
        for _ in range(10):
            matrix = matrix @ matrix
            matrix = matrix / matrix.square().sum((1, 2), keepdim=True).sqrt()
        q = (matrix @ near[..., None])[..., 0]
        q = q * torch.where(q[:, 3:] < 0.0, -1.0, 1.0) / q.square().sum(1, keepdim=True).sqrt()
        rotation, _ = self.world(torch.cat([there, q], dim=1))
        place = there - (rotation @ self.points.mean(0)[:, None])[..., 0]
        return torch.cat([place, q], dim=1)


class Decode(nn.Module):
    """Modes (B, r, 3) in, positions of all particles (B, n, 3) [m], float32, out."""

    def __init__(self, basis: Basis) -> None:
        super().__init__()
        self.basis = basis

    def forward(self, latent: Tensor) -> Tensor:
        soil = self.basis.modes @ latent + self.basis.mean
        closure = self.basis.closure
        return (soil if closure is None else soil + closure.displacement(latent)).float()
