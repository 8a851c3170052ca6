"""How far a path leaves what the training runs covered: a network answers there, too, but nobody has taught it.

Letters: T frames, M body points, r modes, K context numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from mpm_warp.poses import in_world_frame
from mpm_warp.settings import short_repr
from sgns.model.features import body_track, context_of, pose_step
from sgns.reduction.reduce import ReducedRun

NOTEWORTHY = 0.05
"""Excess above which a path is called unlike the training runs; held-out runs of the same kind stay below it
(experiments/stability/)."""
FAR = 0.5
"""Excess of a tool above which a simulator warns by itself."""
# A component that varies less than the others of its quantity is given this share of their range as its own.
_FLOOR = 0.1
_AXES = ("x", "y", "z")
POSITION = "the tool's position"
LOWEST = "the tool's lowest point"
DISPLACEMENT = "the tool's displacement per frame"
POINTS = "the number of the tool's points"
ORIENTATION = "the tool's orientation"
ROTATION = "the tool's rotation per frame"
SOIL = "the soil's state"
VELOCITY = "the soil's velocity"


class Excess(NamedTuple):
    """How far every frame lies outside the training range: the distance of the worst quantity from its range, in widths
    of that range [1], shape (T,), 0 inside; and its name."""

    amount: np.ndarray
    quantity: list[str]

    def __repr__(self) -> str:
        return short_repr(self)

    @property
    def largest(self) -> float:
        """Over all frames [1]; NaN where a frame is not finite."""
        return float(self.amount.max())

    def words(self) -> str:
        """Where a noteworthy excess begins and what it is at its largest; nothing if there is none."""
        beyond = ~(self.amount <= NOTEWORTHY)
        if not beyond.any():
            return ""
        worst = int(self.amount.argmax())
        first = int(beyond.argmax())
        owner = " ".join(self.quantity[first].split()[:2])
        what = {"the tool's": "path", "the soil's": "predicted soil"}.get(owner, "scene")
        return (
            f"from frame {first} on the {what} is unlike the training runs; at frame {worst} "
            f"{self.quantity[worst]} is {self.amount[worst]:.2g} times its training range outside of it"
        )


@dataclass(frozen=True, eq=False)
class TrainingRange:
    """Smallest and largest values of tool, soil and context in the training runs, of every component [its unit]."""

    low: dict[str, np.ndarray]
    high: dict[str, np.ndarray]

    @classmethod
    def of(
        cls, runs: Sequence[ReducedRun], num_modes: int, context: Sequence[str], points: bool = False
    ) -> TrainingRange:
        """Of the first modes of the training runs, and of the numbers of their scenes that the dynamics are told, by
        their keys; with `points` the dynamics see the body's points, so that their number counts, too."""
        low: dict[str, np.ndarray] = {}
        high: dict[str, np.ndarray] = {}
        for run in runs:
            numbers = dict(zip(context, context_of(run.scene, context), strict=True))
            found = quantities(run.pose, run.body_points, run.latent[:, :num_modes], numbers)
            if not points:
                del found[POINTS]
            for name, values in found.items():
                low[name] = np.minimum(low.get(name, np.inf), values.min(axis=0))
                high[name] = np.maximum(high.get(name, -np.inf), values.max(axis=0))
        return cls(low, high)

    @classmethod
    def from_plain(cls, plain: Mapping[str, Mapping[str, Sequence[float]]]) -> TrainingRange:
        """Of what `plain` gave.

        Raises:
            KeyError, TypeError, ValueError, AttributeError: Anything else.
        """
        low, high = (
            {str(name): np.array(values, dtype=np.float64) for name, values in plain[side].items()}
            for side in ("low", "high")
        )
        if [(name, v.shape) for name, v in low.items()] != [(name, v.shape) for name, v in high.items()]:
            raise ValueError("the training range's two ends differ in what they tell of")
        if not all(v.ndim == 1 and len(v) and (v <= high[name]).all() for name, v in low.items()):
            raise ValueError("the training range is not one of numbers in order")
        return cls(low, high)

    def plain(self) -> dict[str, Any]:
        """Plain values, for a checkpoint's card."""
        return {
            side: {name: values.tolist() for name, values in getattr(self, side).items()}
            for side in ("low", "high")
        }

    def soil(self, margin: float) -> tuple[np.ndarray, np.ndarray]:
        """Smallest and largest modes, one after another [m], so many widths of their range outside of it."""
        low, high = (side[SOIL] for side in (self.low, self.high))
        return low - margin * widths(low, high), high + margin * widths(low, high)

    @cached_property
    def _box(self) -> tuple[list[float], list[float]]:
        """Smallest and largest values of the tool that are not far outside, in the order of `pose_step`, then of its
        lowest point."""
        low, high = np.full(16, -np.inf), np.full(16, np.inf)
        for first, name in ((0, POSITION), (3, ORIENTATION), (9, DISPLACEMENT), (12, ROTATION), (15, LOWEST)):
            if name in self.low:
                margin = FAR * widths(self.low[name], self.high[name])
                part = slice(first, first + len(margin))
                low[part], high[part] = self.low[name] - margin, self.high[name] + margin
        return low.tolist(), high.tolist()

    def far(self, before: np.ndarray, pose: np.ndarray, points: np.ndarray) -> bool:
        """Whether a tool's position, orientation, lowest point, or their change from one pose (7,) to the next is far
        outside: what of `excess` takes microseconds. Body points in the body frame (M, 3) [m]."""
        _, _, z, i, j, k, w = there = pose.tolist()
        if len(points):
            z += float((points @ (2 * (i * k - j * w), 2 * (j * k + i * w), 1 - 2 * (i * i + j * j))).min())
        values = (*pose_step(before.tolist(), there), z)
        return any(v < low or v > high for v, low, high in zip(values, *self._box, strict=True))

    def in_millimetres(self, poses: np.ndarray) -> bool:
        """Whether a position of some poses (T, 7) is far outside, but would not be if it was in millimetres."""
        low, high = (np.array(side[:3]) for side in self._box)
        place = poses[:, :3]
        inside, fits = (((low <= p) & (p <= high)).all(axis=1) for p in (place, 1e-3 * place))
        return bool((~inside & fits).any())

    def excess(
        self,
        poses: np.ndarray,
        points: np.ndarray,
        latent: np.ndarray,
        context: Mapping[str, float],
        of: str = "",
        paths: int = 1,
    ) -> Excess | None:
        """How far a path of poses (T, 7), body points in the body frame (M, 3) [m] and modes (T, r, 3) [m] is outside;
        None where the tool is nowhere. Fewer modes than those of the training are compared with the first of them.
        Quantities count whose names begin with `of`. The frames may be those of several paths, all of one length, one
        after another."""
        if not np.isfinite(poses).all():
            return None
        amounts, names = [], []
        found = quantities(poses, in_world_frame(poses, points), latent, context, paths)
        for name in (name for name in self.low if name.startswith(of)):
            values = found[name]
            low, high = (side[name][: values.shape[1]] for side in (self.low, self.high))
            amounts.append(np.maximum(np.maximum(low - values, values - high), 0.0) / widths(low, high))
            names += [f"{name}{of}" for of in components(name, values.shape[1])]
        amount = np.concatenate(amounts, axis=1)
        worst = amount.argmax(axis=1)
        return Excess(amount[np.arange(len(amount)), worst], [names[i] for i in worst])


def quantities(
    poses: np.ndarray, points: np.ndarray, latent: np.ndarray, context: Mapping[str, float], paths: int = 1
) -> dict[str, np.ndarray]:
    """What is compared, by name; each of shape (T, components). Motions of the first frame of every path are zero."""
    track = body_track(poses, None, "pose")
    moved, place = track.motion[:, 0].numpy(), np.asarray(poses)[:, :3]
    heights = points[:, :, 2].min(axis=1) if points.shape[1] else place[:, 2]
    latent = np.asarray(latent, dtype=np.float64).reshape(len(place), -1)
    with np.errstate(invalid="ignore"):  # of a soil that is not finite
        velocity = np.diff(latent, axis=0, prepend=latent[:1])
    first = slice(None, None, len(place) // paths)
    moved[first] = velocity[first] = 0.0
    return {
        POSITION: place,
        LOWEST: heights[:, None],
        POINTS: np.full((len(place), 1), float(points.shape[1])),
        ORIENTATION: track.orientation[:, 0].numpy(),
        DISPLACEMENT: moved[:, :3],
        ROTATION: moved[:, 3:],
        SOIL: latent,
        VELOCITY: velocity,
        **{key: np.full((len(place), 1), value) for key, value in context.items()},
    }


def widths(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Unit of every component's excess: its range, but not much less than the widest of its quantity.

    Where nothing varies it is the size of what is there, or one where all is zero.
    """
    extent, size = high - low, float(np.maximum(np.abs(low), np.abs(high)).max())
    widest = float(extent.max())
    if widest <= 1e-12 * size:
        return np.full_like(extent, size or 1.0)
    return np.maximum(extent, _FLOOR * widest)


def components(name: str, count: int) -> list[str]:
    """What to add to a quantity's name for each of its components."""
    if name.startswith("the soil's"):
        return [f" (mode {i // 3 + 1}, {_AXES[i % 3]})" for i in range(count)]
    return [f" ({axis})" for axis in _AXES] if count == 3 else [""] * count
