"""The loss, the optimiser and its schedule.

Letters: B batch, V nodes, r modes, h steps of the horizon.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import lightning as L
import numpy as np
import torch
from torch import Tensor

from sgns.config import UserError, check_fields
from sgns.model.checkpoint import Surrogate
from sgns.model.features import BodyTrack
from sgns.model.network_dynamics import LatentDynamics
from sgns.train.windows import NOISE_UNITS, SCALES, Batch

SCHEDULES = ("cosine", "exponential")
LOSSES = ("change", "force", "torque")
CHANGE_OF = ("free", "all")
# A training whose loss is this many times that of its first step learns no more.
_DIVERGED = 1e4


@dataclass(frozen=True)
class TrainingSettings:
    """What `conf/training` says; see there for the meaning of each key."""

    max_steps: int
    batch_size: int
    learning_rate: float
    final_learning_rate: float
    warmup_steps: int
    schedule: str
    decades: float
    weight_decay: float
    gradient_clip: float | None
    noise: float
    noise_unit: str
    scales: str
    normalisation_floor: float
    horizon: int
    fewer_modes: float
    change_of: str
    loss: dict[str, float]
    validate_every: int
    log_every: int
    resume: str | bool
    threads: int | None

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> TrainingSettings:
        """From plain values, checked.

        Raises:
            UserError: A value is out of range; the line names the key.
        """
        check_fields(cls, values, "training")
        settings = cls(**values)
        if not isinstance(settings.loss, dict) or set(settings.loss) != set(LOSSES):
            raise UserError(f"training.loss is {settings.loss!r}; it needs a weight for {', '.join(LOSSES)}")
        for key, low in (
            ("max_steps", 1),
            ("batch_size", 1),
            ("warmup_steps", 0),
            ("weight_decay", 0),
            ("noise", 0),
            ("normalisation_floor", 0),
            ("decades", 0),
            ("horizon", 1),
            ("fewer_modes", 0),
            ("validate_every", 1),
            ("log_every", 1),
            ("threads", 1),
        ):
            value = getattr(settings, key)
            if value is not None and value < low:
                raise UserError(f"training.{key} is {value}; it must be at least {low}")
        for key in ("learning_rate", "final_learning_rate", "gradient_clip"):
            value = getattr(settings, key)
            if value is not None and value <= 0:
                raise UserError(f"training.{key} is {value}; it must be above 0")
        for key, weight in settings.loss.items():
            if isinstance(weight, bool) or not isinstance(weight, (int, float)) or not 0 <= weight < math.inf:
                raise UserError(f"training.loss.{key} is {weight!r}; it must be a number, 0 or more")
        if settings.fewer_modes > 1:
            raise UserError(
                f"training.fewer_modes is {settings.fewer_modes}; allowed: 0 to 1, a share of the steps"
            )
        for key, allowed in (
            ("schedule", SCHEDULES),
            ("noise_unit", NOISE_UNITS),
            ("scales", SCALES),
            ("change_of", CHANGE_OF),
        ):
            if getattr(settings, key) not in allowed:
                raise UserError(
                    f"training.{key} is {getattr(settings, key)!r}; allowed: {', '.join(allowed)}"
                )
        if settings.resume not in ("auto", False):
            raise UserError(f"training.resume is {settings.resume!r}; allowed: auto, false")
        return settings

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for a checkpoint."""
        return asdict(self)

    def rate(self, step: int) -> float:
        """Learning rate of a step (from 0) as a share of the highest: a linear rise, then the fall of the
        schedule."""
        if step < self.warmup_steps:
            return (step + 1) / (self.warmup_steps + 1)
        done = min(1.0, (step - self.warmup_steps) / max(1, self.max_steps - self.warmup_steps))
        end = self.final_learning_rate / self.learning_rate
        if self.schedule == "exponential":
            return max(end, 10.0 ** (-self.decades * done))
        return end + (1 - end) * 0.5 * (1 + math.cos(math.pi * done))


class SurrogateTraining(L.LightningModule):
    """One optimisation step of a surrogate.

    Args:
        surrogate: What is trained; all of it goes into the checkpoint.
        settings: How.
    """

    def __init__(self, surrogate: Surrogate, settings: TrainingSettings) -> None:
        super().__init__()
        self.surrogate = surrogate
        self.settings = settings
        self.first_loss: float | None = None
        self.begun = False

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Squared errors of the normalised quantities, unweighted: summed over axes, averaged over the nodes that
        count, the steps of the horizon and the batch.

        After one step the error of a position is the error of its predicted change. After k steps with the same error
        it has grown k (k + 1) / 2 times, by which it is divided, or k times for predicted velocities.
        """
        dynamics = self.dynamics_of(batch)
        modes = dynamics.num_modes
        latent, track, following = (
            batch.history[:, :, :modes],
            batch.shown_body,
            batch.following[:, :, :modes],
        )
        seen = track.frames(slice(0, dynamics.history))
        found: dict[str, list[Tensor]] = {name: [] for name in LOSSES}
        for k in range(batch.horizon):
            prediction = dynamics(latent, seen, batch.context)
            step = dynamics.taken(prediction, latent, seen)
            grown = (k + 1) * (k + 2) / 2 if dynamics.settings.predicts == "acceleration" else k + 1
            error = (step.latent - following[:, k]) / dynamics.change.scale
            if dynamics.predicts_body or self.settings.change_of == "all":
                moved = dynamics.body_displacement(prediction, seen)
                there = track.position[:, dynamics.history - 1 + k]
                missed = (seen.position[:, -2] + moved - there) / dynamics.body_change.scale
                if self.settings.change_of == "free":
                    missed = missed * dynamics.free
                error = torch.cat([error, missed], dim=-2)
            found["change"].append((error / grown).float().square().sum(-1).mean())
            for name in ("force", "torque"):
                # The mean's share of every node cancels the mean in the target.
                target = getattr(dynamics, name).normalise(getattr(batch, name)[:, k])
                found[name].append((getattr(prediction, name).sum(-2) - target).square().sum(-1).mean())
            if k + 1 < batch.horizon:
                latent = torch.cat([latent[:, 1:], step.latent[:, None]], dim=1)
                seen = seen.moved_last(step.displacement) if dynamics.predicts_body else seen
                coming = track.frames(slice(dynamics.history + k, dynamics.history + k + 1))
                seen = BodyTrack(
                    *(torch.cat([a[:, 1:], b], dim=1) for a, b in zip(seen, coming, strict=True))
                )
        return {name: torch.stack(values).mean() for name, values in found.items()}

    def dynamics_of(self, batch: Batch) -> LatentDynamics:
        """The network, in some steps with a part of its modes only, so that it learns to do without the last ones."""
        dynamics = self.surrogate.dynamics
        if self.settings.fewer_modes == 0 or not self.training:
            return dynamics
        draw = np.random.default_rng([self.global_step, dynamics.num_modes])
        if draw.random() >= self.settings.fewer_modes:
            return dynamics
        return dynamics.with_modes(int(draw.integers(1, dynamics.num_modes + 1)))

    def training_step(self, batch: Batch, _: int) -> Tensor:
        """The weighted loss; stops the training when it is not finite or has grown beyond measure."""
        losses = self.losses(batch)
        loss = sum(self.settings.loss[name] * value for name, value in losses.items())
        assert isinstance(loss, Tensor)
        total = float(loss.detach())
        if self.first_loss is None:
            self.first_loss = total
        cure = (
            f"likely the learning rate is too high: lower training.learning_rate (now "
            f"{self.settings.learning_rate:g}) or training.gradient_clip (now {self.settings.gradient_clip})"
        )
        if not math.isfinite(total):
            worst = next((name for name, value in losses.items() if not bool(torch.isfinite(value))), "loss")
            raise UserError(f"the {worst} loss is {total} at step {self.global_step}; {cure}")
        if total > _DIVERGED * self.first_loss > 0:
            raise UserError(
                f"the training diverges: the loss is {total:.3g} at step {self.global_step} and was "
                f"{self.first_loss:.3g} in the first; {cure}"
            )
        for name, value in losses.items():
            self.log(f"loss/{name}", value.detach())
        self.log("loss/total", loss.detach())
        return loss

    def configure_optimizers(self) -> dict[str, Any]:
        """AdamW and a schedule by steps."""
        optimizer = torch.optim.AdamW(
            self.surrogate.parameters(),
            lr=self.settings.learning_rate,
            weight_decay=self.settings.weight_decay,
            fused=True,
        )
        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, self.settings.rate)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def require_finite_weights(self) -> None:
        """For before a checkpoint is written: the one of before is worth more than one that is not finite."""
        for name, weight in self.surrogate.named_parameters():
            if not bool(torch.isfinite(weight).all()):
                raise UserError(
                    f"the weights {name} are not finite after step {self.global_step}; likely the learning rate is too "
                    f"high: lower training.learning_rate (now {self.settings.learning_rate:g})"
                )

    def on_train_start(self) -> None:
        """What there was to go on from has been taken."""
        self.begun = True

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """The card makes the checkpoint self-contained."""
        checkpoint["hyper_parameters"] = self.surrogate.card
        checkpoint["first_loss"] = self.first_loss

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """A resumed training knows how it began."""
        self.first_loss = checkpoint.get("first_loss")
