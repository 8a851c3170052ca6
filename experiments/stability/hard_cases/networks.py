"""Networks for the hard cases: a small one of synthetic runs, made in seconds, and one of the solver's own runs."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from common import training_settings

from sgns.config import UserError
from sgns.data.dataset import Dataset
from sgns.data.files import file_lock
from sgns.reduction.reduce import ReducedDataset, reduce_dataset
from sgns.simulator import Simulator
from sgns.train.command import train
from sgns_testing import tiny

ROOT = Path(__file__).resolve().parents[3]
# Kept until the process ends.
_FOLDER = tempfile.TemporaryDirectory(prefix="sgns-stability-")


def new_folder() -> Path:
    """An empty folder, for as long as this process."""
    return Path(tempfile.mkdtemp(dir=_FOLDER.name))


def fresh_data(**kw: Any) -> ReducedDataset:
    """Four training runs, two validation runs and a test run; keyword arguments as of `tiny.make_dataset`."""
    return tiny.reduced(new_folder(), **kw)


@cache
def synthetic_data() -> ReducedDataset:
    """`fresh_data` of 14 frames, made once."""
    return fresh_data()


def poisoned(data: ReducedDataset, split: str, what: str) -> ReducedDataset:
    """The data with one number that is none: the last of frame 7 in the second run of a split."""
    runs = {name: data.runs(name) for name in ("train", "validation", "test")}
    values = getattr(runs[split][1], what).copy()
    values[7].flat[-1] = np.nan
    runs[split][1] = replace(runs[split][1], **{what: values})
    return replace(data, _runs=runs)


def train_synthetic(
    data: ReducedDataset, output: Path, model: dict[str, Any] | None = None, **training: Any
) -> float:
    """Train a small network, or polynomials, to a few steps; returns the skill."""
    if model is not None and model.get("kind") == "polynomial":
        return train(data, num_modes=4, model=tiny.POLYNOMIAL, training=tiny.FIT | training, output=output)
    settings = tiny.MODEL | {"predicts": "velocity"} | (model or {})
    return train(data, num_modes=4, model=settings, training=tiny.TRAINING | training, output=output, seed=3)


@cache
def synthetic_network(kind: str = "pose") -> Path:
    """Checkpoint of a network of pose or points, or of polynomials, that follows the synthetic runs."""
    output = new_folder()
    if kind == "polynomial":
        train_synthetic(synthetic_data(), output, {"kind": "polynomial"})
    else:
        steps = {"max_steps": 80, "validate_every": 80, "learning_rate": 5e-3, "noise": 1.0}
        train_synthetic(synthetic_data(), output, {"body_nodes": kind}, **steps)
    return output / "best.ckpt"


@cache
def quick_data() -> ReducedDataset:
    """The solver's runs of `sgns simulate dataset=quick`."""
    path = ROOT / "data" / "quick"
    if not (path / "dataset.yaml").exists():
        raise UserError("this case needs the dataset quick; make it with: sgns simulate dataset=quick")
    return reduce_dataset(Dataset.open(path), training_settings()["reduction"], progress=False)


def quick_network() -> Path:
    """Checkpoint of the default network, trained on the dataset quick once and then kept in outputs/."""
    output = ROOT / "outputs" / "stability" / "network"
    settings, data = training_settings("training.threads=1"), quick_data()
    chosen = {key: settings[key] for key in ("model", "training")}
    about = {"preset": "default", "dataset": "quick"}
    # Two processes may want it at once: the second waits and finds it complete.
    with file_lock(output.with_suffix(".lock"), wait=True):
        train(data, num_modes=data.num_modes, **chosen, output=output, provenance=about)
    return output / "best.ckpt"


def simulator_of(kind: str) -> Simulator:
    """By the name of its network: pose, points, polynomial or quick."""
    return Simulator.load(quick_network() if kind == "quick" else synthetic_network(kind))
