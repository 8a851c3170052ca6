"""Body nodes close enough together that soil particles cannot pass between them unseen."""

from __future__ import annotations

import numpy as np

__all__ = ["box_surface"]


def box_surface(half_size: np.ndarray, spacing: float) -> np.ndarray:
    """Points on all six faces of a box, on a lattice that reaches its edges.

    Args:
        half_size: Half the sides of the box [m], shape (3,).
        spacing: Largest distance between neighbours along an axis [m].

    Returns:
        Points in the body frame [m], shape (N, 3), every one once.
    """
    half_size = np.asarray(half_size, dtype=np.float64)
    counts = np.maximum(np.ceil(2 * half_size / spacing - 1e-9).astype(int), 1) + 1
    index = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, 3)
    outside = ((index == 0) | (index == counts - 1)).any(axis=1)
    return (2 * index[outside] / (counts - 1) - 1) * half_size
