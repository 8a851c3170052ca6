"""Training of the network on every particle: windows, statistics, loss."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from mpm_warp.poses import in_world_frame
from sgns.clock import elapsed
from sgns.config import UserError
from sgns.data.run import Run
from sgns.model.features import BodyTrack, body_track
from sgns.model.full_space import FullSpaceDynamics
from sgns.model.network import Standardiser
from sgns.train.lightning_module import TrainingSettings
from sgns.train.windows import random_walk

# --- Training windows of whole runs: d positions of every particle and one target, read from the run files
# they are drawn.
#
# Shapes: B batch, d history positions, n particles, N body nodes, T frames.


class FullSpaceBatch(NamedTuple):
    """Windows of one optimisation step; as `sgns.train.windows.Batch`, with particles in the place of modes.

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


# --- Statistics, loss and optimisation of the dynamics in full space ------------------------------------


class TrainingRecord(NamedTuple):
    """How a training went.

    Attributes:
        acceleration: Loss of the acceleration of every step [1].
        force: Loss of the force of every step [1].
        seconds: Wall time of every step, reading included [s].
    """

    acceleration: list[float]
    force: list[float]
    seconds: list[float]


def fit_normalisation(
    dynamics: FullSpaceDynamics, windows: FullSpaceWindows, noise: float, floor: float, samples: int = 64
) -> Tensor:
    """Give the dynamics the statistics of windows spread evenly over the training runs.

    All particles share one scale per axis: what a particle does must not depend on its number.

    Args:
        dynamics: Filled in place.
        windows: The training windows.
        noise: Deviation of the velocity noise as a share of the velocity's scale.
        floor: Smallest scale as a share of the quantity's largest.
        samples: How many windows to read.

    Returns:
        Deviation of the velocity noise [m], shape (3,).
    """
    chosen = torch.linspace(0, len(windows) - 1, min(samples, len(windows))).long().unique().tolist()
    read = [windows.window(index) for index in chosen]
    dynamics.velocity = Standardiser.fit(
        torch.cat([(w.position[0, -1] - w.position[0, -2]) for w in read]), floor, centred=False
    )
    noise_scale = noise * dynamics.velocity.scale
    clean = Standardiser.fit(torch.cat([w.acceleration[0] for w in read]), floor, centred=False)
    # The target contains the correction of the velocity's noise.
    dynamics.acceleration = Standardiser(clean.mean, (clean.scale.square() + noise_scale.square()).sqrt())
    motion = torch.cat([run.track.motion[1:].flatten(0, 1) for run in windows.runs])
    dynamics.body_motion = Standardiser.fit(motion, floor, centred=False)
    dynamics.force = Standardiser.fit(torch.cat([run.force[1:] for run in windows.runs]), floor)
    return noise_scale


def losses(dynamics: FullSpaceDynamics, batch: FullSpaceBatch) -> tuple[Tensor, Tensor]:
    """Squared errors of the normalised acceleration, mean over particles, and of the normalised force.

    Args:
        dynamics: On any device.
        batch: From `FullSpaceWindows`; taken to that device.
    """
    batch = batch.to(dynamics.bin_size.device)
    prediction = dynamics(batch.history, batch.body)
    acceleration = prediction.acceleration - dynamics.acceleration.normalise(batch.acceleration)
    force = dynamics.force.normalise(dynamics.force_contributions(prediction).sum(-2))
    force = force - dynamics.force.normalise(batch.force)
    return acceleration.square().sum(-1).mean(), force.square().sum(-1).mean()


def train(
    dynamics: FullSpaceDynamics, windows: FullSpaceWindows, settings: TrainingSettings, noise_scale: Tensor
) -> TrainingRecord:
    """Optimise for `settings.max_steps` steps with AdamW, the schedule and the clipping of `settings`.

    Args:
        dynamics: With its statistics; trained in place.
        windows: To draw from.
        settings: As for the latent dynamics; there is no torque here and no validation on the way.
        noise_scale: Of the history's noise [m], shape (3,), as `fit_normalisation` returns it.

    Raises:
        UserError: A loss is not finite.
    """
    optimiser = torch.optim.AdamW(
        dynamics.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay
    )
    schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, settings.rate)
    record = TrainingRecord([], [], [])
    bar = tqdm(range(settings.max_steps), unit="step", leave=False, disable=not sys.stderr.isatty())
    for step in bar:
        began = time.perf_counter()
        found = losses(dynamics, windows.batch(step, settings.batch_size, noise_scale))
        loss = settings.loss["change"] * found[0] + settings.loss["force"] * found[1]
        if not bool(torch.isfinite(loss)):
            raise UserError(
                f"the loss is {float(loss.detach())} at step {step}; lower training.learning_rate"
            )
        optimiser.zero_grad()
        loss.backward()
        if settings.gradient_clip is not None:
            torch.nn.utils.clip_grad_norm_(dynamics.parameters(), settings.gradient_clip)
        optimiser.step()
        schedule.step()
        for values, value in zip(record[:2], found, strict=True):
            values.append(float(value.detach()))
        record.seconds.append(elapsed(began, time.perf_counter()))
    return record
