"""States along a path, and whether two answers of a simulator are the same."""

from __future__ import annotations

from typing import Any

import numpy as np

from sgns.simulator import Simulator
from sgns.state import State


def stepped(simulator: Simulator, path: np.ndarray) -> list[State]:
    """States along a path from its first pose."""
    return [simulator.reset(path), *map(simulator.step, path[1:])]


def assert_same(found: Any, expected: Any, frame: Any = ...) -> None:
    """Two states or rollouts to the bit, or a state and a frame of a rollout."""
    for name in ("latent", "force", "torque"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name)[frame])
