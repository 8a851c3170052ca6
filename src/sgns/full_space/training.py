"""Statistics, loss and optimisation of the dynamics in full space."""

from __future__ import annotations

import sys
import time
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from sgns.clock import elapsed
from sgns.errors import UserError
from sgns.full_space.dynamics import FullSpaceDynamics
from sgns.full_space.windows import FullSpaceBatch, FullSpaceWindows
from sgns.learning.normalisation import Standardiser
from sgns.learning.trainee import TrainingSettings

__all__ = ["TrainingRecord", "fit_normalisation", "losses", "train"]


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
