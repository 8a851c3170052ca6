"""What a simulator answers: a state, a whole path, many paths.

Letters: B paths, T frames, n particles, M body points, r modes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from sgns.model.training_range import Excess
from sgns.reduction.basis import Basis


@dataclass(frozen=True, eq=False)
class State:
    """The bed and the tool at one frame.

    Attributes:
        frame: 0 at the reset.
        latent: Modes [m], shape (r, 3).
        force: By the soil on the tool over the last frame [N], world frame, shape (3,); zero at the reset.
        torque: About the tool's centre of mass [N m], shape (3,).
        pose: Tool's centre of mass [m] and quaternion x, y, z, w, shape (7,).
    """

    frame: int
    latent: np.ndarray
    force: np.ndarray
    torque: np.ndarray
    pose: np.ndarray
    _basis: Basis = field(repr=False)
    _excess: Callable[[], Excess | None] = field(repr=False)

    @property
    def outside(self) -> float:
        """How far this frame is from all that the training runs covered [1]: the distance of the worst of the tool's
        pose and motion, the soil's modes and their velocity, and the context from its training range, in widths of
        that range. 0: inside every range; above 0.05 the answer is a guess; NaN: the tool is nowhere yet."""
        found = self._excess()
        return np.nan if found is None else float(found.amount[-1])

    def soil(self) -> np.ndarray:
        """Positions of all particles [m], shape (n, 3); decoded when asked for."""
        return self._basis.inverse(self.latent).numpy()


@dataclass(frozen=True, eq=False)
class Rollout:
    """A whole tool path.

    Attributes:
        latent: Modes [m], shape (T, r, 3), float64.
        force: By the soil on the tool [N], shape (T, 3).
        torque: About its centre of mass [N m], shape (T, 3).
        poses: Of the tool, shape (T, 7); predicted where the tool is free.
        body_points: World frame [m], shape (T, M, 3).
        wall_time_s: Time of all steps, force included, decoding not [s].
    """

    latent: np.ndarray
    force: np.ndarray
    torque: np.ndarray
    poses: np.ndarray
    body_points: np.ndarray
    wall_time_s: float
    _excess: Callable[[], Excess | None] = field(repr=False)

    @cached_property
    def excess(self) -> Excess | None:
        """How far every frame is outside the training runs' range, see `State.outside`, and in what; None: a
        predicted tool is nowhere."""
        return self._excess()


@dataclass(frozen=True, eq=False)
class Rollouts:
    """Many tool paths: as of `Rollout`, with B before every shape; `wall_time_s` is that of all of them."""

    latent: np.ndarray
    force: np.ndarray
    torque: np.ndarray
    poses: np.ndarray
    wall_time_s: float
