"""Trainings that take a given processor time, whatever a step of theirs takes."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import statistics
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from sgns.clock import elapsed
from sgns.errors import UserError
from sgns.learning.kinds import model_settings
from sgns.learning.model_settings import ModelSettings
from sgns.learning.trainee import SurrogateTraining, TrainingSettings
from sgns.learning.training import prepared, train
from sgns.reduction.reduced import ReducedDataset
from sgns.smallfile import read_json
from sgns.wholefile import write_whole

__all__ = ["TimedTraining", "train_for"]

log = logging.getLogger(__name__)

# Steps that are timed to find out how many fit, after as many that warm up.
PILOT_STEPS = 12
SHORTEST_STEP = 1e-6  # [s]; less no step takes
# How often the validation runs choose the best checkpoint.
VALIDATIONS = 4
_SCHEME = 1  # of what a folder of a training stands for


@dataclass(frozen=True)
class TimedTraining:
    """A complete training.

    Attributes:
        checkpoint: The best by the validation runs.
        processor_s: Processor time of the training, validation included [s].
        steps: Optimiser steps; 0 where there are none (polynomials).
        samples: Windows seen, all steps together; of polynomials those of the moments, noise drawn anew counted again.
    """

    checkpoint: Path
    processor_s: float
    steps: int
    samples: int


def train_for(
    seconds: float, reduced: ReducedDataset, settings: Mapping[str, Any], folder: Path, seed: int = 0
) -> TimedTraining:
    """Train on this thread for about so much processor time, or take what is complete.

    The steps of the optimiser are as many as fit, by the time of a few, and the learning rate falls over them, so that
    every training is a whole one. Polynomials are fitted, however long it takes.

    Args:
        seconds: Processor time of the steps; validation comes on top.
        reduced: The dataset in its basis.
        settings: `conf/train` as plain values.
        folder: Trainings are kept in, each in a folder named by what it depends on.
        seed: Of weights, noise and order.
    """
    model, training = settings["model"], settings["training"] | {"threads": 1, "resume": False}
    num_modes = reduced.num_modes
    output = folder / _key(seconds, reduced, model, training, seed)
    record = output / "timed.json"
    if record.exists():
        return read_record(record)
    torch.set_num_threads(1)
    frames = sum(len(run.latent) - 1 for run in reduced.runs("train"))
    checked = model_settings(model)
    if not isinstance(checked, ModelSettings):
        steps, samples = 0, frames * training["draws"]
    else:
        steps = max(VALIDATIONS, round(seconds / seconds_per_step(reduced, checked, training, seed)))
        training |= {
            "max_steps": steps,
            "validate_every": -(-steps // VALIDATIONS),
            "warmup_steps": min(training["warmup_steps"], steps // 10),
        }
        samples = steps * training["batch_size"]
    began = time.process_time()
    train(
        reduced,
        num_modes=num_modes,
        model=model,
        training=training,
        output=output,
        seed=seed,
        provenance={
            "preset": settings["preset"]["name"],
            "dataset": settings["dataset"]["name"],
            "seconds": seconds,
        },
    )
    done = TimedTraining(output / "best.ckpt", round(elapsed(began, time.process_time()), 1), steps, samples)
    write_whole(record, json.dumps({k: v for k, v in asdict(done).items() if k != "checkpoint"}) + "\n")
    return done


def read_record(record: Path) -> TimedTraining:
    """What `train_for` keeps beside a checkpoint.

    Raises:
        UserError: It is damaged.
    """
    advice = "remove it to train again"
    known = read_json(record, "not the record of a training", advice)
    kinds = {"processor_s": (int, float), "steps": int, "samples": int}
    if not isinstance(known, dict) or known.keys() != kinds.keys():
        raise UserError(f"{record} does not say {', '.join(kinds)}; {advice}")
    for key, kind in kinds.items():
        value = known[key]
        if not isinstance(value, kind) or isinstance(value, bool) or not 0 <= value < math.inf:
            raise UserError(f"{record}: {key} is {value!r:.40}, not a number of 0 or more; {advice}")
    return TimedTraining(record.with_name("best.ckpt"), **known)


def seconds_per_step(
    reduced: ReducedDataset, model: ModelSettings, training: Mapping[str, Any], seed: int
) -> float:
    """Processor time of an optimiser step with its batch, median of a few [s].

    Raises:
        UserError: the processor's clock stands still.
    """
    settings = TrainingSettings.from_dict(training)
    surrogate, data = prepared(reduced, reduced.num_modes, model, settings, seed, {}, None)
    module = SurrogateTraining(surrogate, settings)
    # Lightning logs only within a trainer, so the step is taken by hand; small, for nothing of it is kept.
    optimiser = torch.optim.AdamW(module.parameters(), lr=1e-6, fused=True)
    taken = []
    for step in range(2 * PILOT_STEPS):
        began = time.process_time()
        losses = module.losses(data.training_windows.batch(step, settings.batch_size, data.noise))
        optimiser.zero_grad()
        sum(settings.loss[name] * value for name, value in losses.items()).backward()
        torch.nn.utils.clip_grad_norm_(module.parameters(), 1.0)
        optimiser.step()
        taken.append(elapsed(began, time.process_time()))
    found = statistics.median(taken[PILOT_STEPS:])
    if found < SHORTEST_STEP:
        raise UserError(
            "the processor's clock stands still, so nobody knows how many steps a training may take; repeat the "
            "command when the machine runs undisturbed"
        )
    return found


def _key(
    seconds: float,
    reduced: ReducedDataset,
    model: Mapping[str, Any],
    training: Mapping[str, Any],
    seed: int,
) -> str:
    """Name of the folder of a training: of everything that its result depends on."""
    told = [
        _SCHEME,
        seconds,
        reduced.folder.name,
        reduced.num_modes,
        reduced.frame_rate,
        model,
        training,
        seed,
    ]
    return hashlib.blake2b(json.dumps(told, sort_keys=True).encode(), digest_size=8).hexdigest()
