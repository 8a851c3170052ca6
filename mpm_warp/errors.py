"""What can go wrong, said to the user in one line."""

from __future__ import annotations

__all__ = ["SceneError", "SolverStopped"]


class SceneError(ValueError):
    """A scene that cannot be simulated: what, where, what is allowed."""


class SolverStopped(RuntimeError):
    """The solver met a non-finite or unphysical value and stopped; frames already yielded are good."""
