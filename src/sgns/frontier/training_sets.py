"""What a surrogate is trained on, made smaller: fewer runs, fewer frames a second."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from sgns.campaign import SPLITS, Dataset
from sgns.errors import UserError
from sgns.reduction.reduced import ReducedDataset, ReducedRun

__all__ = ["EveryNthFrame", "every_nth_frame", "frame_means", "with_training_runs"]


def with_training_runs(dataset: Dataset, count: int | None, seed: int = 0) -> Dataset:
    """The dataset with some of its training runs; a smaller number's runs are among a larger one's.

    Args:
        dataset: With all its runs.
        count: Of training runs; None: all.
        seed: Of the order in which they are taken.

    Raises:
        UserError: It has fewer.
    """
    names = dataset.split["train"]
    if count is None:
        return dataset
    if not 1 <= count <= len(names):
        raise UserError(f"training_runs is {count}; {dataset.path} has {len(names)}: give 1 to {len(names)}")
    chosen = set(np.random.default_rng(seed).permutation(len(names))[:count].tolist())
    kept = [name for number, name in enumerate(names) if number in chosen]
    return replace(dataset, split=dataset.split | {"train": kept})


def every_nth_frame(reduced: ReducedDataset, n: int) -> ReducedDataset:
    """The dataset at 1/n of its frame rate: every nth frame, forces as means over the n frames that end there."""
    if n == 1:
        return reduced
    runs: Mapping[str, list[ReducedRun]] = {
        split: [_thinned(run, n) for run in reduced.runs(split)] for split in SPLITS
    }
    return replace(reduced, frame_rate=reduced.frame_rate / n, _runs=runs)


def _thinned(run: ReducedRun, n: int) -> ReducedRun:
    kept = {name: getattr(run, name)[::n] for name in ("latent", "time", "pose", "body_points")}
    return replace(run, **kept, force=frame_means(run.force, n), torque=frame_means(run.torque, n))


def frame_means(values: np.ndarray, n: int) -> np.ndarray:
    """Means over the n frames that end with every nth one.

    Args:
        values: Forces or torques, means over a recorded frame each, shape (T, 3).
        n: Frames in one of the result.

    Returns:
        Shape (1 + (T - 1) // n, 3); frame 0 has none before it and stays.
    """
    count = (len(values) - 1) // n
    return np.concatenate([values[:1], values[1 : 1 + count * n].reshape(count, n, 3).mean(axis=1)])


class EveryNthFrame:
    """A run at 1/n of its frame rate, as far as `sgns.evaluation.metrics` reads runs.

    Args:
        run: The `Run`.
        n: 1 leaves it as it is.
    """

    def __init__(self, run, n: int) -> None:
        self._run, self._frames = run, np.arange(run.frame_count)[::n]
        self.path: Path = run.path
        self.frame_count = len(self._frames)
        self.particle_count: int = run.particle_count
        self.arrangement_hash: str = run.arrangement_hash
        self.frame_rate: float = run.frame_rate / n
        self.wall_time_s: float = run.wall_time_s
        self.scene = run.scene
        self.time: np.ndarray = run.time[self._frames]
        self.pose: np.ndarray = run.pose[self._frames]
        self.body_points: np.ndarray = run.body_points[self._frames]
        self.force: np.ndarray = frame_means(run.force, n)
        self.torque: np.ndarray = frame_means(run.torque, n)

    def positions(self, frames: slice = slice(None)) -> np.ndarray:
        """Soil particles [m], shape (t, n, 3)."""
        return self._run.positions(self._frames[frames])
