"""What an evaluation found, in numbers: what the tables, the figures and the report are made from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sgns.evaluation.metrics import PositionErrors
from sgns.evaluation.scores import Scores
from sgns.reduction.reconstruction import ReductionCurves

__all__ = ["EvaluatedRun", "Evaluation", "NetworkTiming"]


@dataclass(frozen=True)
class EvaluatedRun:
    """One run of the split and its rollout.

    Attributes:
        name: of the run.
        label: short name.
        words: its scene in a few words; empty if there is nothing to say.
        truth: path of the simulated run.
        rollout: path of the predicted run.
        errors: position errors through time.
        scores: every metric.
    """

    name: str
    label: str
    words: str
    truth: Path
    rollout: Path
    errors: PositionErrors
    scores: Scores


@dataclass(frozen=True)
class NetworkTiming:
    """Wall seconds per simulated second of the network: medians of warm repeats on one thread.

    Attributes:
        stepping: steps with force and torque; the soil stays in the subspace.
        decoding: the same, and every frame decoded to all particles.
        repeats: number of timed repeats.
        run: run that was timed.
    """

    stepping: float
    decoding: float
    repeats: int
    run: str


@dataclass(frozen=True)
class Evaluation:
    """Everything that a report shows, in numbers.

    Attributes:
        dataset: name of the dataset.
        split: which of its splits was evaluated.
        runs: the evaluated runs.
        total: scores of all of them together.
        timing: of the network.
        mean_force: mean force of the training split [N], shape (3,).
        curves: of the reduction; held out are the evaluated runs.
        num_modes: modes r that the network uses.
        history: frames d that it was given.
        particle_count: particles n of the bed.
        start: common start of the particles [m], shape (n, 3).
        new_rollouts: run files without truth that are shown too.
        made: how it was made: name → value, in the order to show.
    """

    dataset: str
    split: str
    runs: Sequence[EvaluatedRun]
    total: Scores
    timing: NetworkTiming
    mean_force: np.ndarray
    curves: ReductionCurves
    num_modes: int
    history: int
    particle_count: int
    start: np.ndarray
    new_rollouts: Sequence[Path] = ()
    made: dict[str, str] = field(default_factory=dict)
