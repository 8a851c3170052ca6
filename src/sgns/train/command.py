"""`sgns train`: fit the latent dynamics to a dataset's reduced runs.

`output` holds `best.ckpt` (highest validation skill), of a network `last.ckpt` (to go on from), `tensorboard/` and,
once complete, `training.json`. The same command with the same `output` goes on where it stopped, or answers from
what is there.
"""

from __future__ import annotations

import json
import logging
import math
import shutil
import signal
import threading
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lightning as L
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.plugins import TorchCheckpointIO
from omegaconf import OmegaConf

import sgns
from mpm_warp.poses import in_body_frame
from sgns.clock import elapsed
from sgns.config import UserError, differences, flattened
from sgns.data.files import only_here, require_replaceable, write_whole
from sgns.evaluate.metrics import is_wheel
from sgns.model.checkpoint import (
    SUMMARY,
    Surrogate,
    load_surrogate,
    read_checkpoint,
    read_summary,
    write_checkpoint,
)
from sgns.model.dynamics import Dynamics
from sgns.model.features import slowest_travel, varying_context
from sgns.model.network_dynamics import LatentDynamics
from sgns.model.settings import FitSettings, ModelSettings, PolynomialSettings, model_settings
from sgns.model.training_range import TrainingRange
from sgns.reduction.reduce import ReducedDataset, ReducedRun, reduce_dataset
from sgns.train.callbacks import RolloutValidation, StepProgress, ValidationRollouts, quiet_writer
from sgns.train.lightning_module import SurrogateTraining, TrainingSettings
from sgns.train.polynomial import check_start, fit_polynomial
from sgns.train.windows import TrainingWindows, WindowDataModule, fit_normalisation

if TYPE_CHECKING:
    from omegaconf import DictConfig

log = logging.getLogger(__name__)


# Settings that change speed or reporting, not the result.
_NO_MATTER = ("threads", "log_every", "resume")
_ANEW = "train anew with training.resume=false, or into another output"
_MOMENTS = ("exp_avg", "exp_avg_sq")  # what AdamW keeps of each weight


def main(cfg: DictConfig) -> float:
    """The `sgns train` command; returns the rollout skill on the validation runs."""
    from sgns.data.dataset import Dataset
    from sgns.data.published import published_dataset

    plain = OmegaConf.to_container(cfg, resolve=True)
    _, settings = checked_settings(plain["model"], plain["training"])
    if settings.threads is not None:
        torch.set_num_threads(settings.threads)  # for the reduction, too
    output = Path(cfg.output)
    with only_here(output / "best.ckpt"):
        pass  # who cannot have it shall not wait for the reduction to hear so
    if cfg.dataset.get("format") == "published":
        reduced = published_dataset(plain["dataset"], cfg.reduction.num_modes)
    else:
        dataset = Dataset.open(cfg.dataset.path, cfg.dataset.get("where"))
        reduced = reduce_dataset(dataset, cfg.reduction, device=cfg.device)
    return train(
        reduced,
        num_modes=reduced.num_modes,
        model=plain["model"],
        training=plain["training"],
        output=output,
        seed=cfg.seed,
        device=cfg.device,
        start_from=cfg.checkpoint,
        provenance={"preset": plain["preset"]["name"], "dataset": plain["dataset"]["name"]},
    )


@quiet_writer()
def train(
    reduced: ReducedDataset,
    *,
    num_modes: int,
    model: Mapping[str, Any],
    training: Mapping[str, Any],
    output: Path,
    seed: int = 0,
    device: str = "cpu",
    start_from: str | Path | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> float:
    """Train, or go on training, or take what is complete.

    Args:
        reduced: The dataset in its basis.
        num_modes: r, modes used of the basis.
        model: Values of `conf/model`.
        training: Values of `conf/training`.
        output: Folder for checkpoints and logs.
        seed: Of weights, noise and order.
        device: "cpu" or "cuda"; polynomials know the first only.
        start_from: Checkpoint whose weights and normalisation a network starts from.
        provenance: More plain values for the checkpoint.

    Returns:
        Skill of the best checkpoint's rollouts on the validation runs.

    Raises:
        UserError: Bad settings, a loss that is not finite, or an `output` of another training, there or under way.
    """
    model_settings, settings = checked_settings(model, training)
    if settings.threads is not None:
        torch.set_num_threads(settings.threads)
    validation_runs = reduced.runs("validation") or stand_ins(reduced.runs("train"), model_settings.kind)
    card = {
        "settings": {
            "num_modes": num_modes,
            "model": model_settings.to_dict(),
            "training": {k: v for k, v in settings.to_dict().items() if k not in _NO_MATTER},
            "seed": seed,
            "basis": reduced.folder.name,
            "validation_runs": [run.name for run in validation_runs],
            "start_from": None if start_from is None else str(start_from),
            **(provenance or {}),
        },
        "frame_rate": float(reduced.frame_rate),
        "scene": reduced.runs("train")[0].scene,
        "package_version": sgns.__version__,
    }
    with only_here(output / "best.ckpt"):
        resumed = what_is_there(output, card["settings"], settings.resume)
        if resumed == "complete":
            summary = read_summary(output)
            log.info("%s is complete: validation skill %.3f", output, summary["skill"])
            return float(summary["skill"])

        torch.manual_seed(seed)
        logger = TensorBoardLogger(output, name="", version="tensorboard", default_hp_metric=False)
        if isinstance(settings, FitSettings):
            check_start(start_from, device)
            runs = reduced.runs("train")
            began = time.perf_counter()
            fitted = fit_polynomial(
                runs, validation_runs, num_modes, model_settings, settings, moves_freely(runs), seed
            )
            seconds = elapsed(began, time.perf_counter())
            surrogate = surrogate_of(fitted.dynamics, reduced, card)
            score, about = fitted.score, fitted.about()
            make_folder(output)
            surrogate.save(output / "best.ckpt")
        else:
            surrogate, data = prepared(reduced, num_modes, model_settings, settings, seed, card, start_from)
            rollouts = ValidationRollouts(
                validation_runs,
                num_modes,
                model_settings.history,
                model_settings.body_nodes,
                surrogate.dynamics.context_keys,
            )
            callbacks = [RolloutValidation(rollouts, output, settings), StepProgress(settings.max_steps)]
            module = SurrogateTraining(surrogate, settings)
            with quiet_lightning():
                trainer = make_trainer(output, settings, device, callbacks, logger)
                began = time.perf_counter()
                last = output / "last.ckpt" if resumed else None
                if last is not None:
                    require_resumable(last, trainer, module, settings)
                try:
                    fit(trainer, module, data, last)
                except UserError as error:
                    if not (output / "best.ckpt").exists():
                        raise
                    raise UserError(
                        f"{error}; the best checkpoint of before is kept, to go on from into another output: "
                        f"checkpoint={output / 'best.ckpt'}"
                    ) from error
                seconds = elapsed(began, time.perf_counter())
            score = rollouts.measure(load_surrogate(output / "best.ckpt").dynamics)
            about = {"steps": settings.max_steps}

        metrics = {
            "skill": score.skill,
            "skill_at_rest": score.skill_at_rest,
            "force_nrmse": score.force_nrmse,
        }
        if surrogate.dynamics.predicts_body:
            metrics["body_rmse"] = score.body_rmse
        logger.log_hyperparams(
            hyperparameters(card["settings"]), {f"final/{key}": value for key, value in metrics.items()}
        )
        logger.finalize("success")
        summary = {**about, **metrics, "seconds": round(seconds, 1)}
        write_whole(output / SUMMARY, json.dumps(summary, indent=2) + "\n")
        log.info(
            "trained in %.0f s; %d validation runs: skill %.3f (from rest %.3f), force NRMSE %.3f; %s",
            seconds,
            len(validation_runs),
            score.skill,
            score.skill_at_rest,
            score.force_nrmse,
            output / "best.ckpt",
        )
        return score.skill


def hyperparameters(settings: Mapping[str, Any]) -> dict[str, bool | int | float | str]:
    """Settings as TensorBoard's HParams tab takes them: one level, scalars or text."""
    return {
        key: value if isinstance(value, (bool, int, float, str)) else str(value)
        for key, value in flattened(settings).items()
    }


def checked_settings(
    model: Mapping[str, Any], training: Mapping[str, Any]
) -> tuple[ModelSettings, TrainingSettings] | tuple[PolynomialSettings, FitSettings]:
    """Of the kind that `model.kind` says; refuses those of another."""
    settings = model_settings(model)
    if isinstance(settings, PolynomialSettings):
        return settings, FitSettings.from_dict(training)
    return settings, TrainingSettings.from_dict(training)


def stand_ins(runs: list[ReducedRun], kind: str) -> list[ReducedRun]:
    """Training runs that do what validation runs would."""
    if kind == "polynomial":
        log.warning("the validation split is empty; every third training run chooses noise and penalty")
        return runs[::3]
    log.warning("the validation split is empty; the checkpoint is chosen by rollouts of training runs")
    return runs[:4]


def surrogate_of(dynamics: Dynamics, reduced: ReducedDataset, card: dict[str, Any]) -> Surrogate:
    """Dynamics with the basis, the start and the body points of a dataset."""
    first = reduced.runs("train")[0]
    points = torch.as_tensor(in_body_frame(first.pose[0], first.body_points[0]))
    basis = reduced.basis.sliced(dynamics.num_modes)
    sees_points = dynamics.settings.body_nodes == "points"
    known = TrainingRange.of(reduced.runs("train"), dynamics.num_modes, dynamics.context_keys, sees_points)
    covered = {
        "training_range": known.plain(),
        "slowest_travel": slowest_travel(reduced.runs("train")),
    }
    start = torch.as_tensor(reduced.start_positions)
    return Surrogate(dynamics, basis, start, points, card | covered)


def prepared(
    reduced: ReducedDataset,
    num_modes: int,
    model: ModelSettings,
    settings: TrainingSettings,
    seed: int,
    card: dict[str, Any],
    start_from: str | Path | None,
) -> tuple[Surrogate, WindowDataModule]:
    """The untrained surrogate with its statistics, and its data."""
    runs = reduced.runs("train")
    context = tuple(varying_context(runs, model.context))
    windows = TrainingWindows(
        runs, num_modes, model.history, model.body_nodes, seed, settings.horizon, context
    )
    dynamics = LatentDynamics(model, num_modes, context, moves_freely(runs))
    noise = fit_normalisation(
        dynamics, windows, settings.noise, settings.noise_unit, settings.scales, settings.normalisation_floor
    )
    if start_from is not None:
        given = load_surrogate(start_from)
        other = given.dynamics
        known = (other.settings, other.context_keys, other.predicts_body, given.basis.arrangement_hash)
        if known != (model, context, dynamics.predicts_body, reduced.arrangement_hash):
            raise UserError(
                f"{start_from} has another model or another bed; use the same model.* and "
                "dataset, or checkpoint=null"
            )
        if not torch.equal(given.basis.modes, reduced.basis.modes[:, :num_modes]):
            raise UserError(
                f"{start_from} belongs to another basis; use the dataset it was trained on, or "
                "checkpoint=null"
            )
        dynamics = given.dynamics.requires_grad_(True).train()
    surrogate = surrogate_of(dynamics, reduced, card)
    return surrogate, WindowDataModule(windows, settings.batch_size, noise)


def moves_freely(runs: Sequence[ReducedRun]) -> bool:
    """Whether the body moves as the soil lets it, which only a wheel's axle does; refuses a mixture."""
    free = {is_wheel(run.scene) for run in runs}
    if len(free) > 1:
        raise UserError(
            "the training runs mix wheels, whose height is predicted, with bodies whose motion is prescribed; keep one "
            "dataset for each"
        )
    return free.pop()


def what_is_there(output: Path, asked: dict[str, Any], resume: str | bool) -> str:
    """ "" (nothing), "partial" or "complete"; with resume=false what is there is removed.

    Raises:
        UserError: A training with other settings is there.
    """
    files = [output / name for name in ("best.ckpt", "last.ckpt", SUMMARY)]
    # A link to a result that is there may be read; whoever writes finds out before the first step.
    require_replaceable(*(file for file in files if resume is False or not file.is_file()))
    if resume is False:
        for file in files:
            file.unlink(missing_ok=True)
        shutil.rmtree(output / "tensorboard", ignore_errors=True)
        return ""
    found = [output / name for name in ("last.ckpt", "best.ckpt") if (output / name).exists()]
    if not found:
        return ""
    there = read_checkpoint(found[0])["hyper_parameters"].get("settings", {})
    if isinstance(there.get("training"), dict) and not there["training"].get("slower"):
        there["training"].pop("slower", None)  # a key of before that did nothing at 0
    if different := differences(there, asked):
        named = [f"{key} is {old!r} there and {new!r} here" for key, (old, new) in different.items()]
        more = f" and {len(named) - 4} more" if len(named) > 4 else ""
        raise UserError(
            f"{output} holds a training with other settings: {', '.join(named[:4])}{more}; use another output, remove "
            "it, or training.resume=false to overwrite it"
        )
    if (output / "best.ckpt").exists() and (output / SUMMARY).exists():
        return "complete"
    require_replaceable(*files)
    return "partial" if (output / "last.ckpt").exists() else ""


def require_resumable(
    last: Path, trainer: L.Trainer, module: SurrogateTraining, settings: TrainingSettings
) -> None:
    """Refuses a checkpoint that lacks, or has in odd shape, what a training goes on from.

    Raises:
        UserError: It does.
    """
    load_surrogate(last)
    content = read_checkpoint(last)
    fresh = module.configure_optimizers()
    weights = fresh["optimizer"].param_groups[0]["params"]
    try:
        (optimizer,), (schedule,) = content["optimizer_states"], content["lr_schedulers"]
        step = content["global_step"]
        done = content["loops"]["fit_loop"]["epoch_loop.automatic_optimization.optim_progress"]
        if type(step) is not int or not 0 <= step <= settings.max_steps:
            raise ValueError(f"global_step is {step!r:.40}, of {settings.max_steps} steps")
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
    """Refuses plain values that lack keys of fresh ones, or hold another kind of value there.

    Raises:
        ValueError: Which.
    """
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


def make_folder(output: Path) -> None:
    """Make the folder of the results."""
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(
            f"cannot make the folder {output}: {error.strerror}; choose another output"
        ) from error


class WholeCheckpoints(TorchCheckpointIO):
    """Lightning's way of writing checkpoints, but none is ever seen half-written.

    Its own writes to the machine's folder for temporary files and moves that, which is a copy where the results are on
    another disk.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Write it whole."""
        write_checkpoint(checkpoint, Path(path))


def make_trainer(
    output: Path,
    settings: TrainingSettings,
    device: str,
    callbacks: list[L.Callback],
    logger: TensorBoardLogger,
) -> L.Trainer:
    """Lightning's trainer: by steps, one device, no validation loop of its own (see `RolloutValidation`)."""
    if device not in ("cpu", "cuda"):
        raise UserError(f"device is {device!r}; allowed: cpu, cuda")
    if device == "cuda" and not torch.cuda.is_available():
        raise UserError("device is cuda but torch finds no CUDA device; use device=cpu")
    make_folder(output)
    return L.Trainer(
        accelerator="gpu" if device == "cuda" else "cpu",
        devices=1,
        max_steps=settings.max_steps,
        max_epochs=-1,
        logger=logger,
        callbacks=callbacks,
        log_every_n_steps=settings.log_every,
        gradient_clip_val=settings.gradient_clip,
        num_sanity_val_steps=0,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        plugins=[WholeCheckpoints()],
    )


@contextmanager
def quiet_lightning() -> Iterator[None]:
    """Lightning's log without its information: which devices there are, tips, that it stopped when it should."""
    logger = logging.getLogger("lightning.pytorch")
    before = logger.level
    logger.setLevel(logging.WARNING)
    try:
        yield
    finally:
        logger.setLevel(before)


def fit(
    trainer: L.Trainer, module: SurrogateTraining, data: L.LightningDataModule, last: Path | None
) -> None:
    """Run the trainer; an interruption stays one."""
    in_main_thread = threading.current_thread() is threading.main_thread()
    handler = signal.getsignal(signal.SIGINT) if in_main_thread else None
    with warnings.catch_warnings():
        # Everything is in memory: there is nothing for worker processes to do.
        warnings.filterwarnings("ignore", ".*does not have many workers.*")
        warnings.filterwarnings("ignore", ".*GPU available but not used.*")
        # Lightning's own use of torch, not ours.
        warnings.filterwarnings("ignore", ".*isinstance.treespec, LeafSpec.*")
        path = None if last is None else str(last)
        try:
            trainer.fit(module, datamodule=data, ckpt_path=path, weights_only=True)
        except SystemExit as error:
            # Lightning turns Ctrl-C into an exit of its own.
            raise KeyboardInterrupt from error
        except UserError:
            raise
        except Exception as error:
            if last is None or module.begun:
                raise
            reason = " ".join(str(error).split()) or type(error).__name__
            raise UserError(f"{last} cannot be gone on from ({reason:.200}); {_ANEW}") from error
        finally:
            if in_main_thread and handler is not None:
                signal.signal(signal.SIGINT, handler)
