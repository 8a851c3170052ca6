"""An incremental PCA over run files."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from sgns.errors import UserError
from sgns.reduction.incremental_pca import IncrementalPCA
from sgns.runs import Run, frame_chunks

__all__ = ["fit_runs", "require_positions"]


def fit_runs(paths: Iterable[Path], max_modes: int, device: str = "cpu") -> IncrementalPCA:
    """One stream over runs; the bases of all centrings follow from it.

    Args:
        paths: Run files, each read in chunks.
        max_modes: Modes to keep track of.
        device: Torch device that does it.
    """
    pca = IncrementalPCA(max_modes, device=device)
    for path in paths:
        with Run(path) as run:
            for frames in frame_chunks(run.particle_count, run.frame_count):
                positions = run.positions(frames)
                try:
                    pca.partial_fit(positions)
                except UserError:
                    require_positions(path, frames.start, positions)
                    raise
    return pca


def require_positions(path: Path, first: int, positions: np.ndarray) -> None:
    """Refuses positions (t, n, 3) of a run from its frame `first` on that are no numbers; the line says where."""
    bad = ~np.isfinite(positions)
    if bad.any():
        frame, particle, axis = (int(i) for i in np.argwhere(bad)[0])
        raise UserError(
            f"{path}: the position of particle {particle} along {'xyz'[axis]} is {positions[frame, particle, axis]} "
            f"at frame {first + frame}; simulate this run again, or remove it"
        )
