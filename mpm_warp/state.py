"""The state to go on from, and the errors of the solver."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import warp as wp


class SceneError(ValueError):
    """A scene that cannot be simulated: what, where, what is allowed."""


class SolverStopped(RuntimeError):
    """The solver met a non-finite or unphysical value and stopped; frames already yielded are good."""

    state: State | None = None
    """At the last good frame; `Solver(..., start=state)` goes on from there, with a smaller step if its scene has
    one."""


@dataclass(frozen=True, eq=False)
class State:
    """A solver's memory at a recorded frame. At a frame the grid is empty: momentum has just come back from it."""

    frame: int
    """Number of the frame."""
    arrays: dict[str, np.ndarray] = field(repr=False)
    """Positions, velocities, strains, what plastic flow left, contact and the body, by name, in the solver's own
    order of particles and precision."""


class Memory:
    """The arrays that last from frame to frame, by name, and what was in them at the last good frame."""

    def __init__(self, arrays: Mapping[str, wp.array]) -> None:
        self._arrays = dict(arrays)
        self._good = {name: wp.empty_like(array) for name, array in self._arrays.items()}
        self._frame: int | None = None

    def keep(self, frame: int) -> None:
        """What is there now is good, and is what frame number `frame` shows."""
        for name, array in self._arrays.items():
            wp.copy(self._good[name], array)
        self._frame = frame

    def state(self) -> State | None:
        """The last good frame, as a copy; None before the first."""
        if self._frame is None:
            return None
        return State(self._frame, {name: array.numpy().copy() for name, array in self._good.items()})

    def load(self, state: State) -> None:
        """Bring back what `state` holds; SceneError if it is of a scene or of effects with other arrays."""
        if set(state.arrays) != set(self._arrays):
            odd = sorted(set(state.arrays) ^ set(self._arrays))[0]
            raise SceneError(f"the state to start from does not fit: {odd!r} is on one side only")
        for name, array in self._arrays.items():
            found, wanted = state.arrays[name], array.numpy()
            if found.shape != wanted.shape:
                raise SceneError(
                    f"the state to start from does not fit: {name} has shape {found.shape} and not {wanted.shape}"
                )
            if not np.isfinite(found).all():
                raise SceneError(f"the state to start from is not good: {name} is not finite")
            array.assign(found.astype(wanted.dtype))
