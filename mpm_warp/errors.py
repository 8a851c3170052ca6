"""What can go wrong, said to the user in one line."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .state import State

__all__ = ["SceneError", "SolverStopped"]


class SceneError(ValueError):
    """A scene that cannot be simulated: what, where, what is allowed."""


class SolverStopped(RuntimeError):
    """The solver met a non-finite or unphysical value and stopped; frames already yielded are good."""

    state: State | None = None
    """At the last good frame; `Solver(..., start=state)` goes on from there, with a smaller step if its scene has
    one."""
