"""Whether arrays that were read from a file fit together."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

__all__ = ["require_shapes"]


def require_shapes(
    arrays: Mapping[str, np.ndarray],
    shapes: Mapping[str, tuple[int | str, ...]],
    counts: Mapping[str, int] | None = None,
) -> None:
    """Refuses arrays that are missing, hold no floating-point numbers or have other shapes.

    Args:
        arrays: by name.
        shapes: name → shape; a letter stands for the same number of at least 1 in all of them.
        counts: letters whose number is known.

    Raises:
        ValueError: what is wrong with the first that does not fit.
    """
    known = dict(counts or {})
    for name, shape in shapes.items():
        if not isinstance(found := arrays.get(name), np.ndarray):
            raise ValueError(f"{name} is missing")
        if found.dtype.kind != "f":
            raise ValueError(f"{name} does not hold floating-point numbers")
        wanted = tuple(known.get(size, size) if isinstance(size, str) else size for size in shape)
        fits = len(found.shape) == len(wanted) and all(
            actual > 0 if isinstance(size, str) else actual == size
            for size, actual in zip(wanted, found.shape, strict=True)
        )
        if not fits:
            raise ValueError(f"{name} has shape {found.shape}, expected ({', '.join(map(str, wanted))})")
        for size, actual in zip(shape, found.shape, strict=True):
            if isinstance(size, str):
                known[size] = actual
