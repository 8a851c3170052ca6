"""What an evaluation found, in numbers: what the tables, the figures and the report are made from."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sgns.evaluation.metrics import PositionErrors
from sgns.evaluation.scores import Scores
from sgns.reduction import Basis
from sgns.reduction.reconstruction import ReductionCurves

__all__ = ["Costs", "EvaluatedRun", "Evaluation", "FullSpaceCost", "NetworkTiming"]


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
        wheel: whether its body is a wheel.
    """

    name: str
    label: str
    words: str
    truth: Path
    rollout: Path
    errors: PositionErrors
    scores: Scores
    wheel: bool = False


@dataclass(frozen=True)
class NetworkTiming:
    """Wall seconds per simulated second of the network: medians of warm repeats on one thread.

    Attributes:
        stepping: steps with force and torque; the soil stays in the subspace.
        decoding: the same, and every frame decoded to all particles.
        repeats: number of timed repeats.
        run: run that was timed.
        stepping_bytes: peak memory of the whole process while it steps; NaN if not known.
        decoding_bytes: the same while it decodes.
    """

    stepping: float
    decoding: float
    repeats: int
    run: str
    stepping_bytes: float = math.nan
    decoding_bytes: float = math.nan


@dataclass(frozen=True)
class Costs:
    """What the network takes besides time; NaN is not known.

    Attributes:
        parameters: weights that were learned.
        checkpoint_bytes: size of the file, with the basis and what is needed to go on training.
        training_steps: of the whole training.
        training_seconds: wall time of the whole training, validation included.
        batch_size: samples of a training step.
    """

    parameters: int | float = math.nan
    checkpoint_bytes: float = math.nan
    training_steps: int | float = math.nan
    training_seconds: float = math.nan
    batch_size: int | float = math.nan

    @property
    def seconds_per_step(self) -> float:
        """Wall time of a training step [s]."""
        return self.training_seconds / self.training_steps


@dataclass(frozen=True)
class FullSpaceCost:
    """A network on every particle, untrained.

    Attributes:
        parameters: weights that would be learned.
        training_step: wall time of a step of `batch_size` windows on one thread, reading them included [s].
        batch_size: windows of that step.
        rollout: wall seconds per simulated second on one thread.
        peak_bytes: peak memory of the whole process while it trains; NaN if not known.
    """

    parameters: int
    training_step: float
    batch_size: int
    rollout: float
    peak_bytes: float


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
        basis: of the network.
        num_modes: modes r that the network uses.
        history: frames d that it was given.
        particle_count: particles n of the bed.
        start: common start of the particles [m], shape (n, 3).
        costs: of the network.
        full_space: of the same network on every particle; None if it was not asked for.
        mean_torque: mean torque of the training split [N m], shape (3,).
        training_log: losses and validation scores by step, as `training_curves.read_log` gives them.
        trained_on: names of the evaluated runs that the basis and the network were fitted on.
        chosen_by: names of those that chose the checkpoint.
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
    basis: Basis
    num_modes: int
    history: int
    particle_count: int
    start: np.ndarray
    costs: Costs = field(default_factory=Costs)
    full_space: FullSpaceCost | None = None
    mean_torque: np.ndarray = field(default_factory=lambda: np.zeros(3))
    training_log: Mapping[str, np.ndarray] = field(default_factory=dict)
    trained_on: Sequence[str] = ()
    chosen_by: Sequence[str] = ()
    new_rollouts: Sequence[Path] = ()
    made: dict[str, str] = field(default_factory=dict)
