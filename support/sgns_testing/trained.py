"""Dynamics of several kinds, trained for a moment on the tiny dataset."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import yaml

import mpm_warp
from sgns.data.dataset import Dataset
from sgns.model.checkpoint import Surrogate, load_surrogate
from sgns.reduction.reduce import ReducedDataset, ReducedRun, reduce_dataset
from sgns.simulator import Simulator
from sgns.train.command import train
from sgns_testing.runs import make_run
from sgns_testing.tiny import BRIEF, FIT, MODEL, POLYNOMIAL, REDUCTION, reduced

WHEEL = mpm_warp.Wheel(bed=mpm_warp.Bed(size=(0.4, 0.2, 0.08), spacing=0.04), settle=0.05, duration=0.3)


class TrainedKinds(NamedTuple):
    """The tiny dataset in its basis, and checkpoints by the names of their kinds."""

    data: ReducedDataset
    folder: Path

    @classmethod
    def of(cls, folder: Path, models: dict[str, dict[str, Any]], **kw: Any) -> TrainedKinds:
        """Trains some models, by name; `kw` as of `reduced`."""
        data = reduced(folder, **kw)
        for name, model in models.items():
            training = FIT if model["kind"] == "polynomial" else BRIEF
            train(data, num_modes=4, model=model, training=training, output=folder / name)
        return cls(data, folder)

    @property
    def run(self) -> ReducedRun:
        """The test run."""
        return self.data.runs("test")[0]

    def surrogate(self, kind: str) -> Surrogate:
        return load_surrogate(self.folder / kind / "best.ckpt")

    def simulator(self, kind: str, **kw: Any) -> Simulator:
        return Simulator.load(self.folder / kind / "best.ckpt", **kw)


def driven_wheels(folder: Path, *kinds: str) -> TrainedKinds:
    """Of two loads and slips, kinds of "network", "points" and "polynomial"."""
    known = {"n": len(WHEEL.initial_positions()), "arrangement_hash": WHEEL.arrangement_hash}
    split = {"train": ["a", "b", "c"], "validation": ["d"], "test": ["e"]}
    for seed, name in enumerate("abcde"):
        scene = replace(WHEEL, load=60.0 + 40.0 * (seed % 2), slip=0.2 + 0.2 * (seed % 2)).to_dict()
        make_run(folder / "runs" / f"{name}.h5", frames=14, seed=seed, scene=scene, **known)
    (folder / "dataset.yaml").write_text(yaml.safe_dump({"name": "wheels", "split": split}))
    data = reduce_dataset(Dataset.open(folder), REDUCTION, progress=False)
    pose = MODEL | {"context": ["load", "slip"], "body_nodes": "pose"}
    models = {"network": pose, "points": pose | {"body_nodes": "points"}, "polynomial": POLYNOMIAL}
    for name in kinds:
        training = FIT if name == "polynomial" else BRIEF
        train(data, num_modes=4, model=models[name], training=training, output=folder / name)
    return TrainedKinds(data, folder)
