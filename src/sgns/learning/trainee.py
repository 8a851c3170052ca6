"""The loss, the optimiser and its schedule.

Letters: B batch, V nodes, r modes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import lightning as L
import torch
from torch import Tensor

from sgns.errors import UserError
from sgns.learning.data import Batch
from sgns.learning.surrogate import Surrogate
from sgns.settings import check_fields

__all__ = ["SurrogateTraining", "TrainingSettings"]

SCHEDULES = ("cosine", "exponential")
LOSSES = ("acceleration", "force", "torque")


@dataclass(frozen=True)
class TrainingSettings:
    """What `conf/training` says; see there for the meaning of each key."""

    max_steps: int
    batch_size: int
    learning_rate: float
    final_learning_rate: float
    warmup_steps: int
    schedule: str
    weight_decay: float
    gradient_clip: float | None
    noise: float
    normalisation_floor: float
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
        if settings.schedule not in SCHEDULES:
            raise UserError(f"training.schedule is {settings.schedule!r}; allowed: {', '.join(SCHEDULES)}")
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
            return end**done
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

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Squared errors of the normalised quantities, unweighted.

        The acceleration's is summed over axes and averaged over the modes; the prescribed body's is no part
        of it.
        """
        dynamics = self.surrogate.dynamics
        prediction = dynamics(batch.history, batch.body)
        found = {
            "acceleration": prediction.acceleration - dynamics.acceleration.normalise(batch.acceleration)
        }
        for name in ("force", "torque"):
            # The mean's share of every node cancels the mean in the target.
            target = getattr(dynamics, name).normalise(getattr(batch, name))
            found[name] = getattr(prediction, name).sum(-2) - target
        return {name: error.square().sum(-1).mean() for name, error in found.items()}

    def training_step(self, batch: Batch, _: int) -> Tensor:
        """The weighted loss; stops the training when it is not finite."""
        losses = self.losses(batch)
        loss = sum(self.settings.loss[name] * value for name, value in losses.items())
        assert isinstance(loss, Tensor)
        if not bool(torch.isfinite(loss)):
            worst = next((name for name, value in losses.items() if not bool(torch.isfinite(value))), "loss")
            raise UserError(
                f"the {worst} loss is {float(loss.detach())} at step {self.global_step}; likely the learning rate "
                f"is too high: lower training.learning_rate (now {self.settings.learning_rate:g}) or set "
                "training.gradient_clip"
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

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """The card makes the checkpoint self-contained."""
        checkpoint["hyper_parameters"] = self.surrogate.card
