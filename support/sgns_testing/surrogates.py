"""Stand-ins for a trained network and a dataset, for tests of rollout, evaluation and report."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from mpm_warp.poses import in_world_frame
from sgns.data.run import Run
from sgns.evaluate.metrics import VectorErrors
from sgns.evaluate.results import Scores
from sgns.reduction.basis import Basis
from sgns.reduction.pca import IncrementalPCA
from sgns.state import Rollout
from sgns_testing.runs import make_run


@dataclass
class FakeDataset:
    """Run files by split."""

    name: str
    path: Path
    splits: dict[str, list[Path]]

    command = "sgns simulate dataset=fake"

    @property
    def title(self) -> str:
        return self.name

    def runs(self, split: str) -> list[Path]:
        return self.splits[split]


class FakeSimulator:
    """Knows the true latents of some runs and answers with a chosen mistake.

    `mistake` maps the true latents (T, r, 3) and the history d to the predicted ones; `force_factor` scales
    the true force.
    """

    history = 3
    frame_rate = 60.0
    card: ClassVar = {"settings": {"num_modes": 6}, "package_version": "0"}

    def __init__(
        self, basis: Basis, paths: list[Path], mistake: Any = None, force_factor: float = 1.0
    ) -> None:
        self.basis = basis
        self.num_modes = basis.num_modes
        self.arrangement_hash = basis.arrangement_hash
        self.mistake = mistake or (lambda latent, d: latent)
        self.force_factor = force_factor
        self.known = []
        for path in paths:
            with Run(path) as run:
                self.start_positions = run.positions(slice(0, 1))[0].astype(np.float64)
                self.scene = run.scene
                self.known.append((run.pose, basis.transform(run.positions()).numpy(), run.force, run.torque))

    def reset(self, poses: np.ndarray, values: Any = None) -> None:
        self.at = 0

    def step(self, pose: np.ndarray) -> None:
        self.at += 1

    def rollout(
        self, poses: np.ndarray, body_points: Any = None, latent_history: Any = None, values: Any = None
    ) -> Rollout:
        distance = [np.abs(known[0] - poses).sum() for known in self.known]
        _, latent, force, torque = self.known[int(np.argmin(distance))]
        latent = self.mistake(latent.copy(), self.history)
        if latent_history is not None:
            latent[: self.history] = np.asarray(latent_history)
        loads = self.force_factor * force, self.force_factor * torque
        return Rollout(
            latent,
            *loads,
            poses,
            in_world_frame(poses, body_points),
            0.01,
            None,  # nothing is to go on from its end
            self.basis,
            self.scene,
            lambda: None,
        )


def fitted(paths: list[Path], modes: int) -> Basis:
    """A basis of the runs with their arrangement."""
    pca = IncrementalPCA(modes)
    for path in paths:
        with Run(path) as run:
            pca.partial_fit(run.positions())
            arrangement = run.arrangement_hash
    return replace(pca.basis(), arrangement_hash=arrangement, fitted_on=[path.stem for path in paths])


def small_dataset(folder: Path, frames: int = 20, n: int = 120) -> FakeDataset:
    """Three training runs and two test runs."""
    paths = [make_run(folder / f"run{i}.h5", frames=frames, n=n, seed=i) for i in range(5)]
    return FakeDataset("small", folder, {"train": paths[:3], "validation": paths[3:4], "test": paths[3:]})


def frozen_latent(latent: np.ndarray, history: int) -> np.ndarray:
    """Nothing moves after the history."""
    latent[history:] = latent[history - 1]
    return latent


def made_scores(name: str, total: float, frozen: float, force: float = 1.0, rate: float = 10.0) -> Scores:
    """Scores of four frames with given position errors [m²], factor on the force, and solver time."""
    truth = np.full((4, 3), [-100.0, 0.0, 50.0])
    errors = VectorErrors.compare(truth, force * truth)
    mse = dict.fromkeys(("reduction", "network", "surface", "surface_frozen"), 1e-6)
    mse |= {"total": total, "frozen": frozen, "constant_velocity": 2.0 * frozen}
    return Scores(name, 4, mse, *[errors] * 6, rate)
