"""`sgns train`: fit the latent dynamics to a dataset's reduced runs.

`output` holds `best.ckpt` (highest validation skill), of a network `last.ckpt` (to go on from), `tensorboard/` and,
once complete, `training.json`. The same command with the same `output` goes on where it stopped, or answers from
what is there.
"""

from __future__ import annotations

import json
import logging
import math
import re
import shlex
import shutil
import signal
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from lightning.fabric.plugins.environments import (
    ClusterEnvironment,
    LightningEnvironment,
    SLURMEnvironment,
    TorchElasticEnvironment,
)
from lightning.pytorch.loggers import TensorBoardLogger
from omegaconf import OmegaConf

import sgns
from sgns.config import (
    Interrupted,
    UserError,
    differences,
    flattened,
    of_dataset,
    own_overrides,
    parse_yaml,
)
from sgns.data.dataset import IMPORTED
from sgns.data.files import only_here, require_replaceable, write_whole
from sgns.model.checkpoint import SUMMARY, read_checkpoint, read_summary
from sgns.numbers import counted, error_hint, error_words
from sgns.reduction.packed import packed_dataset
from sgns.reduction.reduce import ReducedDataset, reduce_dataset
from sgns.settings import model_settings, training_settings
from sgns.train import Fit, Task
from sgns.train.validation import quiet_writer

if TYPE_CHECKING:
    from omegaconf import DictConfig

log = logging.getLogger(__name__)


# Settings that change speed or reporting, not the result.
_NO_MATTER = ("threads", "log_every", "resume", "devices", "nodes", "strategy")
FITS = {"network": "sgns.train.lightning_module:NETWORK", "polynomial": "sgns.train.polynomial:POLYNOMIAL"}
"""How to fit a model, by `model.kind`; loaded as `sgns.model.checkpoint.DYNAMICS` is."""


def main(cfg: DictConfig) -> float:
    """The `sgns train` command; returns the skill of rollouts of the validation runs, in full space."""
    from sgns.data.dataset import Dataset
    from sgns.reduction.published import published_dataset

    plain: Any = OmegaConf.to_container(cfg, resolve=True)
    settings = training_settings(plain["model"], plain["training"])
    if settings.threads is not None:
        torch.set_num_threads(settings.threads)  # for the reduction, too
    output, first = Path(cfg.output), environment_of(settings).global_rank() == 0
    if first:
        with only_here(output / "best.ckpt"):
            pass  # who cannot have it shall not wait for the reduction to hear so
    else:
        logging.getLogger("sgns").setLevel(logging.ERROR)  # the first process speaks for all
    title = plain["dataset"]["name"]
    if cfg.dataset.get("format") == "published":
        if cfg.reduction.closure != "none":
            raise UserError(
                f"reduction.closure is {cfg.reduction.closure}, but published runs have no particles to decode; use "
                "reduction.closure=none"
            )
        reduced = published_dataset(plain["dataset"], cfg.reduction.num_modes)
    elif cfg.dataset.get("format") == "reduced":
        reduced = packed_dataset(Path(plain["dataset"]["path"]), plain["reduction"])
    else:
        dataset = Dataset.open(cfg.dataset.path, cfg.dataset.get("where"))
        reduced, title = reduce_dataset(dataset, cfg.reduction, device=cfg.device), dataset.title
    hydra = HydraConfig.get() if HydraConfig.initialized() else None
    job = own_overrides(hydra.overrides.task) if hydra is not None and hydra.mode == RunMode.MULTIRUN else ()
    skill = train(
        reduced,
        num_modes=reduced.num_modes,
        model=plain["model"],
        training=plain["training"],
        output=output,
        seed=cfg.seed,
        device=cfg.device,
        start_from=cfg.checkpoint,
        provenance={"preset": plain["preset"]["name"], "dataset": title},
        job=job,
    )
    if first and hydra is not None and not job:  # a sweep ends with a table
        for line in next_commands(output / "best.ckpt", reduced, hydra.overrides.task):
            log.info("%s", line)
    return skill


def environment_of(how: Any) -> ClusterEnvironment:
    """Which of its processes this one is, of a training with these settings.

    Raises:
        UserError: There are to be several, and there are not as many.
    """
    processes = getattr(how, "processes", 1)
    if processes == 1:
        # Whatever a cluster's job says of its tasks: Lightning would look for the others, requeue the job itself, and
        # log nothing in any but the first.
        alone = LightningEnvironment()
        alone.set_global_rank(0)
        return alone
    found: ClusterEnvironment | None = None
    if TorchElasticEnvironment.detect():
        found = TorchElasticEnvironment()
    elif SLURMEnvironment.detect():
        found = SLURMEnvironment(auto_requeue=False)
    there = 1 if found is None else found.world_size()
    if found is None or there != processes:
        raise UserError(
            f"training.devices={how.devices} training.nodes={how.nodes} need {processes} processes, and "
            f"{'this is one' if there == 1 else f'there are {there}'}: start them with torchrun or srun, as in "
            f"docs/guides/cluster.md#one-training-several-processes"
        )
    return found


def next_commands(checkpoint: Path, reduced: ReducedDataset, given: Sequence[str]) -> list[str]:
    """What to type after a training with these overrides."""
    file = f"checkpoint={shlex.quote(str(checkpoint))}"
    members = read_checkpoint(checkpoint)["hyper_parameters"].get("members", 1)
    file += " spread=true" * (members > 1)
    lines = [f"next: sgns evaluate {' '.join([*of_dataset(given), file])}"]
    scene = reduced.runs("train")[0].scene
    if (
        "bed" in scene and scene.get("kind") != IMPORTED
    ):  # published runs have no particles, imported ones no scene
        own = ["scene.path=path.csv"] * (scene.get("path") is not None)
        own += ["scene.tool.file=tool.stl"] * ((scene.get("tool") or {}).get("shape") == "mesh")
        lines.append(f"      sgns rollout {' '.join([file, *own])} output=new.h5")
    return lines


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
    job: Sequence[str] = (),
) -> float:
    """Train, or go on training, or take what is complete; returns the skill of the best checkpoint's rollouts on the
    validation runs.

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
        job: Of a job of a sweep what tells it from the others, as key=value: TensorBoard calls it so.

    Raises:
        UserError: Bad settings, a loss that is not finite, or an `output` of another training, there or under way.
    """
    settings, how = model_settings(model), training_settings(model, training)
    if how.threads is not None:
        torch.set_num_threads(how.threads)
    fit: Fit = resolve_name(FITS[settings.kind])
    environment = environment_of(how)
    first = environment.global_rank() == 0  # it alone writes
    validation_runs = reduced.runs("validation")
    if not validation_runs:
        log.warning("the validation split is empty; %s", fit.stand_ins_do)
        validation_runs = reduced.runs("train")[fit.stand_ins]
    closure = reduced.of_modes(num_modes).closure
    asked = {
        "num_modes": num_modes,
        "model": settings.to_dict(),
        "training": {k: v for k, v in how.to_dict().items() if k not in _NO_MATTER},
        "seed": seed,
        "basis": reduced.folder.name,
        **({"closure": f"{closure.kind} to {num_modes + closure.num_modes} modes"} if closure else {}),
        "validation_runs": [run.name for run in validation_runs],
        "start_from": None if start_from is None else str(start_from),
        **(provenance or {}),
    }
    card = {
        "settings": asked,
        "frame_rate": float(reduced.frame_rate),
        "scene": reduced.runs("train")[0].scene,
        "package_version": sgns.__version__,
    }
    with only_here(output / "best.ckpt") if first else nullcontext():
        resumed = what_is_there(output, asked, how.resume, log_folder(job)) if first or how.resume else ""
        if resumed == "complete":
            summary = read_summary(output)
            log.info("%s is complete; training.resume=false trains anew", output)
            return float(summary["skill"])

        output.mkdir(parents=True, exist_ok=True)
        torch.manual_seed(seed)
        logger = Logger(output, name="", version=log_folder(job), default_hp_metric=False)
        try:
            fitted = fit.run(
                Task(
                    reduced=reduced,
                    validation_runs=validation_runs,
                    num_modes=num_modes,
                    model=settings,
                    settings=how,
                    output=output,
                    seed=seed,
                    device=device,
                    start_from=start_from,
                    resumed=resumed == "partial",
                    card=card,
                    logger=logger,
                    environment=environment,
                )
            )
        except KeyboardInterrupt as stop:
            if (output / "last.ckpt").exists():
                raise
            every = getattr(how, "validate_every", None)  # polynomials write one at their end
            then = f"; the first checkpoint comes after {every} steps" if every else ""
            number = stop.number if isinstance(stop, Interrupted) else signal.SIGINT
            raise Interrupted(number, f"nothing of the training is kept yet{then}") from None
        score = fitted.score
        if not first:
            return score.skill
        metrics = {
            key: getattr(score, key) for key in ("skill", "skill_at_rest", "skill_in_subspace", "force_nrmse")
        }
        if not math.isnan(score.position_rmse):
            metrics["position_rmse"] = score.position_rmse
        if fitted.surrogate.dynamics.predicts_body:
            metrics["body_rmse"] = score.body_rmse
        # TensorBoard's HParams tab takes one level, scalars or text; of a sweep what it is over.
        told = {key: parse_yaml(value) for key, _, value in (one.partition("=") for one in job)}
        hyperparameters = {
            key: value if isinstance(value, (bool, int, float, str)) else str(value)
            for key, value in (told or flattened(asked)).items()
        }
        logger.log_hyperparams(hyperparameters, {f"result/{key}": value for key, value in metrics.items()})
        logger.finalize("success")
        summary = {**fitted.about, **metrics, "seconds": round(fitted.seconds, 1)}
        write_whole(output / SUMMARY, json.dumps(summary, indent=2) + "\n")
        words = score.words() if math.isnan(score.position_rmse) else error_words(*score.errors)
        runs = counted(len(validation_runs), "validation run")
        log.info("trained in %.0f s; on %s: %s; %s", fitted.seconds, runs, words, output / "best.ckpt")
        if hint := error_hint(*score.errors):
            log.info("%s", hint)
        return score.skill


class Logger(TensorBoardLogger):
    """TensorBoard's, without the number of the epoch, of which there is one."""

    def log_metrics(self, metrics: Mapping[str, Any], step: int | None = None) -> None:
        super().log_metrics({name: value for name, value in metrics.items() if name != "epoch"}, step)


def log_folder(job: Sequence[str]) -> str:
    """Where the log is below the output; TensorBoard calls the job so."""
    parts = [one.partition("=")[::2] for one in job]
    short = [key.rpartition(".")[2] for key, _ in parts]
    keys = short if len(set(short)) == len(short) else [key for key, _ in parts]
    name = ",".join(f"{key}={value}" for key, (_, value) in zip(keys, parts, strict=True))
    return re.sub(r"[^\w.=+,-]+", "_", name)[:100] or "tensorboard"


def what_is_there(output: Path, asked: dict[str, Any], resume: str | bool, log: str = "tensorboard") -> str:
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
        shutil.rmtree(output / log, ignore_errors=True)
        return ""
    found = [output / name for name in ("last.ckpt", "best.ckpt") if (output / name).exists()]
    if not found:
        return ""
    there = read_checkpoint(found[0])["hyper_parameters"].get("settings", {})
    if different := differences(there, asked):
        named = [f"{key} is {old!r} there and {new!r} here" for key, (old, new) in different.items()]
        more = f" and {len(named) - 4} more" if len(named) > 4 else ""
        raise UserError(
            f"{output} holds a training with other settings: {', '.join(named[:4])}{more}; use another output (and "
            f"checkpoint={found[-1]} to begin from its weights), remove it, or training.resume=false to overwrite it"
        )
    if (output / "best.ckpt").exists() and (output / SUMMARY).exists():
        return "complete"
    require_replaceable(*files)
    return "partial" if (output / "last.ckpt").exists() else ""
