"""What is seen of a training: rollouts of the validation runs, checkpoints, TensorBoard, a progress bar."""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import lightning as L
import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor
from tqdm import tqdm

from sgns.model.dynamics import Dynamics
from sgns.model.features import BodyTrack, body_track, context_of
from sgns.numbers import elapsed
from sgns.train.windows import filled, pad_start, require_finite

if TYPE_CHECKING:
    from sgns.reduction.reduce import ReducedRun
    from sgns.train.lightning_module import SurrogateTraining, TrainingSettings

log = logging.getLogger(__name__)


# --- How well dynamics follow the validation runs, all at once: what every kind of model is chosen by -----
# Letters: B runs, T frames of the longest run, d history positions, r modes.


class RolloutScore(NamedTuple):
    """Errors of rollouts over all runs, the history left out.

    Attributes:
        skill: 1 - sum of squared position errors / that of a soil that stays as it is after d true frames
            [1].
        skill_at_rest: The same when only the start at rest is given [1].
        force_nrmse: RMS of the force error's length / RMS of the force's length [1].
        force_nrmse_at_rest: The same when only the start at rest is given [1].
        body_rmse: RMS distance between predicted and true body nodes [m]; 0 for a prescribed body.
        force: Predicted from d true frames [N], shape (B, T, 3), zero in the history.
    """

    skill: float
    skill_at_rest: float
    force_nrmse: float
    force_nrmse_at_rest: float
    body_rmse: float
    force: Tensor


class ValidationRollouts:
    """Runs to be rolled out side by side; shorter ones are filled up with their last frame, which is not counted.

    `context` are the keys of the scene whose numbers the dynamics are told.
    """

    def __init__(
        self,
        runs: Sequence[ReducedRun],
        num_modes: int,
        history: int,
        body_nodes: str,
        context: Sequence[str] = (),
    ) -> None:
        for run in runs:
            require_finite(run)
        self.names = [run.name for run in runs]
        self.lengths = [len(run.latent) for run in runs]
        longest = max(self.lengths)

        def stacked(parts: Sequence[np.ndarray | Tensor]) -> Tensor:
            full = [torch.as_tensor(part) for part in parts]
            return torch.stack([torch.cat([p, p[-1:].expand(longest - len(p), *p.shape[1:])]) for p in full])

        self.latent = stacked([run.latent[:, :num_modes] for run in runs])
        self.force = stacked([run.force for run in runs])
        tracks = [body_track(run.pose, run.body_points, body_nodes) for run in runs]
        self.body = BodyTrack(*(stacked(filled(parts)) for parts in zip(*tracks, strict=True)))
        self.nodes = torch.tensor([track.position.shape[1] for track in tracks])
        self.context = torch.as_tensor(np.stack([context_of(run.scene, context) for run in runs]))
        self.history = history
        frame = torch.arange(longest)
        self.counted = (frame < torch.tensor(self.lengths)[:, None]) & (frame >= history)
        # The same runs preceded by copies of frame 0: a bed at rest.
        self.padding = history - 1
        self.body_at_rest = BodyTrack(
            *(torch.stack([pad_start(one, self.padding) for one in part]) for part in self.body)
        )

    def measure(self, dynamics: Dynamics) -> RolloutScore:
        """Roll every run out twice, from d true frames and from rest."""
        device = next(dynamics.parameters()).device
        given, start = self.latent[:, : self.history], self.latent[:, :1].expand(-1, self.history, -1, -1)
        with torch.inference_mode():
            latent, force, body = self.rolled(dynamics, given, self.body, device)
            at_rest, force_at_rest, _ = self.rolled(dynamics, start, self.body_at_rest, device)
            at_rest, force_at_rest = at_rest[:, self.padding :], force_at_rest[:, self.padding :]
            frozen = self.squares(given[:, -1:] - self.latent)
            return RolloutScore(
                1 - self.squares(latent - self.latent) / frozen,
                1 - self.squares(at_rest - self.latent) / frozen,
                self.force_error(force),
                self.force_error(force_at_rest),
                self.body_error(body) if dynamics.predicts_body else 0.0,
                force,
            )

    def squares(self, error: Tensor) -> float:
        """Sum over runs of the mean square over a run's counted frames; infinite where a rollout is not
        finite."""
        per_frame = error.square().sum((-1, -2))
        per_run = torch.where(self.counted, per_frame, 0.0).sum(1) / self.counted.sum(1).clamp_min(1)
        total = float(per_run.sum())
        return max(total, 1e-30) if np.isfinite(total) else float("inf")

    def force_error(self, force: Tensor) -> float:
        """NRMSE of the force vector over all counted frames of all runs."""
        error, truth = (
            float(torch.where(self.counted, part.square().sum(-1), 0.0).sum())
            for part in (force - self.force, self.force)
        )
        return (error / max(truth, 1e-30)) ** 0.5 if np.isfinite(error) else float("inf")

    def body_error(self, body: BodyTrack) -> float:
        """RMS distance of body nodes from where they are in truth, over all counted frames [m]."""
        squares = (body.position - self.body.position).square().sum(-1).nanmean(-1)
        error = float(torch.where(self.counted, squares, 0.0).sum() / self.counted.sum())
        return error**0.5 if np.isfinite(error) else float("inf")

    def rolled(
        self, dynamics: Dynamics, latent: Tensor, body: BodyTrack, device: torch.device
    ) -> tuple[Tensor, Tensor, BodyTrack]:
        """Latent positions [m], force [N] and body of an unrolling, computed on `device`, returned on the CPU."""
        found = BodyTrack(*(part.clone() for part in body))
        states = torch.empty(*body.position.shape[:2], *latent.shape[2:], dtype=latent.dtype)
        force = torch.empty(*body.position.shape[:2], 3, dtype=latent.dtype)
        for count in self.nodes.unique():
            of = torch.nonzero(self.nodes == count)[:, 0]
            track = BodyTrack(*(part[of][:, :, :count].to(device) for part in body))
            path = dynamics.unroll(latent[of].to(device), track, self.context[of].to(device))
            states[of], force[of] = path.latent.cpu(), path.force.cpu()
            found.position[of, :, :count] = path.body.position.cpu()
        return states, force, found


# --- On the way: rollouts of the validation runs, checkpoints, TensorBoard, a progress bar -----------------


class RolloutValidation(L.Callback):
    """Roll the validation runs out now and then; keep the best checkpoint and the last.

    One-step errors say little (inertia alone is nearly right), so a checkpoint is judged by whole rollouts.
    It is done between steps instead of in Lightning's validation loop, so that the last step is always judged
    and saved.

    `output` is the folder of best.ckpt and last.ckpt.
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
        self, trainer: L.Trainer, pl_module: SurrogateTraining, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
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
    """A bar over all optimisation steps, only at a terminal."""

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
    """Force on the tool along the first validation runs, true and predicted: draft -F_x and vertical F_z [N] over
    frames."""
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
