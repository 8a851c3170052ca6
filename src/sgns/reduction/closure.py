"""Modes that nobody steps, as a function of those that are: soil on a curved surface instead of a flat one.

    S = S̄ + U z + W g(z)

U are the r modes that are stepped, z their coordinates, W the closure modes after them. g is a sum of given functions
of z, Gaussians or products of two coordinates, whose weights are found by ridge regression on training frames. How wide
these functions are and how much large weights cost is chosen on other runs. Both see coordinates with noise, as those
of a rollout have errors.

Letters: T frames, n particles, r modes, c closure modes, k functions.
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

# On the runs of `dataset=quick` half as many of both do as well.
_CENTRES = 2000
_FRAMES = 8000  # most that are fitted to
_WIDTHS = (1.0, 2.0, 4.0)  # of the functions, in RMS distances of a frame from the mean
_PENALTIES = tuple(10.0**exponent for exponent in range(-7, 1))
# Of a coordinate, as a share of its size. Rollouts miss by about so much, and a g that is fitted to true coordinates
# alone makes more of it than it is worth (experiments/reduction).
_NOISE = 0.2
_JITTER = 1e-6  # beside the kernel's one: centres may be alike, such as a bed at rest


@dataclass(frozen=True, eq=False)
class Closure:
    """g and the modes W that it moves; float32, computed in float64 up to the coordinates.

    g(z) = offset + Σ weightᵢ φᵢ(x) with x = (z − mean) / scale. With centres φᵢ = exp(−|x − centreᵢ|²): far from all
    of them g is the offset, the mean of the training frames. Without, φᵢ are the products of any two of the 3 r
    coordinates and 1.

    Attributes:
        modes: Orthonormal columns [1], (n, c); numbers of half precision, as which they are kept.
        mean: Of z in the training frames [m], (r, 3).
        scale: Width of the functions [m], (1,).
        weights: [m], (k, 3 c).
        offset: [m], (c, 3).
        centres: Training frames in these units [1], (k, 3 r); None: products.
    """

    __repr__ = short_repr

    modes: Tensor
    mean: Tensor
    scale: Tensor
    weights: Tensor
    offset: Tensor
    centres: Tensor | None = None

    def __post_init__(self) -> None:
        for name, value in self.arrays().items():
            object.__setattr__(self, name, value.float())
        (n, c), (r, _) = self.modes.shape, self.mean.shape
        k = (3 * r + 1) * (3 * r + 2) // 2 if self.centres is None else len(self.centres)
        wanted = [(n, c), (r, 3), (1,), (k, 3 * c), (c, 3), (k, 3 * r)]
        found = [tuple(value.shape) for value in self.arrays().values()]
        if found != wanted[: len(found)] or not bool((self.scale > 0).all()):
            raise UserError(f"closure arrays of shapes {found} do not belong together")

    @property
    def kind(self) -> str:
        """As `reduction.closure` names it."""
        return "quadratic" if self.centres is None else "kernel"

    @property
    def num_modes(self) -> int:
        """Number of closure modes c."""
        return self.modes.shape[1]

    def to(self, device: str | torch.device) -> Closure:
        """The same on a torch device."""
        return Closure(**{name: value.to(device) for name, value in self.arrays().items()})

    def arrays(self) -> dict[str, Tensor]:
        """Those that there are, by name."""
        found = {one.name: getattr(self, one.name) for one in fields(self)}
        return {name: value for name, value in found.items() if value is not None}

    def state(self) -> dict[str, Tensor]:
        """The arrays by name, as they are kept."""
        return self.arrays() | {"modes": self.modes.half()}

    def coordinates(self, latent: Tensor) -> Tensor:
        """g(z) of reduced positions [m]: (..., r, 3) -> (..., c, 3) float64."""
        x = ((latent.double() - self.mean) / self.scale).flatten(-2)
        found = _functions(x, self.centres) @ self.weights.double()
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
    kind: str, modes: Tensor, r: int, train: Sequence[np.ndarray], validation: Sequence[np.ndarray]
) -> FittedClosure:
    """Fit for every width and penalty on training runs and take what does best on validation runs.

    Without validation runs every third training run chooses, and all are fitted then.

    Args:
        kind: `kernel`, Gaussians around training frames, or `quadratic`, products of two coordinates.
        modes: Those that are stepped and those of the closure, (n, r + c).
        r: How many are stepped.
        train: Reduced positions of each run [m], (T, r + c or more, 3).
        validation: Likewise.
    """
    held_out = validation or train[::3]
    # A single run has to do for both.
    fitted = train if validation or len(train) == 1 else [run for i, run in enumerate(train) if i % 3]
    z, y = _frames(held_out, r, modes.shape[1])
    inexact = _inexact(z)

    def rms(error: Tensor) -> float:
        return float((error.square().sum((1, 2)).mean() / (3 * len(modes))).sqrt())

    found = (
        (rms(closure.coordinates(inexact) - y), width, penalty, closure)
        for width in _WIDTHS
        for penalty, closure in _closures(kind, modes, fitted, r, width, _PENALTIES)
    )
    _, width, penalty, closure = min(found, key=lambda one: one[0])
    if len(fitted) < len(train):
        [(_, closure)] = _closures(kind, modes, train, r, width, [penalty])
    return FittedClosure(closure, rms(closure.offset - y), rms(closure.coordinates(z) - y))


def _frames(runs: Sequence[np.ndarray], r: int, last: int) -> tuple[Tensor, Tensor]:
    """Coordinates of the modes that are stepped (T, r, 3) and of the closure's (T, c, 3) [m], runs joined; of many
    frames an even choice."""
    joined = torch.from_numpy(np.concatenate([run[:, :last] for run in runs]))
    return joined[:: math.ceil(len(joined) / _FRAMES)].split([r, last - r], dim=1)


def _inexact(z: Tensor) -> Tensor:
    """Coordinates (T, r, 3) with noise, always the same."""
    size = (z - z.mean(0)).square().mean(0).sqrt()
    return z + _NOISE * size * torch.randn(z.shape, generator=torch.Generator().manual_seed(0), dtype=z.dtype)


def _closures(
    kind: str, modes: Tensor, runs: Sequence[np.ndarray], r: int, width: float, penalties: Sequence[float]
) -> Iterator[tuple[float, Closure]]:
    """Closures of one width for every penalty: least squares with a penalty on the weights, that of the kernel on the
    norm of its space, which is the smoothness of g."""
    z, y = _frames(runs, r, modes.shape[1])
    mean, offset = z.mean(0), y.mean(0)
    scale = width * (z - mean).square().sum((1, 2)).mean(0, keepdim=True).sqrt()
    x = ((_inexact(z) - mean) / scale).flatten(1)
    centres = x[:: math.ceil(len(x) / _CENTRES)].float() if kind == "kernel" else None
    seen = _functions(x, centres)
    gram, target = seen.T @ seen / len(x), seen.T @ (y - offset).flatten(1) / len(x)
    size = torch.eye(len(gram)).double()
    if centres is not None:
        size = _functions(centres.double(), centres) + _JITTER * size
    for penalty in penalties:
        weights = torch.linalg.solve(gram + penalty * size, target)
        yield penalty, Closure(modes[:, r:].half(), mean, scale, weights, offset, centres)


def _functions(x: Tensor, centres: Tensor | None) -> Tensor:
    """φ of coordinates: (..., 3 r) -> (..., k)."""
    if centres is None:
        x = torch.nn.functional.pad(x, (1, 0), value=1.0)
        i, j = torch.triu_indices(x.shape[-1], x.shape[-1], device=x.device)
        return x[..., i] * x[..., j]
    if torch.compiler.is_compiling():  # the other has another form for 25 rows and more
        squares = (x.reshape(-1, 1, x.shape[-1]) - centres.double()).square().sum(-1)
    else:
        squares = torch.cdist(x.reshape(-1, x.shape[-1]), centres.double()).square_()
    return squares.neg_().exp_().reshape(*x.shape[:-1], len(centres))
