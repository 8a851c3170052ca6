"""Streaming principal component analysis over particles.

The data matrix has one row per (frame, axis) and one column per particle, so one basis serves x, y and z and
a mode is a "subspace particle" with a 3-vector for a position: S' = (S - mean) U (Haeri et al. 2024,
dimension reduction).

Letters: t frames of one batch, n particles, k tracked directions (modes and oversampling).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from sgns.errors import UserError
from sgns.reduction.basis import Basis, check_centring, orthonormality_error

__all__ = ["IncrementalPCA"]

_EPS = torch.finfo(torch.float64).eps
# A Gram matrix squares the singular values, so eigenvectors under this fraction of the largest eigenvalue
# need a second look.
_RESOLVED = 1e-12
_MIN_BLOCK_FRAMES = 32
_LARGEST = 1e100


@dataclass(frozen=True, eq=False)
class _Moments:
    """What is remembered of the frames absorbed so far, relative to the reference frame."""

    count: int  # frames
    mean: Tensor  # (3, n) [m]
    sketch: (
        Tensor  # (k, n) [m], orthogonal rows: sketch^T sketch is the scatter, centred per particle and axis
    )
    scatter: float  # trace of that scatter [m^2], dropped directions included


class _Spectrum(NamedTuple):
    """Everything a basis is made of, before it is cut to the modes wanted."""

    rank: int  # modes above round-off
    mean: Tensor  # (n, 3) [m]
    modes: Tensor  # (n, k)
    scatter: Tensor  # (k,) [m^2]: along each mode
    dropped: float  # [m^2]: in directions the stream dropped
    total: float  # [m^2]: along all modes and dropped
    displacement: float  # [m^2]: the same when centred per particle and axis
    rows: int  # (frame, axis) pairs


class IncrementalPCA:
    """Principal component analysis of a stream of frames in one pass and bounded memory.

    Frames are gathered in blocks of fixed size, whatever the size of the batches, so the result does not
    depend on how the stream was cut. Each block is centred on its own mean and merged with what is known:
    per axis one row sqrt(N m / (N + m)) (mean_old - mean_block) makes up for the move of the mean (Chan,
    Golub and LeVeque 1983; Ross et al. 2008). The rows [sketch; block] are turned by the eigenvectors of
    their small Gram matrix and the weakest dropped. Being a rotation of rows, that loses nothing else,
    even where the eigenvectors are poor; the modes themselves come from a QR and SVD of the sketch at the
    end and are orthonormal to round-off.

    All centrings share the stream, which is centred per particle and axis: another mean c adds exactly
    the rows sqrt(N) (mean_axis - c).

    Memory: about 6 (num_modes + oversampling) n numbers of 8 bytes at most, beside the batch.

    Args:
        num_modes: The largest number of modes that will be asked for.
        oversampling: Directions tracked beyond them, which keep the last modes true while trailing
            ones are dropped. None: an eighth of the modes, at least 16.
        device: Torch device of the work; it must know float64.

    Raises:
        UserError: If an argument is out of range.
    """

    def __init__(
        self, num_modes: int, oversampling: int | None = None, device: str | torch.device = "cpu"
    ) -> None:
        if num_modes < 1:
            raise UserError(f"num_modes is {num_modes}; it must be at least 1")
        if oversampling is None:
            oversampling = max(16, num_modes // 8)
        if oversampling < 0:
            raise UserError(f"oversampling is {oversampling}; it must be at least 0")
        try:
            self.device = torch.device(device)
            torch.zeros(1, dtype=torch.float64, device=self.device)
        except (RuntimeError, AssertionError, TypeError) as error:
            reason = str(error).splitlines()[0]
            raise UserError(
                f"cannot compute in float64 on device {device!r}: {reason}; use device=cpu"
            ) from error
        self.num_modes = num_modes
        self.oversampling = oversampling
        self._tracked = num_modes + oversampling
        # The first frame (3, n) [m], subtracted from all so that a huge offset costs no digits.
        self._reference: Tensor | None = None
        self._pending: Tensor | None = None  # (block, 3, n) [m]: frames waiting for a full block
        self._pending_count = 0
        self._rows: Tensor | None = None  # (3 (block + 1), n) [m]: scratch for the centred block
        self._moments: _Moments | None = None
        # Squared Frobenius norm of the largest error that rounding to the input type can have made [m^2].
        self._input_noise = 0.0

    @property
    def frame_count(self) -> int:
        """Frames seen so far."""
        return self._pending_count + (self._moments.count if self._moments else 0)

    def partial_fit(self, positions: Tensor | np.ndarray) -> IncrementalPCA:
        """Add frames to the stream.

        Pass positions in the type they were stored in: modes weaker than its rounding are not counted
        as modes.

        Args:
            positions: Particle positions [m], (t, n, 3), floating point.

        Returns:
            This object.

        Raises:
            UserError: If shape or type is wrong or a value is not finite; the stream is then as it was.
        """
        x = self._checked(positions)
        if self._reference is None and len(x):
            n = x.shape[1]
            block = max(_MIN_BLOCK_FRAMES, math.ceil(self._tracked / 3))
            self._reference = x[0].to(self.device, torch.float64).T.contiguous()
            self._pending = torch.empty(block, 3, n, dtype=torch.float64, device=self.device)
            self._rows = torch.empty(3 * (block + 1), n, dtype=torch.float64, device=self.device)
            zeros = torch.zeros(3, n, dtype=torch.float64, device=self.device)
            self._moments = _Moments(0, zeros, zeros[:0], 0.0)
        unit = torch.finfo(x.dtype).eps / 2
        start = 0
        while start < len(x):
            stop = min(len(x), start + len(self._pending) - self._pending_count)
            chunk = x[start:stop].to(self.device)
            rows = self._pending[self._pending_count : self._pending_count + stop - start]
            torch.sub(chunk.permute(0, 2, 1), self._reference, out=rows)
            self._input_noise += (unit * float(torch.linalg.vector_norm(chunk, dtype=torch.float64))) ** 2
            self._pending_count += stop - start
            if self._pending_count == len(self._pending):
                self._moments = self._absorbed()
                self._pending_count = 0
            start = stop
        return self

    def rank(self, centring: str = "particle_axis") -> int:
        """Modes that the stream can give, `num_modes` at most.

        A mode counts if it is stronger than anything that rounding of the input or the arithmetic can make.
        """
        return self._solved(centring).rank

    def basis(
        self,
        centring: str = "particle_axis",
        num_modes: int | None = None,
        *,
        arrangement_hash: str = "",
        fitted_on: Iterable[str] = (),
    ) -> Basis:
        """The leading modes of all frames so far; the stream may go on afterwards.

        Args:
            centring: One of `CENTRINGS`.
            num_modes: Modes wanted; None: the number given at construction.
            arrangement_hash: Kept in the basis.
            fitted_on: Names of the runs, kept in the basis.

        Raises:
            UserError: If no frame was seen, the centring is unknown or more modes are asked for
            than the data has.
        """
        wanted = self.num_modes if num_modes is None else num_modes
        if not 1 <= wanted <= self.num_modes:
            raise UserError(
                f"num_modes is {wanted}; this stream tracked {self.num_modes}; allowed: 1 to {self.num_modes}"
            )
        found = self._solved(centring)
        if wanted > found.rank:
            cure = f"ask for at most {found.rank} modes or add" if found.rank else "add"
            raise UserError(
                f"num_modes is {wanted} but the data has rank {found.rank} ({self.frame_count} frames of "
                f"{len(found.mean)} particles, centring {centring}); {cure} runs that move differently"
            )
        modes = found.modes[:, :wanted]
        # The first of the (nearly) largest entries, so that a tie is not decided by round-off.
        magnitude = modes.abs()
        first = (magnitude >= (1.0 - 1e-6) * magnitude.amax(0)).to(torch.uint8).argmax(0)
        modes = modes * modes.gather(0, first[None]).sign()
        return Basis(
            mean=found.mean.cpu(),
            modes=modes.cpu().contiguous(),
            eigenvalues=(found.scatter[:wanted] / found.rows).cpu(),
            total_variance=found.total / found.rows,
            displacement_variance=found.displacement / found.rows,
            centring=centring,
            arrangement_hash=arrangement_hash,
            fitted_on=list(fitted_on),
            residual_variance=(float(found.scatter[wanted:].sum()) + found.dropped) / found.rows,
        )

    def _solved(self, centring: str) -> _Spectrum:
        """All directions of the stream so far under one centring."""
        check_centring(centring)
        if self.frame_count == 0:
            raise UserError("no basis without frames; call partial_fit with at least one frame first")
        moments = self._absorbed()
        sketch = moments.sketch
        # Only the stream drops directions, so what is missing there is missing whatever the centring.
        dropped = max(moments.scatter - float(sketch.square().sum()), 0.0)
        mean = self._reference + moments.mean
        centre = mean
        if centring == "particle":
            centre = mean.mean(0, keepdim=True).expand(3, -1)
        elif centring == "scalar":
            centre = mean.mean().expand_as(mean)
        total = moments.scatter
        if centring != "particle_axis":
            layout = math.sqrt(moments.count) * (mean - centre)
            total += float(layout.square().sum())
            # The largest rows first: QR then keeps the accuracy of the small ones.
            sketch = torch.cat([layout, sketch])
        q, r = torch.linalg.qr(sketch.T)
        left, singular, _ = torch.linalg.svd(r, full_matrices=False)
        modes = q @ left
        error = orthonormality_error(modes)
        if error > 1e-9:
            raise ArithmeticError(f"modes are orthonormal to {error:.1e} only")
        rows = 3 * moments.count
        largest = float(singular[0]) if len(singular) else 0.0
        # Rounding moves no singular value by more than the Frobenius norm of all rounding errors
        # (Weyl): input, then arithmetic.
        floor = math.sqrt(self._input_noise) + _EPS * math.sqrt(max(rows, len(modes))) * largest
        rank = min(int((singular > floor).sum()), self.num_modes)
        mean = centre.T.contiguous()
        return _Spectrum(rank, mean, modes, singular.square(), dropped, total, moments.scatter, rows)

    def _absorbed(self) -> _Moments:
        """The moments with the pending frames merged in; changes nothing."""
        old, m = self._moments, self._pending_count
        if m == 0:
            return old
        n = old.mean.shape[1]
        frames = self._pending[:m]
        mean = frames.mean(0)
        move = mean - old.mean
        merges = old.count > 0
        rows = self._rows[: 3 * (m + merges)]
        torch.sub(frames, mean, out=rows[: 3 * m].view(m, 3, n))
        if merges:
            torch.mul(move, math.sqrt(old.count * m / (old.count + m)), out=rows[3 * m :])
        scatter = old.scatter + float(torch.linalg.vector_norm(rows)) ** 2
        sketch = _compressed(old.sketch, rows, min(self._tracked, n))
        return _Moments(old.count + m, old.mean + move * (m / (old.count + m)), sketch, scatter)

    def _checked(self, positions: Tensor | np.ndarray) -> Tensor:
        """`positions` as a tensor in its own precision, after every check."""
        if isinstance(positions, Tensor):
            x = positions.detach()
            floating = x.is_floating_point()
        else:
            array = np.asarray(positions)
            floating = array.dtype.kind == "f"
            if floating:
                # torch takes neither foreign byte order nor read-only arrays nor more than 8 bytes.
                array = np.require(array, dtype=f"=f{min(array.dtype.itemsize, 8)}", requirements="CAW")
                x = torch.from_numpy(array)
        if not floating:
            found = positions.dtype if isinstance(positions, Tensor) else array.dtype
            raise UserError(
                f"positions are of type {found}; they must be real floating-point numbers, float32 or float64"
            )
        if x.dim() != 3 or x.shape[2] != 3 or x.shape[1] == 0:
            raise UserError(f"positions have shape {tuple(x.shape)}; they must be (frames, particles, 3)")
        if self._reference is not None and x.shape[1] != self._reference.shape[1]:
            raise UserError(
                f"positions have {x.shape[1]} particles but the frames before had "
                f"{self._reference.shape[1]}; one basis serves one particle arrangement"
            )
        # In float64 a finite number may still have a square that is not.
        bad = ~(x.abs() < _LARGEST) if x.dtype == torch.float64 else ~x.isfinite()
        if bad.any():
            frame, particle, axis = (int(i) for i in bad.nonzero()[0])
            raise UserError(
                f"position is {float(x[frame, particle, axis])} at frame {frame} of this batch (frame "
                f"{self.frame_count + frame} of the stream), particle {particle}, axis {'xyz'[axis]}; "
                "positions must be finite lengths in metres; check the run with `sgns check`"
            )
        return x


def _compressed(sketch: Tensor, rows: Tensor, budget: int) -> Tensor:
    """The strongest orthogonal rows with the scatter of sketch (k, n) and rows (b, n): (<= budget, n)."""
    # The sketch's rows are orthogonal already, so its own Gram matrix is known.
    cross = sketch @ rows.T
    top = torch.cat([torch.diag(torch.linalg.vector_norm(sketch, dim=1).square()), cross], 1)
    gram = torch.cat([top, torch.cat([cross.T, rows @ rows.T], 1)])
    kept: list[Tensor] = []
    largest = None
    while True:
        values, vectors = (x.flip(-1) for x in torch.linalg.eigh(gram))
        largest = float(values[0]) if largest is None else largest
        if float(values[0]) <= (16 * _EPS) ** 2 * largest:
            break  # round-off of the rotations before
        take = min(int((values > _RESOLVED * values[0]).sum()), budget)
        kept.append(_rotated(vectors[:, :take], sketch, rows))
        budget -= take
        if budget == 0 or take == len(values):
            break
        # Eigenvectors this weak are mixed by round-off: rotate everything strong away and look at
        # the rest by itself.
        rows = _rotated(vectors[:, take:], sketch, rows)
        sketch = rows[:0]
        if len(rows) <= budget:
            kept.append(rows)
            break
        gram = rows @ rows.T
    return kept[0] if len(kept) == 1 else torch.cat([rows[:0], *kept])


def _rotated(vectors: Tensor, sketch: Tensor, rows: Tensor) -> Tensor:
    """vectors^T [sketch; rows] without stacking the two."""
    k = len(sketch)
    return (vectors[:k].T @ sketch).addmm_(vectors[k:].T, rows)
