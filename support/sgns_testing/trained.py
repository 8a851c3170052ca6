"""Dynamics of several kinds, trained for a moment on the tiny dataset."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from sgns.model.checkpoint import Surrogate, load_surrogate
from sgns.reduction.reduce import ReducedDataset, ReducedRun
from sgns.simulator import Simulator
from sgns.train.command import train
from sgns_testing.tiny import BRIEF, FIT, reduced


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
