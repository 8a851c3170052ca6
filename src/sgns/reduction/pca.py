"""Streaming principal component analysis over particles.

The data matrix has one row per (frame, axis) and one column per particle, so one basis serves x, y and z and
a mode is a "subspace particle" with a 3-vector for a position: S' = (S - mean) U (Haeri et al. 2024,
dimension reduction).

Letters: t frames of one batch, n particles, k tracked directions (modes and oversampling).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from sgns.config import UserError
from sgns.reduction.basis import Basis, check_centring, orthonormality_error

_EPS = torch.finfo(torch.float64).eps
# A Gram matrix squares the singular values, so eigenvectors under this fraction of the largest eigenvalue
# need a second look.
_RESOLVED = 1e-12
# A block is thinned out before it is merged where at most this share of its rows remains.
_WORTH_THINNING = 2.0 / 3.0
_GRAM_ROWS = 72
_MIN_BLOCK_FRAMES = 32
_LARGEST = 1e100


class _Moments(NamedTuple):
    """What is remembered of the frames absorbed so far, relative to the reference frame."""

    frames: int
    mean: Tensor  # (3, n) [m]
    sketch: Tensor  # (k, n) [m], orthogonal rows: sketch^T sketch is the scatter per particle and axis
    scatter: float  # trace of that scatter [m^2], dropped directions included
    dropped: float  # its part in dropped directions [m^2]; as a difference it would be round-off if small


class _Spectrum(NamedTuple):
    """Everything a basis is made of, before it is cut to the modes wanted."""

    rank: int  # modes above round-off
    mean: Tensor  # (n, 3) [m]
    modes: Tensor  # (n, k)
    scatter: Tensor  # (k,) [m^2]: along each mode
    total: float  # [m^2]: along all modes and what the stream dropped
    moments: _Moments


class IncrementalPCA:
    """Principal component analysis of a stream of frames in one pass and bounded memory.

    Frames are gathered in blocks of fixed size, whatever the size of the batches, so the result does not
    depend on how the stream was cut. Each block is centred on its own mean and merged with what is known:
    per axis one row sqrt(N m / (N + m)) (mean_old - mean_block) makes up for the move of the mean (Chan,
    Golub and LeVeque 1983; Ross et al. 2008). The rows [sketch; block] are turned by the eigenvectors of
    their small Gram matrix and the weakest dropped. Being a rotation of rows, that loses nothing else,
    even where the eigenvectors are poor; the modes themselves come from a QR and SVD of the sketch at the
    end and are orthonormal to round-off.

    Frames that follow each other are alike. Once the stream has had to drop directions, a block is therefore
    turned by its own eigenvectors first, and rows weaker than the block's share of the weakest tracked
    direction are left out; several such blocks are merged at once. Over a steady stream, what is left out
    along any one direction sums to no more than that weakest direction holds.

    All centrings share the stream, which is centred per particle and axis: another mean c adds exactly
    the rows sqrt(N) (mean_axis - c).

    Memory: about 9 (num_modes + oversampling) n numbers of 8 bytes at most, beside the batch.

    Args:
        num_modes: The largest number of modes that will be asked for.
        oversampling: Directions tracked beyond them, which keep the last modes true while trailing
            ones are dropped. None: an eighth of the modes, at least 16.
        device: Torch device of the work; it must know float64.

    Attributes:
        frame_count: Frames seen so far.

    Raises:
        UserError: If an argument is out of range.
    """

    # Made at the first frame. Letters: m frames of a block.
    _reference: Tensor  # (3, n) [m]: the first frame, taken off all, so that a huge offset costs no digits
    _moments: _Moments
    _pending: Tensor  # (m + 1, 3, n) [m]: frames waiting for a full block, and room for the move of the mean
    _queue: Tensor  # (3 (m + 1), n) [m]: rows of thinned blocks, not in the sketch yet
    _rooms: list[Tensor]  # twice (k, n) [m]: where the sketch is and where the next one goes

    def __init__(
        self, num_modes: int, oversampling: int | None = None, device: str | torch.device = "cpu"
    ) -> None:
        if num_modes < 1:
            raise UserError(f"num_modes is {num_modes}; it must be at least 1")
        if oversampling is None:
            oversampling = max(16, num_modes // 8)
        if oversampling < 0:
            raise UserError(f"oversampling is {oversampling}; it must be at least 0")
        self.device = checked_device(device)
        self.num_modes = num_modes
        self.frame_count = 0
        self._tracked = num_modes + oversampling
        self._queued = 0  # rows in the queue
        # Scatter along the weakest tracked direction [m^2]; 0 while nothing had to be dropped.
        self._weakest = 0.0
        # Squared Frobenius norm of the largest error that rounding to the input type can have made [m^2].
        self._input_noise = 0.0

    def __repr__(self) -> str:
        return f"IncrementalPCA({self.num_modes} modes, {self.frame_count} frames so far)"

    def partial_fit(self, positions: Tensor | np.ndarray) -> IncrementalPCA:
        """Add frames to the stream; returns this object.

        Args:
            positions: Particle positions [m], (t, n, 3), floating point, in the type they were stored in: modes weaker
                than its rounding are not counted as modes.

        Raises:
            UserError: If shape or type is wrong or a value is not finite; the stream is then as it was.
        """
        x, norm = self._checked(positions)
        if self.frame_count == 0 and len(x):
            self._begin(x[0])
        self._input_noise += (torch.finfo(x.dtype).eps / 2 * norm) ** 2
        while len(x):
            waiting = self.frame_count - self._moments.frames
            taken = x[: len(self._pending) - 1 - waiting]
            frames = self._pending[waiting : waiting + len(taken)]
            frames.copy_(taken.to(self.device).permute(0, 2, 1)).sub_(self._reference)
            self.frame_count += len(taken)
            if waiting + len(taken) == len(self._pending) - 1:
                self._absorb()
            x = x[len(taken) :]
        return self

    def merge(self, other: IncrementalPCA) -> IncrementalPCA:
        """Take in the frames of another stream, such as those of another machine; returns this object.

        Streams can be pickled. The other one stays as it is. While neither had to drop directions, the result is that
        of one stream over all frames, but for rounding, whatever the order. Beyond that each stream has dropped its own
        weakest directions: frames, mean and total variance stay exact, and what was dropped adds up in the
        `residual_variance` of the basis, so `residual_mse` stays an upper bound.

        Raises:
            UserError: The other stream has other particles, or tracks another number of directions.
        """
        if other._tracked != self._tracked:
            raise UserError(
                f"the other stream tracks {other._tracked} directions and this one {self._tracked}; give both the same "
                "num_modes and oversampling"
            )
        if other.frame_count == 0:
            return self
        theirs, reference = other._absorbed(), other._reference.to(self.device)
        if self.frame_count == 0:
            self._begin(reference.T)
        if reference.shape != self._reference.shape:
            raise UserError(
                f"the other stream has {reference.shape[1]} particles and this one {self._reference.shape[1]}; one "
                "basis serves one particle arrangement"
            )
        mine = self._absorbed()
        count = mine.frames + theirs.frames
        move = theirs.mean.to(self.device) + (reference - self._reference) - mine.mean
        rows = theirs.sketch.to(self.device)
        if mine.frames:  # the means differ, see the class
            rows = torch.cat([math.sqrt(mine.frames * theirs.frames / count) * move, rows])
        scatter = (
            mine.scatter + theirs.scatter + mine.frames * theirs.frames / count * float(move.square().sum())
        )
        known = mine._replace(
            frames=count,
            mean=mine.mean + move * (theirs.frames / count),
            scatter=scatter,
            dropped=mine.dropped + theirs.dropped,
        )
        self._rooms = [torch.empty_like(self._rooms[0]) for _ in range(2)]
        self._moments, weakest = _merged(known, rows, self._rooms[0])
        self._weakest = max(weakest, self._weakest, other._weakest)
        self._input_noise += other._input_noise
        self.frame_count, self._queued = count, 0
        return self

    def _begin(self, frame: Tensor) -> None:
        """The reference and all memory of the stream, from the first frame (n, 3)."""
        self._reference = frame.to(self.device, torch.float64).T.contiguous()
        n = len(frame)
        block = max(_MIN_BLOCK_FRAMES, math.ceil(self._tracked / 3))
        self._pending = self._reference.new_empty(block + 1, 3, n)
        self._queue = self._reference.new_empty(3 * (block + 1), n)
        self._rooms = [self._reference.new_empty(min(self._tracked, n), n) for _ in range(2)]
        self._moments = _Moments(0, torch.zeros_like(self._reference), self._rooms[0][:0], 0.0, 0.0)

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
            arrangement_hash: Kept in the basis, as `fitted_on`, names of the runs.

        Raises:
            UserError: No frame was seen, the centring is unknown, or the data has fewer modes.
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
        rows, modes = 3 * found.moments.frames, found.modes[:, :wanted]
        # The first of the (nearly) largest entries, so that a tie is not decided by round-off.
        magnitude = modes.abs()
        first = (magnitude >= (1.0 - 1e-6) * magnitude.amax(0)).to(torch.uint8).argmax(0)
        modes = modes * modes.gather(0, first[None]).sign()
        return Basis(
            mean=found.mean.cpu(),
            modes=modes.cpu().contiguous(),
            eigenvalues=(found.scatter[:wanted] / rows).cpu(),
            total_variance=found.total / rows,
            displacement_variance=found.moments.scatter / rows,
            centring=centring,
            arrangement_hash=arrangement_hash,
            fitted_on=list(fitted_on),
            # Only the stream drops directions, so what is missing there is missing whatever the centring.
            residual_variance=(float(found.scatter[wanted:].sum()) + found.moments.dropped) / rows,
        )

    def _solved(self, centring: str) -> _Spectrum:
        """All directions of the stream so far under one centring."""
        check_centring(centring)
        if self.frame_count == 0:
            raise UserError("no basis without frames; call partial_fit with at least one frame first")
        moments = self._absorbed()
        sketch, total = moments.sketch, moments.scatter
        mean = centre = self._reference + moments.mean
        if centring == "particle":
            centre = mean.mean(0, keepdim=True).expand(3, -1)
        elif centring == "scalar":
            centre = mean.mean().expand_as(mean)
        if centring != "particle_axis":
            layout = math.sqrt(moments.frames) * (mean - centre)
            total += float(layout.square().sum())
            # The largest rows first: QR then keeps the accuracy of the small ones.
            sketch = torch.cat([layout, sketch])
        q, r = torch.linalg.qr(sketch.T)
        left, singular, _ = torch.linalg.svd(r, full_matrices=False)
        modes = q @ left
        error = orthonormality_error(modes)
        if error > 1e-9:
            raise ArithmeticError(f"modes are orthonormal to {error:.1e} only")
        rows = 3 * moments.frames
        largest = float(singular[0]) if len(singular) else 0.0
        # Rounding moves no singular value by more than the Frobenius norm of all rounding errors
        # (Weyl): input, then arithmetic.
        floor = math.sqrt(self._input_noise) + _EPS * math.sqrt(max(rows, len(modes))) * largest
        rank = min(int((singular > floor).sum()), self.num_modes)
        return _Spectrum(rank, centre.T.contiguous(), modes, singular.square(), total, moments)

    def _absorb(self) -> None:
        """Take the full block of pending frames into the moments."""
        before = self._moments.frames
        rows, self._moments = _centred(self._pending, self._moments)
        gram = _gram(rows)
        values, vectors = torch.linalg.eigh(gram)
        limit = self._weakest * (1.0 - before / self._moments.frames)
        # Round-off may hide that a weak direction holds more than its eigenvalue says.
        first = int((values.clamp_min(_RESOLVED * float(values[-1])) <= limit).sum())
        kept = len(rows) - first
        if kept > _WORTH_THINNING * len(rows):
            self._merge(rows, gram)
            return
        if self._queued + kept > len(self._queue):
            self._merge(self._queue[: self._queued])
            self._queued = 0
        left_out = self._moments.dropped + float(values[:first].clamp_min(0.0).sum())
        self._moments = self._moments._replace(dropped=left_out)
        torch.mm(vectors[:, first:].T, rows, out=self._queue[self._queued : self._queued + kept])
        self._queued += kept

    def _merge(self, rows: Tensor, gram: Tensor | None = None) -> None:
        """Rows (b, n) into the sketch; `gram` is their Gram matrix if it is known."""
        self._moments, self._weakest = _merged(self._moments, rows, self._rooms[1], gram)
        self._rooms.reverse()

    def _absorbed(self) -> _Moments:
        """The moments with everything that waits merged in; changes nothing."""
        found = self._moments
        waiting = [self._queue[: self._queued]]
        if pending := self.frame_count - found.frames:
            rows, found = _centred(self._pending[: pending + 1].clone(), found)
            waiting.append(rows)
        room = self._rooms[1]  # empty between merges
        for rows in waiting:
            if len(rows):
                found, _ = _merged(found, rows, room)
                room = torch.empty_like(room)
        return found

    def _checked(self, positions: Tensor | np.ndarray) -> tuple[Tensor, float]:
        """`positions` as a tensor in its own precision, after every check, and its norm [m]."""
        found = positions.detach() if isinstance(positions, Tensor) else np.asarray(positions)
        if not (found.is_floating_point() if isinstance(found, Tensor) else found.dtype.kind == "f"):
            raise UserError(
                f"positions are of type {found.dtype}; they must be real floating-point numbers, float32 or float64"
            )
        if isinstance(found, Tensor):
            x = found
        else:
            # torch takes neither foreign byte order nor read-only arrays nor more than 8 bytes.
            native = np.dtype(f"=f{min(found.dtype.itemsize, 8)}")
            x = torch.from_numpy(np.require(found, native, ["C", "A", "W"]))
        if x.dim() != 3 or x.shape[2] != 3 or x.shape[1] == 0:
            raise UserError(f"positions have shape {tuple(x.shape)}; they must be (frames, particles, 3)")
        if self.frame_count and x.shape[1] != self._reference.shape[1]:
            raise UserError(
                f"positions have {x.shape[1]} particles but the frames before had "
                f"{self._reference.shape[1]}; one basis serves one particle arrangement"
            )
        norm = float(torch.linalg.vector_norm(x))
        if norm < _LARGEST:
            return x, norm
        # In float64 a finite number may still have a square that is not.
        bad = ~(x.abs() < _LARGEST) if x.dtype == torch.float64 else ~x.isfinite()
        if bad.any():
            frame, particle, axis = (int(i) for i in bad.nonzero()[0])
            raise UserError(
                f"position is {float(x[frame, particle, axis])} at frame {frame} of this batch (frame "
                f"{self.frame_count + frame} of the stream), particle {particle}, axis {'xyz'[axis]}; "
                "positions must be finite lengths in metres; check the run with `sgns check`"
            )
        return x, float(torch.linalg.vector_norm(x, dtype=torch.float64))


def checked_device(device: str | torch.device) -> torch.device:
    """The torch device of that name; a UserError if it is not here or does not know float64."""
    try:
        torch.zeros(1, dtype=torch.float64, device=device)
        return torch.device(device)
    except (RuntimeError, AssertionError, TypeError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(
            f"cannot compute in float64 on device {device!r}: {reason}; use device=cpu"
        ) from error


def _centred(frames: Tensor, old: _Moments) -> tuple[Tensor, _Moments]:
    """Rows of a block for the sketch, and the moments with its frames in all but the sketch.

    `frames` (m + 1, 3, n) [m] are overwritten; the rows, (3 m or 3 (m + 1), n), are a view of them. The last is room
    for the move of the mean.
    """
    m = len(frames) - 1
    mean = frames[:m].mean(0)
    move = mean - old.mean
    frames[:m] -= mean
    count = old.frames + m
    if old.frames:
        torch.mul(move, math.sqrt(old.frames * m / count), out=frames[m])
    rows = frames[: m + (old.frames > 0)].flatten(0, 1)
    scatter = old.scatter + float(torch.linalg.vector_norm(rows)) ** 2
    return rows, old._replace(frames=count, mean=old.mean + move * (m / count), scatter=scatter)


def _merged(old: _Moments, rows: Tensor, room: Tensor, gram: Tensor | None = None) -> tuple[_Moments, float]:
    """The moments with rows (b, n) in the sketch, which holds the strongest orthogonal directions of both.

    `old` counts the rows already in all but the sketch; the new sketch goes to `room` (most rows wanted, n); `gram` is
    rows rows^T, if it is known. Also returned: the scatter along the weakest row of the new sketch, 0 if only round-off
    was dropped.
    """
    sketch = old.sketch
    # The sketch's rows are orthogonal already, so its own Gram matrix is known.
    cross = sketch @ rows.T
    top = torch.cat([torch.diag(torch.linalg.vector_norm(sketch, dim=1).square()), cross], 1)
    gram = torch.cat([top, torch.cat([cross.T, _gram(rows) if gram is None else gram], 1)])
    done, largest, weakest, dropped = 0, None, 0.0, old.dropped
    while True:
        values, vectors = (x.flip(-1) for x in torch.linalg.eigh(gram))
        largest = float(values[0]) if largest is None else largest
        if float(values[0]) <= (16 * _EPS) ** 2 * largest:
            break  # round-off of the rotations before
        resolved = int((values > _RESOLVED * values[0]).sum())
        take = min(resolved, len(room) - done)
        _rotated(vectors[:, :take], sketch, rows, room[done : done + take])
        done += take
        if resolved > take:
            weakest = float(values[take - 1])
        if done == len(room):
            dropped += float(values[take:].clamp_min(0.0).sum())
        if done == len(room) or take == len(values):
            break
        # Eigenvectors this weak are mixed by round-off: rotate everything strong away and look at
        # the rest by itself.
        rows = _rotated(vectors[:, take:], sketch, rows)
        sketch = rows[:0]
        if done + len(rows) <= len(room):
            room[done : done + len(rows)] = rows
            done += len(rows)
            break
        gram = _gram(rows)
    return old._replace(sketch=room[:done], dropped=dropped), weakest


def _rotated(vectors: Tensor, sketch: Tensor, rows: Tensor, out: Tensor | None = None) -> Tensor:
    """vectors^T [sketch; rows] without stacking the two."""
    k = len(sketch)
    return torch.mm(vectors[:k].T, sketch, out=out).addmm_(vectors[k:].T, rows)


def _gram(rows: Tensor) -> Tensor:
    """rows rows^T, with little of the half that symmetry gives: (b, n) -> (b, b)."""
    if len(rows) <= _GRAM_ROWS:
        return rows @ rows.T
    upper, lower = rows.split((len(rows) + 1) // 2)
    cross = upper @ lower.T
    return torch.cat([torch.cat([_gram(upper), cross], 1), torch.cat([cross.T, _gram(lower)], 1)])
