"""Modes that nobody steps, as a function of those that are: soil on a curved surface instead of a flat one.

    S = S̄ + U z + W g(z)

U are the r modes that are stepped, z their coordinates, W the closure modes after them. g is found by kernel ridge
regression on training frames; the width of its kernel and its penalty are chosen on other runs.

Letters: T frames, n particles, r modes, c closure modes, k centres.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from mpm_warp.settings import short_repr
from sgns.config import UserError

# On the runs of `dataset=quick` 2000 centres do no better than 1000.
_CENTRES = 1000
_FRAMES = 4000  # most that are fitted to
_WIDTHS = (0.5, 0.8, 1.3)  # of the kernel, in RMS distances of a frame from the mean
_PENALTIES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1.0)
_JITTER = 1e-6  # beside the kernel's one: centres may be alike, such as a bed at rest
_STILL = 0.01  # least scale of a coordinate, as a share of the largest


@dataclass(frozen=True, eq=False)
class Closure:
    """g and the modes W that it moves; float32, computed in float64 up to the coordinates.

    g(z) = offset + Σ weightᵢ exp(−|x − centreᵢ|²) with x = (z − mean) / scale. Far from all centres it is the offset,
    the mean of the training frames.

    Attributes:
        modes: Orthonormal columns [1], (n, c); numbers of half precision, as which they are kept.
        mean: Of z in the training frames [m], (r, 3).
        scale: Of z, the width of the kernel included [m], (r, 3).
        centres: Training frames in these units [1], (k, 3 r).
        weights: [m], (k, 3 c).
        offset: [m], (c, 3).
    """

    __repr__ = short_repr

    modes: Tensor
    mean: Tensor
    scale: Tensor
    centres: Tensor
    weights: Tensor
    offset: Tensor

    def __post_init__(self) -> None:
        for one in fields(self):
            object.__setattr__(self, one.name, getattr(self, one.name).float())
        (n, c), (r, _), (k, _) = self.modes.shape, self.mean.shape, self.centres.shape
        wanted = [(n, c), (r, 3), (r, 3), (k, 3 * r), (k, 3 * c), (c, 3)]
        found = [tuple(getattr(self, one.name).shape) for one in fields(self)]
        if found != wanted or not bool((self.scale > 0).all()):
            raise UserError(f"closure arrays of shapes {found} do not belong together")

    @property
    def num_modes(self) -> int:
        """Number of closure modes c."""
        return self.modes.shape[1]

    def to(self, device: str | torch.device) -> Closure:
        """The same on a torch device."""
        return Closure(**{name: value.to(device) for name, value in self.state().items()})

    def state(self) -> dict[str, Tensor]:
        """The arrays by name, as they are kept."""
        return {one.name: getattr(self, one.name) for one in fields(self)} | {"modes": self.modes.half()}

    def coordinates(self, latent: Tensor) -> Tensor:
        """g(z) of reduced positions [m]: (..., r, 3) -> (..., c, 3) float64."""
        x = ((latent.double() - self.mean) / self.scale).flatten(-2)
        found = _kernel(x, self.centres.double()) @ self.weights.double()
        return found.unflatten(-1, (self.num_modes, 3)) + self.offset

    def displacement(self, latent: Tensor) -> Tensor:
        """What the closure adds to the particles' positions [m]: (..., r, 3) -> (..., n, 3) float32."""
        return (self.coordinates(latent).float().transpose(-1, -2) @ self.modes.T).transpose(-1, -2)


class FittedClosure(NamedTuple):
    """A closure, and RMS errors [m] per particle and axis within its modes on the runs that chose it."""

    closure: Closure
    without: float
    error: float


def fit_closure(
    modes: Tensor, r: int, train: Sequence[np.ndarray], validation: Sequence[np.ndarray]
) -> FittedClosure:
    """Fit for every width and penalty on training runs and take what does best on validation runs.

    Without validation runs every third training run chooses, and all are fitted then.

    Args:
        modes: Those that are stepped and those of the closure, (n, r + c).
        r: How many are stepped.
        train: Reduced positions of each run [m], (T, r + c or more, 3).
        validation: Likewise.
    """
    held_out = validation or train[::3]
    # A single run has to do for both.
    fitted = train if validation or len(train) == 1 else [run for i, run in enumerate(train) if i % 3]
    z, y = _frames(held_out, r, modes.shape[1])
    found = (
        (float((closure.coordinates(z) - y).square().sum((1, 2)).mean()), width, penalty, closure)
        for width in _WIDTHS
        for penalty, closure in _closures(modes, fitted, r, width, _PENALTIES)
    )
    error, width, penalty, closure = min(found, key=lambda one: one[0])
    if len(fitted) < len(train):
        [(_, closure)] = _closures(modes, train, r, width, [penalty])
    entries = 3 * len(modes)
    without = float((y - closure.offset).square().sum((1, 2)).mean())
    return FittedClosure(closure, (without / entries) ** 0.5, (error / entries) ** 0.5)


def _frames(runs: Sequence[np.ndarray], r: int, last: int) -> tuple[Tensor, Tensor]:
    """Coordinates of the modes that are stepped (T, r, 3) and of the closure's (T, c, 3) [m], runs joined; of many
    frames an even choice."""
    joined = torch.from_numpy(np.concatenate([run[:, :last] for run in runs]))
    return joined[:: math.ceil(len(joined) / _FRAMES)].split([r, last - r], dim=1)


def _closures(
    modes: Tensor, runs: Sequence[np.ndarray], r: int, width: float, penalties: Sequence[float]
) -> Iterator[tuple[float, Closure]]:
    """Closures of one width for every penalty: least squares with a penalty on the smoothness of g (the norm of the
    kernel's space), of functions that the centres span."""
    z, y = _frames(runs, r, modes.shape[1])
    mean, offset = z.mean(0), y.mean(0)
    scale = (z - mean).square().mean(0).sqrt()
    scale = scale.clamp_min(_STILL * float(scale.max())) * (width * math.sqrt(3 * r))
    x = ((z - mean) / scale).flatten(1)
    centres = x[:: math.ceil(len(x) / _CENTRES)].float()
    seen, smooth = (_kernel(points, centres.double()) for points in (x, centres.double()))
    gram, target = seen.T @ seen / len(x), seen.T @ (y - offset).flatten(1) / len(x)
    smooth.diagonal().add_(_JITTER)
    for penalty in penalties:
        weights = torch.linalg.solve(gram + penalty * smooth, target)
        yield penalty, Closure(modes[:, r:].half(), mean, scale, centres, weights, offset)


def _kernel(x: Tensor, centres: Tensor) -> Tensor:
    """exp(−|x − c|²): (..., p) and (k, p) -> (..., k)."""
    squares = torch.cdist(x.reshape(-1, x.shape[-1]), centres).square()
    return squares.neg().exp().reshape(*x.shape[:-1], len(centres))
