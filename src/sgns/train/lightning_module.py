"""How networks are trained: the loss, the optimiser and its schedule, and Lightning's trainer around them.

Letters: B batch, V nodes, r modes, h steps of the horizon.
"""

from __future__ import annotations

import logging
import math
import signal
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lightning as L
import numpy as np
import torch
from lightning.pytorch.plugins import TorchCheckpointIO
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor
from tqdm import tqdm

from sgns.config import UserError
from sgns.model.checkpoint import Surrogate, load_surrogate, read_checkpoint, write_checkpoint
from sgns.model.features import BodyTrack, moves_freely, varying_context
from sgns.model.network_dynamics import LatentDynamics
from sgns.numbers import elapsed
from sgns.settings import ModelSettings, TrainingSettings
from sgns.train import Fit, Fitted, Task
from sgns.train.validation import RolloutValidation, StepProgress, ValidationRollouts
from sgns.train.windows import Batch, TrainingWindows, WindowLoader, fit_normalisation

if TYPE_CHECKING:
    from sgns.reduction.reduce import ReducedDataset

# A training whose loss is this many times that of its first step learns no more.
_DIVERGED = 1e4
_ANEW = "train anew with training.resume=false, or into another output"
_MOMENTS = ("exp_avg", "exp_avg_sq")  # what AdamW keeps of each weight


class SurrogateTraining(L.LightningModule):
    """One optimisation step of a surrogate, all of which goes into the checkpoint."""

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
        dynamics = self.drawn_dynamics()
        modes, track = dynamics.num_modes, batch.shown_body
        latent, following = batch.history[:, :, :modes], batch.following[:, :, :modes]
        seen = track.frames(slice(0, dynamics.history))
        found: dict[str, list[Tensor]] = {name: [] for name in ("change", "force", "torque")}
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

    def drawn_dynamics(self) -> LatentDynamics:
        """The network, in some steps with a part of its modes only, so that it learns to do without the last ones."""
        dynamics = self.surrogate.dynamics
        assert isinstance(dynamics, LatentDynamics)
        if self.settings.fewer_modes == 0 or not self.training:
            return dynamics
        draw = np.random.default_rng([self.global_step, dynamics.num_modes])
        if draw.random() >= self.settings.fewer_modes:
            return dynamics
        return dynamics.with_modes(int(draw.integers(1, dynamics.num_modes + 1)))

    def training_step(self, batch: Batch, _: int) -> Tensor:
        """The weighted loss; stops the training when it is not finite or has grown beyond measure."""
        losses = self.losses(batch)
        weight = self.settings.loss
        loss = sum((getattr(weight, name) * value for name, value in losses.items()), torch.zeros(()))
        told = {name: value.detach().clone() for name, value in (losses | {"total": loss}).items()}
        if self.settings.processes > 1:
            for value in told.values():
                torch.distributed.all_reduce(value)
                value /= self.settings.processes
        total = float(told["total"])
        if self.first_loss is None:
            self.first_loss = total
        cure = (
            f"likely the learning rate is too high: lower training.learning_rate (now "
            f"{self.settings.learning_rate:g}) or training.gradient_clip (now {self.settings.gradient_clip})"
        )
        if not math.isfinite(total):
            worst = next((name for name, value in told.items() if not bool(torch.isfinite(value))), "loss")
            raise UserError(f"the {worst} loss is {total} at step {self.global_step}; {cure}")
        if total > _DIVERGED * self.first_loss > 0:
            raise UserError(
                f"the training diverges: the loss is {total:.3g} at step {self.global_step} and was "
                f"{self.first_loss:.3g} in the first; {cure}"
            )
        self.log_dict({f"loss/{name}": value for name, value in told.items()})
        return loss

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        """AdamW and a schedule by steps."""
        optimizer = torch.optim.AdamW(
            self.surrogate.parameters(),
            lr=self.settings.learning_rate,
            weight_decay=self.settings.weight_decay,
            fused=True,
        )
        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, self.settings.rate)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

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


# --- A training from its data to its best checkpoint ---------------------------------------------------------


def fit_network(task: Task) -> Fitted:
    """Train a network; best.ckpt, last.ckpt and the log appear on the way."""
    settings, model, output = task.settings, task.model, task.output
    surrogate, data = prepared(
        task.reduced, task.num_modes, model, settings, task.seed, task.card, task.start_from
    )
    context = surrogate.dynamics.context_keys
    rollouts = ValidationRollouts(
        task.validation_runs,
        task.num_modes,
        model.history,
        model.body_nodes,
        context,
        task.reduced.of_modes(task.num_modes),
    )
    module = SurrogateTraining(surrogate, settings)
    last = output / "last.ckpt" if task.resumed else None
    rank = task.environment.global_rank()
    if settings.processes > 1:  # of the windows of each member
        each = torch.arange(settings.windows).unflatten(0, (settings.members, settings.processes, -1))
        data.share = each[:, rank].flatten()
    bar = tqdm(
        total=settings.max_steps, desc="training", unit="step", leave=False, disable=True if rank else None
    )
    with bar, quiet_lightning():
        validation = RolloutValidation(surrogate, rollouts, output, settings)
        trainer = make_trainer(task, [validation, StepProgress(bar)])
        began = time.perf_counter()
        if last is not None:
            require_resumable(last, trainer, module)
        try:
            run_trainer(trainer, module, data, last)
        except UserError as error:
            if not (output / "best.ckpt").exists():
                raise
            raise UserError(
                f"{error}; the best checkpoint of before is kept, to go on from into another output: "
                f"checkpoint={output / 'best.ckpt'}"
            ) from error
        seconds = elapsed(began, time.perf_counter())
    score = rollouts.measure(load_surrogate(output / "best.ckpt").dynamics)
    return Fitted(surrogate, score, seconds, {"steps": settings.max_steps})


def prepared(
    reduced: ReducedDataset,
    num_modes: int,
    model: ModelSettings,
    settings: TrainingSettings,
    seed: int,
    card: dict[str, Any],
    start_from: str | Path | None,
) -> tuple[Surrogate, WindowLoader]:
    """The untrained surrogate with its statistics, and its data."""
    runs = reduced.runs("train")
    context = tuple(varying_context(runs, model.context))
    windows = TrainingWindows(
        runs, num_modes, model.history, model.body_nodes, seed, settings.horizon, context
    )
    dynamics = LatentDynamics(model, num_modes, context, moves_freely(runs), settings.members)
    noise = fit_normalisation(
        dynamics, windows, settings.noise, settings.noise_unit, settings.scales, settings.normalisation_floor
    )
    if start_from is not None:
        given = load_surrogate(start_from)
        other = given.dynamics
        known = (other.settings, other.context_keys, other.predicts_body, given.basis.arrangement_hash)
        wanted = (model, context, dynamics.predicts_body, reduced.basis.arrangement_hash)
        if not isinstance(other, LatentDynamics) or known != wanted:
            raise UserError(
                f"{start_from} has another model or another bed; use the same model.* and "
                "dataset, or checkpoint=null"
            )
        if other.members != settings.members:
            raise UserError(
                f"training.members is {settings.members} and {start_from} has {other.members}; use as many, or "
                "checkpoint=null"
            )
        if not given.basis.same_modes(reduced.basis.modes[:, :num_modes]):
            raise UserError(
                f"{start_from} belongs to another basis; use the dataset it was trained on, or "
                "checkpoint=null"
            )
        dynamics = other.requires_grad_(True).train()
    surrogate = Surrogate.of(dynamics, reduced, card)
    return surrogate, WindowLoader(windows, settings.windows, noise)


def require_resumable(last: Path, trainer: L.Trainer, module: SurrogateTraining) -> None:
    """Refuses a checkpoint that lacks, or has in odd shape, what a training goes on from."""
    load_surrogate(last)
    content = read_checkpoint(last)
    fresh: Any = module.configure_optimizers()
    weights = fresh["optimizer"].param_groups[0]["params"]
    try:
        (optimizer,), (schedule,) = content["optimizer_states"], content["lr_schedulers"]
        step = content["global_step"]
        done = content["loops"]["fit_loop"]["epoch_loop.automatic_optimization.optim_progress"]
        steps = module.settings.max_steps
        if type(step) is not int or not 0 <= step <= steps:
            raise ValueError(f"global_step is {step!r:.40}, of {steps} steps")
        if done["optimizer"]["step"]["total"]["completed"] != step:
            raise ValueError("it disagrees with itself about its steps")
        require_alike(content["loops"]["fit_loop"], trainer.fit_loop.state_dict(), "loops")
        require_alike(optimizer["param_groups"], fresh["optimizer"].state_dict()["param_groups"], "optimiser")
        require_alike(schedule, fresh["lr_scheduler"]["scheduler"].state_dict(), "schedule")
        if not set(optimizer["state"]) <= set(range(len(weights))) or (step and not optimizer["state"]):
            raise ValueError("the optimiser knows other weights")
        for index, state in optimizer["state"].items():
            for key, shape in (("step", ()), *((key, weights[index].shape) for key in _MOMENTS)):
                if tuple(state[key].shape) != tuple(shape) or not bool(state[key].isfinite().all()):
                    raise ValueError(f"{key} of weights {index} is not finite or has another shape")
        for key, value in (
            ("first_loss", content.get("first_loss")),
            ("best skill", content["callbacks"]["RolloutValidation"]["best"]),
        ):
            if value is not None and type(value) not in (int, float):
                raise ValueError(f"{key} is {value!r:.40}")
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        reason = f"{error} is missing" if isinstance(error, KeyError) else error
        raise UserError(f"{last} cannot be gone on from ({reason}); {_ANEW}") from error


def require_alike(given: Any, fresh: Any, where: str) -> None:
    """Refuses plain values of another kind than fresh ones, by a ValueError that says where."""
    if isinstance(fresh, (float, int)) and not isinstance(fresh, bool):
        if isinstance(given, bool) or not isinstance(given, (float, int)) or not math.isfinite(given):
            raise ValueError(f"{where} is {given!r:.40}, not a finite number")
    elif type(given) is not type(fresh):
        raise ValueError(f"{where} is a {type(given).__name__}, not a {type(fresh).__name__}")
    elif isinstance(fresh, dict):
        for key in fresh.keys() & given.keys():
            require_alike(given[key], fresh[key], f"{where}.{key}")
    elif isinstance(fresh, (list, tuple)):
        if len(given) != len(fresh):
            raise ValueError(f"{where} has {len(given)} entries, not {len(fresh)}")
        for one, other in zip(given, fresh, strict=True):
            require_alike(one, other, where)


class WholeCheckpoints(TorchCheckpointIO):
    """Lightning's way of writing checkpoints, but none is ever seen half-written.

    Its own writes to the machine's folder for temporary files and moves that, which is a copy where the results are on
    another disk.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Write it whole."""
        write_checkpoint(checkpoint, Path(path))


def make_trainer(task: Task, callbacks: list[L.Callback]) -> L.Trainer:
    """Lightning's trainer: by steps, no validation loop of its own (see `RolloutValidation`)."""
    settings, device, clip = task.settings, task.device, task.settings.gradient_clip
    if device not in ("cpu", "cuda"):
        raise UserError(f"device is {device!r}; allowed: cpu, cuda")
    if device == "cuda" and not torch.cuda.is_available():
        raise UserError("device is cuda but torch finds no CUDA device; use device=cpu")
    return L.Trainer(
        accelerator="gpu" if device == "cuda" else "cpu",
        devices=settings.devices,
        num_nodes=settings.nodes,
        strategy=settings.strategy if settings.processes > 1 else "auto",
        max_steps=settings.max_steps,
        max_epochs=-1,
        logger=task.logger,
        callbacks=callbacks,
        log_every_n_steps=settings.log_every,
        # The loss is a mean over members: its gradient's norm is that of one member's over √members.
        gradient_clip_val=clip and clip / math.sqrt(settings.members),
        num_sanity_val_steps=0,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        plugins=[WholeCheckpoints(), task.environment],
    )


@contextmanager
def quiet_lightning() -> Iterator[None]:
    """Hides what Lightning tells of itself (devices, tips, that it stopped when it should) and warnings that do not
    concern us."""
    logger = logging.getLogger("lightning.pytorch")
    before = logger.level
    logger.setLevel(logging.WARNING)
    try:
        with warnings.catch_warnings():
            # Everything is in memory: there is nothing for worker processes to do.
            warnings.filterwarnings("ignore", ".*does not have many workers.*")
            warnings.filterwarnings("ignore", ".*GPU available but not used.*")
            # Lightning's own use of torch, not ours.
            warnings.filterwarnings("ignore", ".*isinstance.treespec, LeafSpec.*")
            yield
    finally:
        logger.setLevel(before)


def run_trainer(trainer: L.Trainer, module: SurrogateTraining, data: WindowLoader, last: Path | None) -> None:
    """Run the trainer; an interruption stays one."""
    in_main_thread = threading.current_thread() is threading.main_thread()
    handler = signal.getsignal(signal.SIGINT) if in_main_thread else None
    data.trainer = trainer
    try:
        trainer.fit(module, data, ckpt_path=None if last is None else str(last), weights_only=True)
    except SystemExit as error:
        # Lightning turns Ctrl-C into an exit of its own.
        interruption = error.__context__
        raise (interruption if isinstance(interruption, KeyboardInterrupt) else KeyboardInterrupt()) from None
    except Exception as error:
        if last is None or module.begun or isinstance(error, UserError):
            raise
        reason = " ".join(str(error).split()) or type(error).__name__
        raise UserError(f"{last} cannot be gone on from ({reason:.200}); {_ANEW}") from error
    finally:
        if handler is not None:
            signal.signal(signal.SIGINT, handler)


NETWORK = Fit(slice(4), "the checkpoint is chosen by rollouts of training runs", fit_network)
