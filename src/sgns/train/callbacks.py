"""What Lightning's trainer does between steps: rollouts of the validation runs, checkpoints, TensorBoard, a bar."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lightning as L
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from tqdm import tqdm

from sgns.config import UserError
from sgns.model.checkpoint import Surrogate
from sgns.numbers import elapsed
from sgns.train.validation import ValidationRollouts, force_figure

if TYPE_CHECKING:
    from sgns.settings import TrainingSettings

log = logging.getLogger(__name__)


class RolloutValidation(L.Callback):
    """Roll the validation runs out now and then; keep the best checkpoint and the last.

    One-step errors say little (inertia alone is nearly right), so a checkpoint is judged by whole rollouts.
    Lightning's `ModelCheckpoint` and validation loop go by epochs and batches: here the last step, too, is always
    judged and saved.

    `output` is the folder of best.ckpt and last.ckpt.
    """

    def __init__(
        self, surrogate: Surrogate, rollouts: ValidationRollouts, output: Path, settings: TrainingSettings
    ) -> None:
        self.surrogate = surrogate
        self.rollouts = rollouts
        self.output = output
        self.settings = settings
        self.best = -float("inf")
        self._mark: tuple[int, float] | None = None

    def state_dict(self) -> dict[str, Any]:
        """The best skill so far, so that a resumed training does not overwrite a better checkpoint."""
        return {"best": self.best}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """See `state_dict`."""
        self.best = float(state_dict["best"])

    def on_train_batch_end(self, trainer: L.Trainer, *_: Any) -> None:
        """Log speed and learning rate, validate when it is time."""
        step = trainer.global_step
        if self._mark is None:
            self._mark = (step, time.perf_counter())
        elif step % self.settings.log_every == 0:
            before, then = self._mark
            now = time.perf_counter()
            rate = (step - before) * self.settings.batch_size / elapsed(then, now)
            self._mark = (step, now)
            current = trainer.optimizers[0].param_groups[0]["lr"]
            logger_of(trainer).log_metrics({"samples_per_s": rate, "learning_rate": current}, step)
        if step % self.settings.validate_every == 0 or step == self.settings.max_steps:
            paused = time.perf_counter()
            self.validate(trainer, step)
            self._mark = (self._mark[0], self._mark[1] + elapsed(paused, time.perf_counter()))

    def validate(self, trainer: L.Trainer, step: int) -> None:
        """Measure, log, save."""
        self.require_finite_weights(step)
        trainer.lightning_module.eval()
        score = self.rollouts.measure(self.surrogate.dynamics)
        trainer.lightning_module.train()
        logger = logger_of(trainer)
        logger.log_metrics(
            {
                "skill/validation": score.skill,
                "skill/validation_at_rest": score.skill_at_rest,
                "skill/validation_in_subspace": score.skill_in_subspace,
                "force_nrmse/validation": score.force_nrmse,
                "force_nrmse/validation_at_rest": score.force_nrmse_at_rest,
            },
            step,
        )
        logger.experiment.add_figure("force/validation", force_figure(self.rollouts, score), step)
        losses = ", ".join(
            f"{k} {float(trainer.callback_metrics[f'loss/{k}']):.3g}" for k in ("change", "force")
        )
        steps = self.settings.max_steps
        log.info("step %d of %d: loss %s; validation: %s", step, steps, losses, score.words())
        if score.skill > self.best or not (self.output / "best.ckpt").exists():
            self.best = score.skill
            trainer.save_checkpoint(self.output / "best.ckpt")
        trainer.save_checkpoint(self.output / "last.ckpt")

    def require_finite_weights(self, step: int) -> None:
        """For before a checkpoint is written: the one of before is worth more than one that is not finite."""
        for name, weight in self.surrogate.named_parameters():
            if not bool(torch.isfinite(weight).all()):
                raise UserError(
                    f"the weights {name} are not finite after step {step}; likely the learning rate is too high: lower "
                    f"training.learning_rate (now {self.settings.learning_rate:g})"
                )


class StepProgress(L.Callback):
    """Moves a bar over all optimisation steps on; Lightning's own goes by epochs."""

    def __init__(self, bar: tqdm) -> None:
        self.bar = bar

    def on_train_start(self, trainer: L.Trainer, *_: Any) -> None:
        """Where a resumed training stands."""
        self.bar.initial = self.bar.n = trainer.global_step

    def on_train_batch_end(self, *_: Any) -> None:
        """One step further."""
        self.bar.update()


def logger_of(trainer: L.Trainer) -> TensorBoardLogger:
    """The trainer's logger; every training of ours has this one."""
    assert isinstance(trainer.logger, TensorBoardLogger)
    return trainer.logger


@contextmanager
def quiet_writer() -> Iterator[None]:
    """Full disks without a traceback of TensorBoard's thread: it passes the error on to the training, which says it."""
    before = threading.excepthook

    def hook(failed: threading.ExceptHookArgs) -> None:
        if not isinstance(failed.exc_value, OSError):
            before(failed)

    threading.excepthook = hook
    try:
        yield
    finally:
        threading.excepthook = before
