"""A tiny dataset and small settings, so that learning can be tested in seconds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
import yaml

from sgns.data.dataset import Dataset
from sgns.reduction.reduce import ReducedDataset, reduce_dataset
from sgns_testing.runs import make_run

# Matrices this small are slower on several threads, and results must not depend on the number of cores.
torch.set_num_threads(1)

__all__ = [
    "BRIEF",
    "FIT",
    "MODEL",
    "POLYNOMIAL",
    "REDUCTION",
    "TRAINING",
    "make_dataset",
    "reduced",
]

MODEL: dict[str, Any] = {
    "kind": "network",
    "history": 3,
    "body_nodes": "pose",
    "positions": True,
    "next_motion": True,
    "identity": "mode",
    "identity_width": 4,
    "context": [],
    "edges": "complete",
    "self_loops": False,
    "edge_scale": None,
    "edge_length": True,
    "hidden_width": 16,
    "hidden_layers": 2,
    "message_passing_steps": 1,
    "layer_norm": False,
    "residual": False,
    "activation": "relu",
    "predicts": "acceleration",
    "rigid": True,
    "force": "sum",
    "torque": True,
}
TRAINING: dict[str, Any] = {
    "max_steps": 20,
    "batch_size": 8,
    "learning_rate": 1e-3,
    "final_learning_rate": 1e-5,
    "warmup_steps": 2,
    "schedule": "cosine",
    "decades": 2.0,
    "weight_decay": 0.0,
    "gradient_clip": 1.0,
    "noise": 0.1,
    "noise_unit": "velocity",
    "scales": "per_mode",
    "normalisation_floor": 0.01,
    "horizon": 1,
    "fewer_modes": 0.0,
    "change_of": "free",
    "loss": {"change": 1.0, "force": 1.0, "torque": 0.1},
    "validate_every": 10,
    "log_every": 5,
    "resume": "auto",
    "threads": None,
}
BRIEF = TRAINING | {"max_steps": 2, "validate_every": 2}
REDUCTION: dict[str, Any] = {
    "num_modes": 4,
    "max_modes": 6,
    "centring": "particle_axis",
    "choose": "position",
    "tolerance": 1.0,
    "share": 0.99,
}
POLYNOMIAL: dict[str, Any] = {"kind": "polynomial", "history": 3, "degree": 2, "context": []}
FIT: dict[str, Any] = {
    "noises": [0.1, 0.3],
    "penalties": [1e-3, 1e-1],
    "linear": True,
    "draws": 2,
    "normalisation_floor": 0.01,
    "resume": "auto",
    "threads": None,
}


def make_dataset(folder: Path, frames: int = 14, **kw: Any) -> Dataset:
    """Four training runs, two validation runs (one shorter) and one test run of synthetic soil."""
    split = {"train": ["a", "b", "c", "d"], "validation": ["e", "f"], "test": ["g"]}
    for seed, name in enumerate(name for names in split.values() for name in names):
        make_run(folder / "runs" / f"{name}.h5", frames=frames - 2 * (name == "f"), seed=seed, **kw)
    (folder / "dataset.yaml").write_text(yaml.safe_dump({"name": "tiny", "split": split}))
    return Dataset.open(folder)


def reduced(folder: Path, **kw: Any) -> ReducedDataset:
    """The tiny dataset in its basis."""
    return reduce_dataset(make_dataset(folder, **kw), REDUCTION, progress=False)
