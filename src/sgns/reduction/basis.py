"""The subspace of the soil's motion: modes, what they explain, and the file they are kept in.

Letters: n particles, r modes; "..." stands for any leading axes, such as frames.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mpm_warp.settings import short_repr
from sgns.config import UserError
from sgns.data.files import one_line, parse_json
from sgns.data.hdf5 import BROKEN, new_hdf5, open_hdf5, own_attribute, own_dataset
from sgns.data.run import Run, frame_chunks
from sgns.reduction.closure import Closure

CENTRINGS = ("scalar", "particle", "particle_axis")
"""What is subtracted before modes are found: one number, a mean per particle, one per particle and axis."""
_FORMAT = "sgns-basis"
_FORMAT_VERSION = 1
_ARRAYS = ("mean", "modes", "eigenvalues")
_NUMBERS = ("total_variance", "displacement_variance", "residual_variance")
_WORDS = ("centring", "arrangement_hash")
_CLOSURE = "closure_"  # begins the names of its arrays


@dataclass(frozen=True, eq=False)
class Basis:
    """Orthonormal modes of the soil and the variance each explains.

    Attributes:
        mean: What is subtracted before projecting [m], (n, 3) float64, whatever the centring.
        modes: Orthonormal columns, (n, r) float64; the largest entry of each is positive.
        eigenvalues: Population variance along each mode over the (frame, axis) rows [m^2], falling, (r,) float64.
        total_variance: Sum of all eigenvalues, also those of modes not kept [m^2].
        displacement_variance: The same when every particle is centred on every axis: the motion alone [m^2].
        centring: One of `CENTRINGS`.
        arrangement_hash: The particle arrangement the modes belong to.
        fitted_on: Names of the runs the basis was fitted on.
        residual_variance: Variance outside the modes [m^2]; stored because `total_variance` minus the
            eigenvalues cancels when the layout dwarfs the motion. None: computed by that difference.
        closure: What follows from the coordinates along further modes; None: nothing.
    """

    __repr__ = short_repr

    mean: Tensor
    modes: Tensor
    eigenvalues: Tensor
    total_variance: float
    displacement_variance: float
    centring: str
    arrangement_hash: str = ""
    fitted_on: list[str] = field(default_factory=list)
    residual_variance: float | None = None
    closure: Closure | None = None

    def __post_init__(self) -> None:
        check_centring(self.centring)
        shapes = [tuple(x.shape) for x in (self.mean, self.modes, self.eigenvalues)]
        if self.modes.dim() != 2 or shapes[0] != (shapes[1][0], 3) or shapes[2] != (shapes[1][1],):
            raise UserError(
                f"basis arrays do not belong together: mean {shapes[0]}, modes {shapes[1]}, eigenvalues "
                f"{shapes[2]}; expected (n, 3), (n, r) and (r,)"
            )
        if (one := self.closure) and (len(one.modes), len(one.mean)) != self.modes.shape:
            raise UserError(
                f"the closure is of {len(one.mean)} modes of {len(one.modes)} particles, the basis has "
                f"{self.num_modes} of {self.num_particles}"
            )
        if self.residual_variance is None:
            rest = max(self.total_variance - float(self.eigenvalues.sum()), 0.0)
            object.__setattr__(self, "residual_variance", rest)

    @property
    def num_modes(self) -> int:
        """Number of modes r."""
        return self.modes.shape[1]

    @property
    def num_particles(self) -> int:
        """Number of particles n."""
        return self.modes.shape[0]

    def transform(self, positions: Tensor | np.ndarray) -> Tensor:
        """Reduced positions [m] of `positions` [m]: (..., n, 3) -> (..., r, 3) float64.

        Raises:
            UserError: If the particle count differs from the basis.
        """
        x = self._input(positions, "positions", self.num_particles)
        return ((x - self.mean).transpose(-1, -2) @ self.modes).transpose(-1, -2).contiguous()

    def inverse(self, latent: Tensor | np.ndarray) -> Tensor:
        """Particle positions [m] of reduced positions [m], the closure's part included: (..., r, 3) -> (..., n, 3)
        float64.

        Raises:
            UserError: If the mode count differs from the basis.
        """
        z = self._input(latent, "reduced positions", self.num_modes)
        soil = (z.transpose(-1, -2) @ self.modes.T).transpose(-1, -2).contiguous().add_(self.mean)
        return soil if self.closure is None else soil.add_(self.closure.displacement(z))

    def to(self, device: str | torch.device) -> Basis:
        """The same basis with its arrays on a torch device."""
        closure = self.closure and self.closure.to(device)
        return replace(self, **{key: getattr(self, key).to(device) for key in _ARRAYS}, closure=closure)

    def same_modes(self, modes: Tensor) -> bool:
        """Whether these are its modes (n, r), up to those that are kept with fewer digits."""
        mine = self.modes
        return mine.shape == modes.shape and bool((mine - modes).abs().max() <= 1e-3 * mine.abs().max())

    def sliced(self, r: int) -> Basis:
        """The basis of the first `r` modes, with the same mean and total variance; a closure is of all of them."""
        if not 1 <= r <= self.num_modes:
            raise UserError(
                f"cannot keep {r} modes; the basis has {self.num_modes}; allowed: 1 to {self.num_modes}"
            )
        return replace(
            self,
            modes=self.modes[:, :r].clone(),
            eigenvalues=self.eigenvalues[:r].clone(),
            residual_variance=float(self._residual()[r]),
            closure=self.closure if r == self.num_modes else None,
        )

    def energy(self, r: int | None = None) -> float | Tensor:
        """Share of the total variance in the first `r` modes, the paper's measure; without r for each of 1 to
        num_modes, (num_modes,)."""
        return self._explained(self.total_variance, r)

    def displacement_energy(self, r: int | None = None) -> float | Tensor:
        """One minus residual over displacement variance: the modes' share of the motion; r as in `energy`.

        Negative when modes are so few that part of the static layout is lost too (`scalar`, `particle`).
        """
        return self._explained(self.displacement_variance, r)

    def residual_mse(self, r: int | None = None) -> float | Tensor:
        """Mean square of inverse(transform(x)) - x on the fitted data [m^2] per entry; r as in `energy`.

        Exact if the stream never had more directions than were tracked, else an upper bound.
        """
        return self._at(self._residual() / self.num_particles, r)

    def state(self) -> dict[str, Any]:
        """Tensors and plain Python values, fit for a checkpoint that loads under `weights_only`."""
        values = {key: getattr(self, key) for key in (*_ARRAYS, *_NUMBERS, *_WORDS)}
        closure = {} if self.closure is None else self.closure.state()
        values |= {f"{_CLOSURE}{name}": value for name, value in closure.items()}
        return {"format_version": _FORMAT_VERSION, **values, "fitted_on": list(self.fitted_on)}

    @classmethod
    def from_state(cls, state: dict[str, Any], where: str = "basis state") -> Basis:
        """Basis of a dict made by `state`; errors say `where` it comes from.

        Raises:
            UserError: If a key is missing, a value is not finite, shapes disagree or modes are askew.
        """
        try:
            if state["format_version"] > _FORMAT_VERSION:
                raise UserError(
                    f"{where}: basis format {state['format_version']} is newer than this program reads "
                    f"({_FORMAT_VERSION}); update sgns"
                )
            values: dict[str, Any] = {k: torch.as_tensor(state[k]).to(torch.float64) for k in _ARRAYS}
            values |= {k: float(state[k]) for k in _NUMBERS} | {k: str(state[k]) for k in _WORDS}
            values["fitted_on"] = [str(name) for name in state["fitted_on"]]
            closure = {k.removeprefix(_CLOSURE): state[k] for k in state if k.startswith(_CLOSURE)}
            values["closure"] = Closure(**closure) if closure else None
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise UserError(
                f"{where}: not a basis ({error!r:.300}); fit it again with `sgns reduce`"
            ) from error
        numbers = [values[key] for key in (*_ARRAYS, *_NUMBERS)] + list(closure.values())
        if not all(bool(torch.as_tensor(value).isfinite().all()) for value in numbers):
            raise UserError(
                f"{where}: the basis holds values that are not finite; fit it again with `sgns reduce`"
            )
        basis = cls(**values)
        deviation = orthonormality_error(basis.modes)
        # Of modes kept in half precision, as shipped checkpoints do, the last digit.
        if deviation > (1e-3 if getattr(state["modes"], "dtype", None) == torch.float16 else 1e-6):
            raise UserError(
                f"{where}: modes are not orthonormal (off by {deviation:.1e}); fit again with `sgns reduce`"
            )
        return basis

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the basis to one HDF5 file; it appears complete or not at all.

        Raises:
            UserError: If the file cannot be written.
        """
        with new_hdf5(Path(path)) as file:
            for key, value in self.state().items():
                if isinstance(value, Tensor):
                    # Checksummed, so that a damaged file is an error and not a wrong basis.
                    array = value.detach().cpu().numpy()
                    file.create_dataset(key, data=array, chunks=True, fletcher32=True)
                elif isinstance(value, list):
                    # A dataset, because an attribute holds 64 kB at most.
                    file.create_dataset(key, data=json.dumps(value))
                else:
                    file.attrs[key] = value
            file.attrs["format"] = _FORMAT
            file.attrs["si_unit"] = "mean: m; eigenvalues and variances: m2; modes: 1"

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Basis:
        """Read a basis written by `save`.

        Raises:
            UserError: If the file is missing, truncated, damaged or not a basis.
        """
        path = Path(path)
        if not path.is_file():
            raise UserError(f"no basis file at {path}; make one with `sgns reduce`")
        try:
            with open_hdf5(path) as file:
                if own_attribute(file, "format") != _FORMAT:
                    raise UserError(f"{path}: an HDF5 file but not a basis; make one with `sgns reduce`")
                keys = ("format_version", *_NUMBERS, *_WORDS)
                state = {key: own_attribute(file, key) for key in keys if key in file.attrs}
                state["fitted_on"] = parse_json(own_dataset(file, "fitted_on")[()])
                arrays = [*_ARRAYS, *(key for key in file if key.startswith(_CLOSURE))]
                state.update((key, torch.from_numpy(own_dataset(file, key)[()])) for key in arrays)
        except (*BROKEN, AttributeError) as error:
            raise UserError(
                f"{path}: not a readable basis, truncated or damaged ({one_line(error)}); fit again with `sgns reduce`"
            ) from error
        return cls.from_state(state, where=str(path))

    def _input(self, values: Tensor | np.ndarray, what: str, size: int) -> Tensor:
        x = (values if isinstance(values, Tensor) else torch.tensor(np.asarray(values))).to(self.modes)
        if x.dim() < 2 or tuple(x.shape[-2:]) != (size, 3):
            raise UserError(f"{what} have shape {tuple(x.shape)}; this basis takes (..., {size}, 3)")
        return x

    def _residual(self) -> Tensor:
        """Variance outside the first 0, ..., r modes [m^2], (r + 1,), summed so that nothing cancels."""
        tail = torch.cat([self.eigenvalues, self.eigenvalues.new_tensor([self.residual_variance])])
        return tail.flip(0).cumsum(0).flip(0)

    def _explained(self, variance: float, r: int | None) -> float | Tensor:
        residual = self._residual()
        if variance > 0.0:
            return self._at(1.0 - residual / variance, r)
        # Nothing varies: all of it is explained once nothing is left over.
        return self._at(torch.where(residual > 0.0, -math.inf, 1.0).to(residual), r)

    def _at(self, values: Tensor, r: int | None) -> float | Tensor:
        if r is None:
            return values[1:]
        if not 0 <= r <= self.num_modes:
            raise UserError(
                f"asked for {r} modes; the basis has {self.num_modes}; allowed: 0 to {self.num_modes}"
            )
        return float(values[r])


def orthonormality_error(modes: Tensor) -> float:
    """Largest entry of |modes^T modes - 1|."""
    gram = modes.T @ modes
    return float((gram - torch.eye(len(gram)).to(gram)).abs().max()) if len(gram) else 0.0


def check_centring(centring: str) -> None:
    """Raise UserError unless `centring` is one of `CENTRINGS`."""
    if centring not in CENTRINGS:
        raise UserError(f"unknown centring {centring!r}; allowed: {', '.join(CENTRINGS)}")


# --- What the first r modes of a basis hold, for every r up to R: energies and errors --------------------


@dataclass(frozen=True)
class ReductionCurves:
    """What the subspace holds for r = 1 … R modes, shape (R,)."""

    energy: np.ndarray  # the paper's energy on the training runs
    displacement_energy: np.ndarray  # share of the motion's variance on the training runs
    training: np.ndarray  # reduction MSE on the training runs [m²]
    held_out: np.ndarray  # reduction MSE on other runs [m²] for r = 0 … R, shape (R + 1,); NaN without runs


def reduction_curves(basis: Basis, paths: Sequence[Path]) -> ReductionCurves:
    """Energy and reconstruction error of a basis on the runs that it was fitted on and on the given ones."""
    return ReductionCurves(
        np.asarray(basis.energy()),
        np.asarray(basis.displacement_energy()),
        np.asarray(basis.residual_mse()),
        reconstruction_curve(paths, basis),
    )


def left_out(path: Path, basis: Basis, since: int) -> tuple[np.ndarray, np.ndarray]:
    """Squares that the modes do not see, summed over particles and axes [m²], shape (T,) each: of a run's positions in
    every frame, and of the way from frame `since`. With orthonormal modes: all squares less those of the modes."""
    found: list[list[Tensor]] = []
    with Run(path) as run:
        start = torch.from_numpy(run.positions(since)).to(basis.mean)
        first = basis.transform(start)
        for frames in frame_chunks(run.particle_count, run.frame_count):
            positions = torch.from_numpy(run.positions(frames)).to(basis.mean)
            latent = basis.transform(positions)
            differences = (positions - basis.mean, latent), (positions - start, latent - first)
            found.append([a.square().sum((1, 2)) - b.square().sum((1, 2)) for a, b in differences])
    here, way = (torch.cat(parts).clamp_min(0.0).numpy() for parts in zip(*found, strict=True))
    return here, way


def outside(latent: np.ndarray, unseen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """As `left_out` since frame 0, of fewer modes: from the coordinates along those left out (T, c, 3) [m] and what all
    modes do not see (T, 2) [m²]."""
    here, way = (np.square(part).sum((1, 2)) for part in (latent, latent - latent[:1]))
    return here + unseen[:, 0], way + unseen[:, 1]


def reconstruction_curve(paths: Sequence[Path], basis: Basis) -> np.ndarray:
    """Reduction MSE of runs in one pass: mean over frames, particles and axes [m²] for r = 0 … R, shape (R + 1,); NaN
    without runs.

    Orthonormal modes take away their share one after the other: the residual with r modes is ‖S − S̄‖² less the squared
    first r coordinates.
    """
    total, taken, count = 0.0, np.zeros(basis.num_modes), 0
    for path in paths:
        with Run(path) as run:
            for frames in frame_chunks(run.particle_count, run.frame_count):
                positions = torch.from_numpy(run.positions(frames)).to(basis.mean)
                total += float((positions - basis.mean).square().sum())
                taken += basis.transform(positions).square().sum(dim=(0, 2)).cpu().numpy()
                count += positions.numel()
    if count == 0:
        return np.full(basis.num_modes + 1, np.nan)
    residual = total - np.concatenate([[0.0], np.cumsum(taken)])
    return np.maximum(residual, 0.0) / count
