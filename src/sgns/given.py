"""What a person gives in Python: what is none of the kind that is needed is refused in one line."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral
from typing import Any

import numpy as np

from sgns.errors import UserError

__all__ = ["finite_array", "is_whole", "real_array"]


def is_whole(value: Any) -> bool:
    """Whether a value is a whole number; True and False are none."""
    return isinstance(value, Integral) and not isinstance(value, bool)


def real_array(values: Any, what: str, needs: str) -> np.ndarray:
    """A float64 copy of real numbers.

    Args:
        values: An array, a list, a tensor on the CPU.
        what: How to call them in an error.
        needs: What is allowed, for an error.

    Raises:
        UserError: Words, truth values, complex numbers, objects, rows of unequal length, or nothing of the kind.
    """
    try:
        found = np.asarray(values)
    except (TypeError, ValueError, RuntimeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(f"the {what} cannot be read as numbers ({reason}); it needs {needs}") from error
    # Words and complex numbers would be cast without a word.
    if found.dtype.kind not in "iuf":
        raise UserError(f"the {what} is not numeric ({found.dtype}); it needs {needs}")
    return found.astype(np.float64)


def finite_array(values: Any, what: str, shape: Sequence[int | str]) -> np.ndarray:
    """A float64 copy of finite numbers in a shape.

    Args:
        values: As for `real_array`.
        what: How to call them in an error.
        shape: Sizes; a letter or word stands for any size but 0.

    Raises:
        UserError: As `real_array`, another shape, or a value that is not finite.
    """
    needs = f"shape ({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})"
    found = real_array(values, what, needs)
    fits = len(found.shape) == len(shape) and all(
        size > 0 if isinstance(wanted, str) else size == wanted
        for size, wanted in zip(found.shape, shape, strict=True)
    )
    if not fits:
        raise UserError(f"the {what} has shape {found.shape}; it needs {needs}")
    if not np.isfinite(found).all():
        raise UserError(f"the {what} holds values that are not finite; every value must be")
    return found
