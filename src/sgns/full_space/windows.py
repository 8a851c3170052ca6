"""Training windows of whole runs: d positions of every particle and one target, read from the run files as
they are drawn.

Shapes: B batch, d history positions, n particles, N body nodes, T frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from sgns.errors import UserError
from sgns.learning.body import BodyTrack, body_track
from sgns.learning.data import random_walk
from sgns.poses import in_world_frame
from sgns.runs import Run

__all__ = ["FullSpaceBatch", "FullSpaceRun", "FullSpaceWindows"]


class FullSpaceBatch(NamedTuple):
    """Windows of one optimisation step; as `sgns.learning.data.Batch`, with particles in the place of modes.

    Attributes:
        position: Clean positions, the target last [m], float64, shape (B, d + 1, n, 3).
        noise: Offset added to the history [m], float64, shape (B, d, n, 3).
        body: The d frames that end with the target's, (B, d, N, ...).
        force: At the target frame [N], shape (B, 3).
    """

    position: Tensor
    noise: Tensor
    body: BodyTrack
    force: Tensor

    @property
    def history(self) -> Tensor:
        """What the network is shown: the noisy history [m], shape (B, d, n, 3)."""
        return self.position[:, :-1] + self.noise

    @property
    def acceleration(self) -> Tensor:
        """The target [m], shape (B, n, 3): it undoes the noise of the velocity and keeps that of the position."""
        shown = self.history
        return self.position[:, -1] + self.noise[:, -1] - 2 * shown[:, -1] + shown[:, -2]

    def to(self, device: torch.device) -> FullSpaceBatch:
        """The batch on another device."""
        body = BodyTrack(*(part.to(device) for part in self.body))
        return FullSpaceBatch(self.position.to(device), self.noise.to(device), body, self.force.to(device))


class FullSpaceRun:
    """The small series of a run, in memory; its soil stays in the file.

    Args:
        path: The run file.
        body_nodes: In the body frame [m], shape (N, 3); None: the body points that the run recorded.

    Attributes:
        track: The body at all T frames.
        force: By the soil on the body [N], shape (T, 3), float64.
        bin_size: Lx, Ly, Lz [m], shape (3,), float64.
    """

    def __init__(self, path: str | Path, body_nodes: np.ndarray | None = None) -> None:
        self.path = Path(path)
        with Run(path) as run:
            points = run.body_points if body_nodes is None else in_world_frame(run.pose, body_nodes)
            if points.shape[1] == 0:
                raise UserError(f"{path} has no body points; give body nodes of your own")
            self.track = body_track(run.pose, points, "points")
            self.force = torch.as_tensor(run.force)
            self.bin_size = torch.tensor(run.scene["bed"]["size"], dtype=torch.float64)
            self.arrangement_hash, self.frame_rate = run.arrangement_hash, run.frame_rate
            self.particle_count = run.particle_count

    def __len__(self) -> int:
        """T."""
        return len(self.force)

    def soil(self, frames: slice | np.ndarray = slice(None)) -> Tensor:
        """Particles [m] in the chosen frames, float64, shape (t, n, 3)."""
        with Run(self.path) as run:
            return torch.from_numpy(run.positions(frames)).double()


class FullSpaceWindows:
    """Windows drawn from a set of runs with replacement, every frame but the first of each being a target.

    Before frame 0 a run is at rest, as for the reduced windows.

    Args:
        runs: Of one bed.
        history: d.
        seed: Of order and noise.

    Raises:
        UserError: No runs, or runs that do not belong together.
    """

    def __init__(self, runs: Sequence[FullSpaceRun], history: int, seed: int = 0) -> None:
        if not runs or all(len(run) < 2 for run in runs):
            raise UserError(
                "there are no training runs of two frames or more; make some: sgns simulate dataset=quick"
            )
        for run in runs[1:]:
            one, other = (
                (r.arrangement_hash, r.frame_rate, r.track.position.shape[1], r.bin_size.tolist())
                for r in (runs[0], run)
            )
            if one != other:
                raise UserError(
                    f"{runs[0].path} and {run.path} differ in bed, frame rate or number of body nodes; train on runs "
                    "of one bed"
                )
        self.runs = list(runs)
        self.history = history
        self.seed = seed
        self.targets = [(run, frame) for run in self.runs for frame in range(1, len(run))]

    def __len__(self) -> int:
        """The number of windows."""
        return len(self.targets)

    def window(self, index: int) -> FullSpaceBatch:
        """One window without noise, B = 1."""
        run, target = self.targets[index]
        frames = np.maximum(np.arange(target - self.history, target + 1), 0)
        soil = run.soil(frames)[None]
        body = BodyTrack(*(part[None] for part in run.track.frames(torch.from_numpy(frames[1:]))))
        return FullSpaceBatch(soil, torch.zeros_like(soil[:, :-1]), body, run.force[None, target])

    def batch(self, step: int, size: int, noise_scale: Tensor) -> FullSpaceBatch:
        """The batch of a step, a function of (seed, step) and nothing else.

        Args:
            step: Optimisation step from 0.
            size: B.
            noise_scale: Deviation of the newest velocity's noise [m], shape (3,).
        """
        source = torch.Generator().manual_seed(
            int(np.random.SeedSequence([self.seed, step]).generate_state(1)[0])
        )
        drawn = torch.randint(len(self), (size,), generator=source).tolist()
        windows = [self.window(index) for index in drawn]
        body = BodyTrack(*(torch.cat(parts) for parts in zip(*(w.body for w in windows), strict=True)))
        soil, force = (torch.cat([getattr(w, name) for w in windows]) for name in ("position", "force"))
        noise = random_walk(noise_scale.expand(soil.shape[2], 3), (size, self.history), source)
        return FullSpaceBatch(soil, noise, body, force)
