"""Many beds of learned soil stepped at once, each under a tool of its own.

Letters: B beds, b some of them, d history positions, r modes, M body points, N body nodes, C context numbers.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from mpm_warp.poses import in_world_frame, rotation_matrices, rotation_vectors
from sgns.config import UserError
from sgns.model.features import BodyTrack, Pace, context_of, distance, markers
from sgns.model.network_dynamics import LatentDynamics
from sgns.simulator import Simulator


class Beds:
    """Many beds of soil stepped at once, each under a tool of its own; each as `Simulator.step` does it, to rounding.

    Args:
        simulator: Its soil at rest is the start; it is not stepped.
        count: B.
        points: Of the tool, in its frame [m], shape (M, 3).
        half: Whether the network computes in bfloat16: faster where the processor has it, 3 digits.

    Attributes:
        latent: The last d positions of the modes [m], shape (B, d, r, 3).
        pose: Of the tools, shape (B, 7); predicted where the tool is free.
        force: By the soil on the tools in the last frame [N], shape (B, 3).
        torque: About their centres of mass [N m], shape (B, 3).
        context: Numbers that the network is told, shape (B, C); may be changed between steps.
    """

    def __init__(self, simulator: Simulator, count: int, points: np.ndarray, half: bool = False) -> None:
        self.dynamics, self.points = simulator.dynamics, points
        self.start = simulator.basis.transform(simulator.start_positions)
        self.latent = self.start.expand(count, simulator.history, -1, -1).clone()
        self.pose, self.force, self.torque = np.zeros((count, 7)), np.zeros((count, 3)), np.zeros((count, 3))
        self.pose[:, 6] = 1.0
        keys = simulator.context_keys
        self.context = np.tile(context_of(simulator.scene, keys), (count, 1))
        # Without a pace the soil follows the clock: every tool is fast enough.
        self.least, self.settling = simulator.pace or Pace(0.0, 1)
        self.slow = np.full(count, self.settling)
        self.here = self._markers(self.pose)
        self.stepped, self.last = self.here.copy(), self.pose.copy()
        self.track = self._resting(self.pose)
        if half:
            if not isinstance(self.dynamics, LatentDynamics):
                raise UserError("half=True is for networks; polynomials are fast without it: leave it out")
            self.dynamics = copy.deepcopy(self.dynamics)
            self.dynamics.network = _Half(self.dynamics.network)  # type: ignore[assignment]  # called alike

    def reset(self, which: np.ndarray, poses: np.ndarray) -> None:
        """Put beds, a mask (B,), to rest with their tools at poses (b, 7)."""
        self.latent[torch.from_numpy(which)] = self.start
        self.pose[which] = self.last[which] = poses
        self.force[which] = self.torque[which] = 0.0
        self.here[which] = self.stepped[which] = self._markers(poses)
        self.slow[which] = self.settling
        for part, fresh in zip(self.track, self._resting(poses), strict=True):
            part[torch.from_numpy(which)] = fresh

    def step(self, poses: np.ndarray, which: np.ndarray | None = None) -> None:
        """Move the tools to poses (B, 7), one frame from now; of beds that a mask (B,) leaves out nothing changes."""
        moving = np.ones(len(poses), bool) if which is None else which
        here = self._markers(poses)
        slow = np.where(distance(here, self.here) >= self.least, 0, self.slow + 1)
        steps = moving & ((slow < self.settling) | (distance(here, self.stepped) >= self.least))
        self.slow[moving], self.here[moving], self.pose[moving] = slow[moving], here[moving], poses[moving]
        if steps.any():
            self._step(steps, poses[steps], here[steps])

    def _step(self, steps: np.ndarray, poses: np.ndarray, here: np.ndarray) -> None:
        """Let the soil of some beds take a step."""
        # Most often all step: then nothing is copied but what is new.
        rows: Any = slice(None) if steps.all() else torch.from_numpy(steps)
        latent = self.latent[rows]
        new = self._moved(self.last[steps], poses)
        # What was seen of the body, without its oldest frame; the track keeps d - 1.
        seen = BodyTrack(
            *(torch.cat([old[rows], part], 1) for old, part in zip(self.track, new, strict=True))
        )
        with torch.inference_mode():
            step = self.dynamics.advance(latent, seen, torch.from_numpy(self.context[steps]))
        if self.dynamics.predicts_body:
            there = (seen.position[:, -2] + step.displacement).numpy()
            poses = self.dynamics.predicted_poses(poses, there, self.points)
            new = self._moved(self.last[steps], poses)
        after = torch.cat([latent[:, 1:], step.latent[:, None]], 1)
        track = BodyTrack(
            *(torch.cat([old[rows][:, 1:], part], 1) for old, part in zip(self.track, new, strict=True))
        )
        if isinstance(rows, slice):
            self.latent, self.track = after, track
        else:
            self.latent[rows] = after
            for old, part in zip(self.track, track, strict=True):
                old[rows] = part
        self.pose[steps] = self.last[steps] = poses
        self.stepped[steps] = here
        self.force[steps], self.torque[steps] = step.force.numpy(), step.torque.numpy()

    def _markers(self, poses: np.ndarray) -> np.ndarray:
        return markers(poses, in_world_frame(poses, self.points))

    def _moved(self, before: np.ndarray, after: np.ndarray) -> BodyTrack:
        """One frame of tools that moved from poses (b, 7) to others, (b, 1, N, ...), as `body_track` has it."""
        if self.dynamics.settings.body_nodes == "points":
            was, now = (torch.from_numpy(in_world_frame(pose, self.points)) for pose in (before, after))
            return BodyTrack(now[:, None], now[:, None, :, :0], (now - was)[:, None])
        columns = rotation_matrices(after[:, 3:])[:, :, :2].transpose(0, 2, 1).reshape(len(after), 6)
        motion = np.concatenate(
            [after[:, :3] - before[:, :3], rotation_vectors(before[:, 3:], after[:, 3:])], 1
        )
        return BodyTrack(
            *(torch.from_numpy(part)[:, None, None] for part in (after[:, :3].copy(), columns, motion))
        )

    def _resting(self, poses: np.ndarray) -> BodyTrack:
        """The d - 1 frames before of tools that rest at poses (b, 7)."""
        frames = self.latent.shape[1] - 1
        return BodyTrack(*(part.repeat(1, frames, 1, 1) for part in self._moved(poses, poses)))


class _Half(nn.Module):
    """A network computed in bfloat16."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network.to(torch.bfloat16)

    def forward(self, nodes: Tensor, edges: Tensor, edge_index: Tensor) -> Tensor:
        return self.network(nodes.to(torch.bfloat16), edges.to(torch.bfloat16), edge_index).float()
