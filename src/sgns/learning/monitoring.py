"""What is seen of a training: rollouts of the validation runs, checkpoints, TensorBoard, a progress bar."""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
from matplotlib.figure import Figure
from tqdm import tqdm

from sgns.clock import elapsed
from sgns.learning.trainee import SurrogateTraining, TrainingSettings
from sgns.learning.validation import RolloutScore, ValidationRollouts

__all__ = ["RolloutValidation", "StepProgress", "force_figure", "quiet_writer"]

log = logging.getLogger(__name__)


class RolloutValidation(L.Callback):
    """Roll the validation runs out now and then; keep the best checkpoint and the last.

    One-step errors say little (inertia alone is nearly right), so a checkpoint is judged by whole rollouts.
    It is done between steps instead of in Lightning's validation loop, so that the last step is always judged
    and saved.

    Args:
        rollouts: The validation runs.
        output: Folder of best.ckpt and last.ckpt.
        settings: `validate_every`, `log_every`, `max_steps`, `batch_size`.
    """

    def __init__(self, rollouts: ValidationRollouts, output: Path, settings: TrainingSettings) -> None:
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

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Log speed and learning rate, validate when it is time."""
        assert isinstance(pl_module, SurrogateTraining)
        step = trainer.global_step
        if self._mark is None:
            self._mark = (step, time.perf_counter())
        elif step % self.settings.log_every == 0:
            before, then = self._mark
            now = time.perf_counter()
            rate = (step - before) * self.settings.batch_size / elapsed(then, now)
            self._mark = (step, now)
            current = trainer.optimizers[0].param_groups[0]["lr"]
            trainer.logger.log_metrics({"samples_per_s": rate, "learning_rate": current}, step)
        if step % self.settings.validate_every == 0 or step == self.settings.max_steps:
            paused = time.perf_counter()
            self.validate(trainer, pl_module, step)
            self._mark = (self._mark[0], self._mark[1] + elapsed(paused, time.perf_counter()))

    def validate(self, trainer: L.Trainer, module: SurrogateTraining, step: int) -> None:
        """Measure, log, save."""
        module.require_finite_weights()
        module.eval()
        score = self.rollouts.measure(module.surrogate.dynamics)
        module.train()
        trainer.logger.log_metrics(
            {
                "skill/validation": score.skill,
                "skill/validation_at_rest": score.skill_at_rest,
                "force_nrmse/validation": score.force_nrmse,
                "force_nrmse/validation_at_rest": score.force_nrmse_at_rest,
            },
            step,
        )
        trainer.logger.experiment.add_figure("force/validation", force_figure(self.rollouts, score), step)
        losses = ", ".join(
            f"{k} {float(trainer.callback_metrics[f'loss/{k}']):.3g}" for k in ("change", "force")
        )
        log.info(
            "step %d of %d: loss %s; validation skill %.3f (from rest %.3f), force NRMSE %.3f",
            step, self.settings.max_steps, losses, score.skill, score.skill_at_rest, score.force_nrmse,
        )  # fmt: skip
        better = score.skill > self.best or not (self.output / "best.ckpt").exists()
        if better:
            self.best = score.skill
            trainer.save_checkpoint(self.output / "best.ckpt")
        trainer.save_checkpoint(self.output / "last.ckpt")


class StepProgress(L.Callback):
    """A bar over optimisation steps, only at a terminal.

    Args:
        total: Steps when complete.
    """

    def __init__(self, total: int) -> None:
        self.total = total
        self._bar: tqdm | None = None

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Open the bar where a resumed training stands."""
        self._bar = tqdm(
            total=self.total,
            initial=trainer.global_step,
            desc="training",
            unit="step",
            leave=False,
            disable=not sys.stderr.isatty(),
        )

    def on_train_batch_end(self, *_: Any) -> None:
        """One step further."""
        assert self._bar is not None
        self._bar.update()

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Close the bar."""
        self.close()

    def on_exception(
        self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException
    ) -> None:
        """Close the bar."""
        self.close()

    def close(self) -> None:
        """Leave the terminal clean."""
        if self._bar is not None:
            self._bar.close()


def force_figure(rollouts: ValidationRollouts, score: RolloutScore, most: int = 4) -> Figure:
    """Force on the tool along validation runs, true and predicted.

    Args:
        rollouts: The runs with their true force.
        score: The predicted one.
        most: How many runs to draw.

    Returns:
        The figure; draft is -F_x, vertical F_z, in newtons over frames.
    """
    count = min(most, len(rollouts.names))
    figure = Figure(figsize=(3.2 * count, 4.4), layout="constrained")
    axes = np.atleast_2d(figure.subplots(2, count, sharex=True, squeeze=False))
    for column in range(count):
        shown = slice(rollouts.history, rollouts.lengths[column])
        frames = np.arange(rollouts.lengths[column])[shown]
        for row, (name, axis, sign) in enumerate((("draft", 0, -1.0), ("vertical", 2, 1.0))):
            panel = axes[row, column]
            panel.plot(
                frames, sign * rollouts.force[column, shown, axis].numpy(), color="0.15", label="truth"
            )
            panel.plot(
                frames, sign * score.force[column, shown, axis].numpy(), color="#0072b2", label="network"
            )
            if column == 0:
                panel.set_ylabel(f"{name} [N]")
        axes[0, column].set_title(rollouts.names[column], fontsize=8)
        axes[1, column].set_xlabel("frame")
    axes[0, 0].legend(frameon=False, fontsize=8)
    return figure


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
