"""A tiny dataset and small settings, so that learning can be tested in seconds."""

from pathlib import Path
from typing import Any

import torch
import yaml

from sgns.data.dataset import Dataset
from sgns.reduction.reduce import ReducedDataset, reduce_dataset
from sgns.settings import FitSettings, ModelSettings, PolynomialSettings, ReductionSettings, TrainingSettings
from sgns_testing.runs import make_run

# Matrices this small are slower on several threads, and results must not depend on the number of cores.
torch.set_num_threads(1)

MODEL = ModelSettings(context=[], identity_width=4, hidden_width=16, predicts="acceleration").to_dict()
TRAINING = TrainingSettings(
    max_steps=20,
    batch_size=8,
    learning_rate=1e-3,
    final_learning_rate=1e-5,
    warmup_steps=2,
    noise=0.1,
    validate_every=10,
    log_every=5,
    threads=None,
).to_dict()
BRIEF = TRAINING | {"max_steps": 2, "validate_every": 2}
REDUCTION = ReductionSettings(num_modes=4, max_modes=6, tolerance=1.0).to_dict()
POLYNOMIAL = PolynomialSettings(context=[]).to_dict()
FIT = FitSettings(noises=[0.1, 0.3], penalties=[1e-3, 1e-1], threads=None).to_dict()


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
