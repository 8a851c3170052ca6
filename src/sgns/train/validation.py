"""How well dynamics follow the validation runs, all at once: what every kind of model is chosen by.

The error of the positions counts in full space, as in the report: with orthonormal modes it is that in the subspace
plus what the modes leave out, which no training changes; a closure's error follows from that in the subspace. So within
a training both choose the same checkpoint; between numbers of modes only the total is fair.

Letters: B runs, T frames of the longest run, d history positions, r modes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from sgns.model.dynamics import Dynamics, fitted_band
from sgns.model.features import BodyTrack, body_track, context_of
from sgns.reduction.basis import left_out, outside
from sgns.train.windows import filled, require_finite

if TYPE_CHECKING:
    from sgns.reduction.basis import Basis
    from sgns.reduction.closure import Closure
    from sgns.reduction.reduce import ReducedRun


import logging
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lightning as L
from lightning.pytorch.loggers import TensorBoardLogger
from tqdm import tqdm

from sgns.config import UserError
from sgns.model.checkpoint import Surrogate
from sgns.numbers import duration_words, elapsed

if TYPE_CHECKING:
    from sgns.settings import TrainingSettings


class RolloutScore(NamedTuple):
    """Errors of rollouts over all runs, the history left out; from d true frames, or from the start at rest alone."""

    skill: float
    """1 - sum of squared position errors / that of a soil that stays as it is after d true frames [1]."""
    skill_at_rest: float
    skill_in_subspace: float  # the same of the modes only
    # RMS per axis [m]; NaN where only modes are known: then `skill` is that in the subspace
    position_rmse: float
    still_rmse: float  # the same of a soil that stays as it is after d true frames
    force_nrmse: float  # RMS of the force error's length / RMS of the force's length [1]
    mean_force_nrmse: float  # the same of the training runs' mean force
    force_nrmse_at_rest: float
    body_rmse: float  # RMS distance between predicted and true body nodes [m]; 0 for a prescribed body
    latent: Tensor  # predicted from d true frames [m], shape (B, T, r, 3)
    force: Tensor  # likewise [N], shape (B, T, 3), zero in the history
    band: list[float] | None  # of several members, see `Dynamics`; the rest is of their mean

    @property
    def errors(self) -> tuple[float, float, float, float]:
        """Of the soil [m] and of soil that stays as it is, of the force [NRMSE] and of the mean force."""
        return self.position_rmse, self.still_rmse, self.force_nrmse, self.mean_force_nrmse

    def words(self) -> str:
        """The main numbers."""
        if not math.isnan(self.position_rmse):
            soil = f"soil error {1e3 * self.position_rmse:.3g} mm"
        else:
            soil = f"soil in the modes {self.skill:.3f} (1: perfect, 0: as if nothing moved)"
        return f"{soil}, force NRMSE {self.force_nrmse:.3f}"


class ValidationRollouts:
    """Runs to be rolled out side by side; shorter ones are filled up with their last frame, which is not counted.

    `context` are the keys of the scene whose numbers the dynamics are told. Without the `basis`, or where there are no
    particles, errors are those in the subspace.
    """

    def __init__(
        self,
        runs: Sequence[ReducedRun],
        num_modes: int,
        history: int,
        body_nodes: str,
        context: Sequence[str] = (),
        basis: Basis | None = None,
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
        # Of the positions and of their way since the history's end, what the modes do not see (see `squares`) [m^2].
        self.unseen, self.unseen_way = 0.0, 0.0
        self.coordinates = math.nan  # 3 n
        self.basis: Basis | None = None  # where there are particles
        self.closure: Closure | None = None
        paths = [run.path for run in runs if run.path is not None]
        packed = [(run.latent[:, num_modes:], run.unseen) for run in runs if run.unseen is not None]
        if basis is not None and len(runs) in (len(paths), len(packed)):
            kept, last = basis.sliced(num_modes), [min(history, length) - 1 for length in self.lengths]
            if packed:
                each = [outside(*one) for one in packed]
            else:
                each = [left_out(*one) for one in zip(paths, [kept] * len(paths), last, strict=True)]
            parts = zip(*each, strict=True)
            self.unseen, self.unseen_way = (
                self.squares(stacked(part)[..., None, None].sqrt()) for part in parts
            )
            self.coordinates, self.basis = 3.0 * basis.num_particles, basis
            if closure := basis.closure:
                end = num_modes + closure.num_modes
                self.closure, self.beyond = closure, stacked([run.latent[:, num_modes:end] for run in runs])
        # The same runs preceded by copies of frame 0: a bed at rest.
        self.padding = history - 1
        self.body_at_rest = BodyTrack(
            *(torch.cat([part[:, :1].expand(-1, self.padding, -1, -1), part], dim=1) for part in self.body)
        )

    def measure(self, dynamics: Dynamics) -> RolloutScore:
        """Roll every run out twice, from d true frames and from rest."""
        given, start = self.latent[:, : self.history], self.latent[:, :1].expand(-1, self.history, -1, -1)
        with torch.inference_mode():
            each = self.rolled(dynamics, given, self.body)
            band = self.fitted_band(*each[:2]) if dynamics.members > 1 else None
            latent, force, body = (part.mean(0) for part in each)
            at_rest, force_at_rest, _ = (
                part.mean(0) for part in self.rolled(dynamics, start, self.body_at_rest)
            )
            at_rest, force_at_rest = at_rest[:, self.padding :], force_at_rest[:, self.padding :]
            frozen, error, error_at_rest = (
                self.squares(part - self.latent) for part in (given[:, -1:], latent, at_rest)
            )
            all_frozen = frozen + self.unseen_way
            error_of_all, at_rest_of_all = error + self.missed(latent), error_at_rest + self.missed(at_rest)
            entries = len(self.names) * self.coordinates
            mean_force = dynamics.force.mean.to(self.force).expand_as(self.force)
            return RolloutScore(
                1 - error_of_all / all_frozen,
                1 - at_rest_of_all / all_frozen,
                1 - error / frozen,
                (error_of_all / entries) ** 0.5,
                (all_frozen / entries) ** 0.5,
                self.force_error(force),
                self.force_error(mean_force),
                self.force_error(force_at_rest),
                self.body_error(body) if dynamics.predicts_body else 0.0,
                latent,
                force,
                band,
            )

    def fitted_band(self, latent: Tensor, force: Tensor) -> list[float]:
        """The band of members' rollouts (m, B, T, ...), see `Dynamics`."""
        pairs = [(force[..., axis], self.force[..., axis]) for axis in range(3)] + [(latent, self.latent)]
        counted = self.counted.numpy()
        return [fitted_band(each.numpy()[:, counted], truth.numpy()[counted]) for each, truth in pairs]

    def missed(self, latent: Tensor) -> float:
        """As `squares`, what the modes do not see and the closure of these latent positions does not get right."""
        if self.closure is None:
            return self.unseen
        error = self.squares(self.closure.coordinates(latent) - self.beyond)
        return self.unseen - self.squares(self.beyond) + error

    def squares(self, error: Tensor) -> float:
        """Sum over runs of the mean square over a run's counted frames; infinite where a rollout is not finite."""
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

    def body_error(self, position: Tensor) -> float:
        """RMS distance of body nodes from where they are in truth, over all counted frames [m]."""
        squares = (position - self.body.position).square().sum(-1).nanmean(-1)
        error = float(torch.where(self.counted, squares, 0.0).sum() / self.counted.sum())
        return error**0.5 if np.isfinite(error) else float("inf")

    def rolled(self, dynamics: Dynamics, latent: Tensor, body: BodyTrack) -> tuple[Tensor, Tensor, Tensor]:
        """Latent positions [m], force [N] and body's positions [m] of an unrolling by each member, (m, B, T, ...),
        computed where the dynamics are, on the CPU."""
        device, members = next(dynamics.parameters()).device, dynamics.members
        size = members, *body.position.shape[:2]
        position = body.position.expand(members, -1, -1, -1, -1).clone()
        states = torch.empty(*size, *latent.shape[2:], dtype=latent.dtype)
        force = torch.empty(*size, 3, dtype=latent.dtype)
        for count in self.nodes.unique():
            of = torch.nonzero(self.nodes == count)[:, 0]
            of_all = of.repeat(members)
            track = BodyTrack(*(part[of_all][:, :, :count].to(device) for part in body))
            path = dynamics.unroll(latent[of_all].to(device), track, self.context[of_all].to(device))
            states[:, of], force[:, of], position[:, of, :, :count] = (
                part.cpu().unflatten(0, (members, -1))
                for part in (path.latent, path.force, path.body.position)
            )
        return states, force, position


def force_figure(rollouts: ValidationRollouts, score: RolloutScore, most: int = 4) -> Figure:
    """Force on the tool along the first validation runs, true and predicted: draft -F_x and vertical F_z [N] over
    frames."""
    count = min(most, len(rollouts.names))
    figure = Figure(figsize=(3.2 * count, 4.4), layout="constrained")
    axes = figure.subplots(2, count, sharex=True, squeeze=False)
    for column in range(count):
        shown = slice(rollouts.history, rollouts.lengths[column])
        frames = np.arange(rollouts.history, rollouts.lengths[column])
        for row, (name, axis, sign) in enumerate((("draft", 0, -1.0), ("vertical", 2, 1.0))):
            panel = axes[row, column]
            for force, colour, label in (
                (rollouts.force, "0.15", "truth"),
                (score.force, "#0072b2", "network"),
            ):
                panel.plot(frames, sign * force[column, shown, axis].numpy(), color=colour, label=label)
            if column == 0:
                panel.set_ylabel(f"{name} [N]")
        axes[0, column].set_title(rollouts.names[column], fontsize=8)
        axes[1, column].set_xlabel("frame")
    axes[0, 0].legend(frameon=False, fontsize=8)
    return figure


def soil_figure(rollouts: ValidationRollouts, score: RolloutScore) -> Figure | None:
    """The soil at the end of the first validation run, seen from the side near mid-width, in truth (as the modes hold
    it) and predicted, coloured by how far it has come [mm]; None without particles."""
    if rollouts.basis is None:
        return None
    last = rollouts.lengths[0] - 1
    start, truth, network = (
        rollouts.basis.inverse(latent).numpy()
        for latent in (rollouts.latent[0, 0], rollouts.latent[0, last], score.latent[0, last])
    )
    y = start[:, 1]
    chosen = np.abs(y - y.mean()) <= 0.15 * np.ptp(y)
    height = float(np.ptp(truth[:, 2]) / np.ptp(truth[:, 0]))
    figure = Figure(figsize=(6.4, 1.2 + 11.0 * min(height, 1.0)), layout="constrained")
    axes = figure.subplots(2, 1, sharex=True, sharey=True)
    size = float(np.clip(2e4 * height / chosen.sum(), 1.0, 40.0))
    way = [1e3 * np.linalg.norm(soil - start, axis=1)[chosen] for soil in (truth, network)]
    top = max(float(way[0].max()), 1e-3)
    for axis, soil, moved, name in zip(axes, (truth, network), way, ("truth", "network"), strict=True):
        x, _, z = soil[chosen].T
        dots = axis.scatter(x, z, s=size, c=moved, cmap="viridis", vmin=0.0, vmax=top, linewidths=0)
        axis.set(ylabel="z [m]", aspect="equal")
        axis.set_title(f"{name}, {rollouts.names[0]}, last frame", fontsize=8)
    axes[1].set_xlabel("x [m]")
    figure.colorbar(dots, ax=axes, label="way since the start [mm]")
    return figure


# --- Between the steps of Lightning's trainer: rollouts of the validation runs, checkpoints, TensorBoard, a bar


log = logging.getLogger(__name__)


JUDGED = "judged/"
"""Group of TensorBoard's charts; these follow one another by name: pictures, judgements, losses, pace, result."""


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
            rate = (step - before) * self.settings.windows / elapsed(then, now)
            self._mark = (step, now)
            current = trainer.optimizers[0].param_groups[0]["lr"]
            logger_of(trainer).log_metrics(
                {"pace/windows per second": rate, "pace/learning rate": current}, step
            )
        if step % self.settings.validate_every == 0 or step == self.settings.max_steps:
            paused = time.perf_counter()
            self.validate(trainer, step)
            self._mark = (self._mark[0], self._mark[1] + elapsed(paused, time.perf_counter()))

    def validate(self, trainer: L.Trainer, step: int) -> None:
        """Measure, log, save; of several processes the first measures and writes, and all have to take part."""
        self.require_finite_weights(step)
        better = self.measured(trainer, step) if trainer.is_global_zero else False
        if trainer.strategy.broadcast(better):
            trainer.save_checkpoint(self.output / "best.ckpt")
        trainer.save_checkpoint(self.output / "last.ckpt")

    def measured(self, trainer: L.Trainer, step: int) -> bool:
        """Roll out and log; says whether these weights are the best so far."""
        trainer.lightning_module.eval()
        score = self.rollouts.measure(self.surrogate.dynamics)
        if score.band is not None:
            self.surrogate.dynamics.band.copy_(torch.tensor(score.band, dtype=torch.float64))
        trainer.lightning_module.train()
        logger = logger_of(trainer)
        shown = {
            "skill": score.skill,
            "skill from rest": score.skill_at_rest,
            "skill in the modes": score.skill_in_subspace,
            "force NRMSE": score.force_nrmse,
            "force NRMSE from rest": score.force_nrmse_at_rest,
            "soil error [mm]": 1e3 * score.position_rmse,
        }
        judged = {f"{JUDGED}{name}": value for name, value in shown.items() if not math.isnan(value)}
        logger.log_metrics(judged, step)
        loss = float(trainer.callback_metrics["loss/total"])
        steps = self.settings.max_steps
        log.info("step %d of %d: loss %.3g; on validation runs: %s", step, steps, loss, score.words())
        if better := score.skill > self.best or not (self.output / "best.ckpt").exists():
            self.best = score.skill
            soil = soil_figure(self.rollouts, score)
            forces = force_figure(self.rollouts, score)
            for name, figure in (("force along a path", forces), ("soil at the end", soil)):
                if figure is not None:
                    logger.experiment.add_figure(f"best checkpoint/{name}", figure, step)
        return better

    def require_finite_weights(self, step: int) -> None:
        """For before a checkpoint is written: the one of before is worth more than one that is not finite."""
        for name, weight in self.surrogate.named_parameters():
            if not bool(torch.isfinite(weight).all()):
                raise UserError(
                    f"the weights {name} are not finite after step {step}; likely the learning rate is too high: lower "
                    f"training.learning_rate (now {self.settings.learning_rate:g})"
                )


class StepProgress(L.Callback):
    """Moves a bar over all optimisation steps on, since Lightning's own goes by epochs; says once how long it takes."""

    SAID_AFTER = 10.0
    """How long steps are timed before that [s]."""

    def __init__(self, bar: tqdm) -> None:
        self.bar = bar
        self._begin: tuple[int, float] | None = None
        self._said = False

    def on_train_start(self, trainer: L.Trainer, *_: Any) -> None:
        """Where a resumed training stands."""
        self.bar.initial = self.bar.n = trainer.global_step

    def on_train_batch_end(self, trainer: L.Trainer, *_: Any) -> None:
        """One step further."""
        self.bar.update()
        step, now = trainer.global_step, time.perf_counter()
        if self._begin is None:  # the first step is slower than the others
            self._begin = step, now
        first, begin = self._begin
        if not self._said and now - begin >= self.SAID_AFTER:
            self._said = True
            rate = (step - first) / (now - begin)
            log.info(
                "%.3g steps a second: about %s more", rate, duration_words((self.bar.total - step) / rate)
            )


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
