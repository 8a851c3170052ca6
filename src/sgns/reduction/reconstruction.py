"""What the first r modes of a basis hold, for every r: energies and errors.

Letters: n particles, R modes of the basis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from sgns.reduction.basis import Basis
from sgns.runs import Run, frame_chunks

__all__ = ["ReductionCurves", "reconstruction_curve", "reduction_curves"]


@dataclass(frozen=True)
class ReductionCurves:
    """What the subspace holds for r = 1 … R modes.

    Attributes:
        energy: the paper's energy on the training runs, shape (R,).
        displacement_energy: share of the motion's variance on the training runs, shape (R,).
        training: reduction MSE on the training runs [m²], shape (R,).
        held_out: reduction MSE on other runs [m²] for r = 0 … R, shape (R + 1,); NaN without runs.
    """

    energy: np.ndarray
    displacement_energy: np.ndarray
    training: np.ndarray
    held_out: np.ndarray


def reduction_curves(basis: Basis, paths: Sequence[Path]) -> ReductionCurves:
    """Energy and reconstruction error of a basis on the runs that it was fitted on and on the given ones."""
    return ReductionCurves(
        energy=np.asarray(basis.energy()),
        displacement_energy=np.asarray(basis.displacement_energy()),
        training=np.asarray(basis.residual_mse()),
        held_out=reconstruction_curve(paths, basis),
    )


def reconstruction_curve(paths: Sequence[Path], basis: Basis) -> np.ndarray:
    """Reduction MSE of runs for every number of modes, in one pass.

    Orthonormal modes take away their share one after the other: the residual with r modes is
    ‖S − S̄‖² less the squared first r coordinates.

    Args:
        paths: Run files to reconstruct, each read in chunks.
        basis: `Basis` with R modes.

    Returns:
        Mean over frames, particles and axes [m²] for r = 0 … R, shape (R + 1,); NaN without runs.
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
