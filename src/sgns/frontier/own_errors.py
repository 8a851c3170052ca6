"""A surrogate against the solver that made its training runs, on runs that it has not seen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from sgns.evaluation.evaluate import roll_out, training_means
from sgns.evaluation.metrics import body_errors, position_errors
from sgns.evaluation.scores import Scores, aggregate, run_scores
from sgns.evaluation.surface import surface_grid
from sgns.frontier.training_sets import EveryNthFrame
from sgns.rollout import single_thread
from sgns.runs import Run
from sgns.simulator import Simulator
from sgns.states import Rollout

__all__ = ["Decoded", "own_errors"]


class Decoded:
    """A rollout as far as `sgns.evaluation.metrics` reads runs; frames are decoded when they are asked for.

    Args:
        simulator: Whose it is.
        rollout: Of T frames.
        name: For messages.
    """

    def __init__(self, simulator: Simulator, rollout: Rollout, name: str) -> None:
        self._basis, self._latent = simulator.basis, torch.as_tensor(rollout.latent)
        self.path = Path(f"rollout of {name}")
        self.frame_count = len(rollout.latent)
        self.particle_count = len(simulator.start_positions)
        self.arrangement_hash = simulator.arrangement_hash
        self.time: np.ndarray = np.arange(self.frame_count) / simulator.frame_rate
        self.pose, self.force, self.torque = rollout.poses, rollout.force, rollout.torque

    def positions(self, frames: slice = slice(None)) -> np.ndarray:
        """Soil particles [m], shape (t, n, 3)."""
        return self._basis.inverse(self._latent[frames]).numpy()


def own_errors(
    simulator: Simulator, paths: Sequence[Path], training_paths: Sequence[Path], every: int = 1
) -> Scores:
    """Scores over some runs together, each rolled out from its first d true frames, as `sgns evaluate` does it.

    Args:
        simulator: Trained at 1/every of the runs' frame rate.
        paths: Runs to be predicted.
        training_paths: Runs whose mean force is a baseline.
        every: Frames of the runs in one of the simulator's.
    """
    d = int(simulator.history)
    mean_force, mean_torque = training_means(training_paths, d)
    grid = surface_grid(np.asarray(simulator.start_positions, dtype=np.float64))
    found = []
    for path in paths:
        with Run(path) as run, single_thread():
            truth = EveryNthFrame(run, every)
            guess = Decoded(simulator, roll_out(simulator, truth), path.stem)
            errors = position_errors(truth, guess, simulator.basis, d, grid)
            body = body_errors(truth, guess, d)
            found.append(run_scores(path.stem, errors, truth, guess, d, mean_force, mean_torque, body))
    return aggregate(found)
