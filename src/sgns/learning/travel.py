"""Slow dry soil follows the way a tool travels, not the time that it takes.

Dynamics learn from tools that move by so much per frame, and in every step they err a little: along a path much slower
than that, or at rest, the errors of thousands of steps add up to soil that flows on its own. There the soil takes a
step only each time that the tool has travelled as far as the slowest trained one does in a frame.

Shapes: T frames, M body points.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from sgns.reduction.reduced import ReducedRun

__all__ = ["Travel", "distance", "markers", "slowest_travel", "stepped_frames"]

# A tool that moves less than this in a frame [m] rests: round-off of poses, not motion.
_STILL = 1e-9
# Of the training frames in which the tool moves this share may be slower than what is called the slowest: tools stop
# within a frame. As it is found again in paths of the same kind, it is lowered by more than round-off.
_STOPPING, _ROUNDING = 0.01, 0.01


class Travel(NamedTuple):
    """How a tool has moved, as far as the next step of the soil depends on it.

    Attributes:
        least: How far it moves in a frame at least that is not called slow [m].
        settling: Frames that the soil follows the clock after that: what was thrown up comes down.
        here: Where its markers are (see `markers`) [m], shape (M + 1, 3).
        stepped: Where they were when the soil took its last step.
        slow: Frames since it was last not slow.
        steps: Whether the soil takes a step into this frame.
    """

    least: float
    settling: int
    here: np.ndarray
    stepped: np.ndarray
    slow: int
    steps: bool

    @classmethod
    def along(cls, given: np.ndarray, least: float, settling: int) -> Travel:
        """In the last of some given frames of markers (any, M + 1, 3), before which it rested."""
        travel = cls(max(least, _STILL), settling, given[0], given[0], settling, True)
        for here in given[1:]:
            travel = travel.moved(here)
        return travel._replace(stepped=given[-1], steps=True)

    def moved(self, here: np.ndarray) -> Travel:
        """One frame later."""
        slow = 0 if distance(here, self.here) >= self.least else self.slow + 1
        steps = slow < self.settling or bool(distance(here, self.stepped) >= self.least)
        return self._replace(here=here, stepped=here if steps else self.stepped, slow=slow, steps=steps)


def stepped_frames(path: np.ndarray, given: int, least: float, settling: int) -> np.ndarray:
    """Numbers of the frames of a path that the soil takes a step into, and before them of those that are given.

    Args:
        path: Markers [m], shape (T, M + 1, 3).
        given: Frames at the start that are given: 1 for a bed at rest, or d.
        least: See `Travel`.
        settling: See `Travel`.
    """
    travel = Travel.along(path[:given], least, settling)
    if (distance(path[given:], path[given - 1 : -1]) >= travel.least).all():
        return np.arange(len(path))  # as most paths; one by one it takes as long as the steps of many paths
    frames = list(range(given))
    for t in range(given, len(path)):
        travel = travel.moved(path[t])
        if travel.steps:
            frames.append(t)
    return np.array(frames)


def markers(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """What shows how far a tool moves: its centre of mass and its points, shape (T, M + 1, 3).

    Args:
        poses: Shape (T, 7).
        points: World frame [m], shape (T, M, 3).
    """
    return np.concatenate([np.asarray(poses)[:, None, :3], points], axis=1)


def distance(here: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Of the marker that is furthest from where it was [m], shape (...); markers of shape (..., M + 1, 3)."""
    with np.errstate(over="ignore"):  # of a tool that is nowhere
        return np.sqrt(np.square(here - there).sum(axis=-1).max(axis=-1))


def slowest_travel(runs: Sequence[ReducedRun]) -> float:
    """Distance that the tool moves at least in a frame while it moves in some runs [m]; 0 if it never does."""
    paths = [markers(run.pose, run.body_points) for run in runs]
    moved = np.concatenate([distance(path[1:], path[:-1]) for path in paths])
    moving = moved[moved > _STILL]
    return (1 - _ROUNDING) * float(np.quantile(moving, _STOPPING)) if len(moving) else 0.0
