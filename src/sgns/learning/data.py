"""Training windows: d positions of history and one target, all in memory, drawn from (seed, step) alone.

Shapes: B batch, d history positions, r modes, N body nodes, W windows, F stacked frames of all runs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import lightning as L
import numpy as np
import torch
from torch import Tensor

from sgns.errors import UserError
from sgns.learning.body import BodyTrack, body_track
from sgns.learning.dynamics import LatentDynamics
from sgns.learning.normalisation import Standardiser

if TYPE_CHECKING:
    from sgns.reduction.reduced import ReducedRun

__all__ = ["Batch", "TrainingWindows", "WindowDataModule", "fit_normalisation", "random_walk"]

# Streams of random numbers that must not be the same.
_SHUFFLE, _NOISE = 0, 1


class Batch(NamedTuple):
    """Windows of one optimisation step.

    Attributes:
        latent: Clean latent positions, the target last [m], float64, shape (B, d + 1, r, 3).
        noise: Offset added to the history [m], float64, shape (B, d, r, 3).
        body: The d frames that end with the target's, (B, d, N, ...).
        force: At the target frame [N], shape (B, 3).
        torque: At the target frame [N m], shape (B, 3).
    """

    latent: Tensor
    noise: Tensor
    body: BodyTrack
    force: Tensor
    torque: Tensor

    @property
    def history(self) -> Tensor:
        """What the network is shown: the noisy history [m], shape (B, d, r, 3)."""
        return self.latent[:, :-1] + self.noise

    @property
    def acceleration(self) -> Tensor:
        """The target [m], shape (B, r, 3).

        Second difference from the noisy history to the clean next position moved by the newest noise: the
        network learns to undo errors of the velocity and lets those of the position be, as in
        Sanchez-Gonzalez et al. 2020 (arXiv:2002.09405, appendix B).
        """
        shown = self.history
        following = self.latent[:, -1] + self.noise[:, -1]
        return following - 2 * shown[:, -1] + shown[:, -2]


class TrainingWindows:
    """Every window of a set of runs.

    Each run is preceded by d - 1 copies of its frame 0, so that starts at rest are among the windows and
    every frame but the first is a target.

    Args:
        runs: Reduced runs; their latent positions may have more modes than are used.
        num_modes: r.
        history: d.
        body_nodes: "pose" or "points".
        seed: Of shuffle and noise.
    """

    def __init__(
        self, runs: Sequence[ReducedRun], num_modes: int, history: int, body_nodes: str, seed: int = 0
    ) -> None:
        if not runs:
            raise UserError(
                "the training split has no runs; simulate the dataset first: sgns simulate dataset=<name>"
            )
        if len({run.body_points.shape[1] for run in runs}) > 1 and body_nodes == "points":
            raise UserError("the runs have different numbers of body points; use model.body_nodes=pose")
        self.history = history
        self.seed = seed
        latent, tracks, force, torque, targets = [], [], [], [], []
        offset, pad = 0, history - 1
        for run in runs:
            latent.append(pad_start(torch.as_tensor(run.latent[:, :num_modes]), pad))
            track = body_track(run.pose, run.body_points, body_nodes)
            tracks.append(BodyTrack(*(pad_start(part, pad) for part in track)))
            force.append(pad_start(torch.as_tensor(run.force), pad))
            torque.append(pad_start(torch.as_tensor(run.torque), pad))
            targets.append(torch.arange(offset + history, offset + pad + len(run.latent)))
            offset += pad + len(run.latent)
        self.latent = torch.cat(latent)
        self.body = BodyTrack(*(torch.cat(parts) for parts in zip(*tracks, strict=True)))
        self.force = torch.cat(force)
        self.torque = torch.cat(torque)
        self.targets = torch.cat(targets)
        if len(self.targets) == 0:
            raise UserError("the training runs hold one frame each; at least two are needed to learn a step")
        if not bool(torch.isfinite(self.latent).all()):
            raise UserError(
                "a reduced training run holds values that are not finite; find it with: sgns check <run.h5>"
            )
        self._order: dict[int, Tensor] = {}

    def __len__(self) -> int:
        """W, the number of windows."""
        return len(self.targets)

    def windows(self, rows: Tensor, noise: Tensor | None = None) -> Batch:
        """The windows whose targets are the given stacked frames, shape (B,)."""
        d = self.history
        frames = rows[:, None] + torch.arange(-d, 1)
        latent = self.latent[frames]
        if noise is None:
            noise = torch.zeros_like(latent[:, :-1])
        body = BodyTrack(*(part[frames[:, 1:]] for part in self.body))
        return Batch(latent, noise, body, self.force[rows], self.torque[rows])

    def batch(self, step: int, size: int, noise_scale: Tensor) -> Batch:
        """The batch of a step: a function of (seed, step) and nothing else, so that resuming changes nothing.

        Args:
            step: Optimisation step from 0.
            size: B.
            noise_scale: Deviation of the newest velocity's noise [m], shape (r, 3).
        """
        place = torch.arange(step * size, (step + 1) * size)
        epoch = place // len(self)
        rows = torch.cat(
            [
                self._epoch_order(int(e))[place[epoch == e] % len(self)]
                for e in torch.unique_consecutive(epoch)
            ]
        )
        noise = random_walk(noise_scale, (size, self.history), generator(self.seed, step, _NOISE))
        return self.windows(self.targets[rows], noise)

    def batches(self, size: int, noise_scale: Tensor, first: int = 0) -> Iterator[Batch]:
        """Batches without end, from step `first`."""
        step = first
        while True:
            yield self.batch(step, size, noise_scale)
            step += 1

    def _epoch_order(self, epoch: int) -> Tensor:
        if epoch not in self._order:
            # A batch may straddle two epochs; older ones are never asked for again.
            self._order = {e: order for e, order in self._order.items() if e == epoch - 1}
            self._order[epoch] = torch.randperm(len(self), generator=generator(self.seed, epoch, _SHUFFLE))
        return self._order[epoch]


def pad_start(values: Tensor, count: int) -> Tensor:
    """`count` copies of the first row (frame) put before all rows."""
    return torch.cat([values[:1].expand(count, *values.shape[1:]), values])


def generator(seed: int, index: int, stream: int) -> torch.Generator:
    """A generator that depends on its arguments only."""
    state = np.random.SeedSequence([seed, index, stream]).generate_state(1, np.uint64)[0]
    return torch.Generator().manual_seed(int(state) & (2**63 - 1))


def random_walk(scale: Tensor, shape: tuple[int, int], source: torch.Generator) -> Tensor:
    """Noise on a history whose velocity errors add up, as those of a rollout do.

    Args:
        scale: Deviation of the newest velocity's noise [m], shape (r, 3).
        shape: (B, d).
        source: Generator.

    Returns:
        Offsets [m], float64, shape (B, d, r, 3); zero at the oldest position.
    """
    batch, d = shape
    steps = torch.randn((batch, d - 1, *scale.shape), generator=source, dtype=torch.float64)
    velocity = torch.cumsum(steps * scale / (d - 1) ** 0.5, dim=1)
    return torch.nn.functional.pad(torch.cumsum(velocity, dim=1), (0, 0, 0, 0, 1, 0))


def fit_normalisation(
    dynamics: LatentDynamics, windows: TrainingWindows, noise: float, floor: float
) -> Tensor:
    """Give the dynamics the statistics of the training windows.

    Positions, velocities and accelerations are scaled per mode and axis: modes differ by more than an order
    of magnitude. Velocities and accelerations keep their zero, which means rest.

    Args:
        dynamics: Filled in place.
        windows: The training windows.
        noise: Deviation of the velocity noise as a share of each mode's velocity scale.
        floor: Smallest scale as a share of the quantity's largest.

    Returns:
        Deviation of the velocity noise [m], shape (r, 3).
    """
    rows = windows.targets
    latent, body = windows.latent, windows.body
    velocity = latent[rows] - latent[rows - 1]
    acceleration = velocity - (latent[rows - 1] - latent[rows - 2])
    dynamics.position = Standardiser.fit(latent[rows - 1], floor)
    dynamics.velocity = Standardiser.fit(velocity, floor, centred=False)
    noise_scale = noise * dynamics.velocity.scale
    clean = Standardiser.fit(acceleration, floor, centred=False)
    # The target contains the correction of the velocity's noise; without either it would be constant.
    dynamics.acceleration = Standardiser(clean.mean, (clean.scale.square() + noise_scale.square()).sqrt())
    dynamics.body_position = Standardiser.fit(body.position[rows - 1].flatten(0, 1), floor)
    dynamics.body_orientation = Standardiser.fit(body.orientation[rows - 1].flatten(0, 1), floor)
    dynamics.body_motion = fit_motion(body.motion[rows].flatten(0, 1), floor)
    dynamics.force = Standardiser.fit(windows.force[rows], floor)
    dynamics.torque = Standardiser.fit(windows.torque[rows], floor)
    return noise_scale


def fit_motion(motion: Tensor, floor: float) -> Standardiser:
    """Displacement [m] and rotation [rad] have their own largest scale each."""
    parts = [Standardiser.fit(part, floor, centred=False) for part in motion.split(3, dim=-1)]
    return Standardiser(torch.cat([p.mean for p in parts]), torch.cat([p.scale for p in parts]))


class WindowDataModule(L.LightningDataModule):
    """Hands the trainer an endless stream of batches that starts at the step it stands at.

    Everything is in memory and a batch is a few tensor look-ups, so there are no worker processes.

    Args:
        windows: The training windows.
        batch_size: B.
        noise_scale: Deviation of the newest velocity's noise [m], shape (r, 3).
    """

    def __init__(self, windows: TrainingWindows, batch_size: int, noise_scale: Tensor) -> None:
        super().__init__()
        self.training_windows = windows
        self.batch_size = batch_size
        self.noise_scale = noise_scale

    def train_dataloader(self) -> StepBatches:
        """Called by the trainer once its step is known, resumed or not."""
        return StepBatches(self)


class StepBatches:
    """Iterates batches from the trainer's step on.

    Args:
        module: Whose windows and trainer to use.
    """

    def __init__(self, module: WindowDataModule) -> None:
        self.module = module

    def __iter__(self) -> Iterator[Batch]:
        """Endless."""
        trainer = self.module.trainer
        first = 0 if trainer is None else trainer.global_step
        return self.module.training_windows.batches(self.module.batch_size, self.module.noise_scale, first)
