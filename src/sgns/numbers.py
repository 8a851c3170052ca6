"""Numbers that a file, a person or a clock gives, refused in one line or good to calculate with; errors in words."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from numbers import Integral
from typing import Any

import numpy as np

from sgns.config import UserError

# --- From a file: whether arrays fit together -----------------------------------------------------------


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
        if not _fits(found.shape, wanted):
            raise ValueError(f"{name} has shape {found.shape}, expected ({', '.join(map(str, wanted))})")
        known |= {size: n for size, n in zip(shape, found.shape, strict=True) if isinstance(size, str)}


def _fits(shape: Sequence[int], wanted: Sequence[int | str]) -> bool:
    """Whether an array has the wanted shape, in which a letter or word stands for any size but 0."""
    return len(shape) == len(wanted) and all(
        size > 0 if isinstance(asked, str) else size == asked
        for size, asked in zip(shape, wanted, strict=True)
    )


# --- From a person in Python ----------------------------------------------------------------------------


def is_whole(value: Any) -> bool:
    """Whether a value is a whole number; True and False are none."""
    return isinstance(value, Integral) and not isinstance(value, bool)


def real_array(values: Any, what: str, needs: str) -> np.ndarray:
    """A float64 copy of real numbers: an array, a list, a tensor on the CPU.

    Args:
        values: The numbers.
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
    """A float64 copy of finite numbers in a shape, in which a letter or word stands for any size but 0.

    Raises:
        UserError: As `real_array`, another shape, or a value that is not finite.
    """
    needs = f"shape ({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})"
    found = real_array(values, what, needs)
    if not _fits(found.shape, shape):
        raise UserError(f"the {what} has shape {found.shape}; it needs {needs}")
    if not np.isfinite(found).all():
        raise UserError(f"the {what} holds values that are not finite; every value must be")
    return found


def check_pose(pose: Any, what: str = "tool pose") -> np.ndarray:
    """As `check_poses`, of one pose, shape (7,), equal to the bit and quicker; several are refused."""
    found = _pose_rows(pose, what, "x, y, z, qx, qy, qz, qw, shape (7,)", 1)[0]
    *place, x, y, z, w = found.tolist()
    length = math.sqrt(x * x + y * y + z * z + w * w)
    if not (abs(length - 1) <= 1e-3 and all(map(math.isfinite, place))):
        _unit_poses(found[None], what, "")  # says why
    found[3:] /= length
    return found


def first_pose(poses: Any, what: str = "first pose") -> np.ndarray:
    """As `check_pose`, of a pose (7,) or of the first of some (T, 7), the others not looked at."""
    return _unit_poses(_pose_rows(poses, what)[:1], what, "")[0]


def check_poses(poses: Any, what: str = "tool path") -> np.ndarray:
    """A float64 copy (T, 7) of poses, centre of mass [m] and quaternion x, y, z, w, shape (T, 7) or (7,), with exactly
    unit quaternions.

    Raises:
        UserError: No real numbers, wrong shape, a value that is not finite, or a quaternion off unit length by more
            than 1e-3.
    """
    return _unit_poses(_pose_rows(poses, what), what)


def _pose_rows(
    poses: Any, what: str, needs: str = "rows x, y, z, qx, qy, qz, qw, shape (T, 7)", most_axes: int = 2
) -> np.ndarray:
    """A float64 copy of what has the shape of poses, (T, 7) or (7,), as (T, 7)."""
    found = real_array(poses, what, needs)
    if not 1 <= found.ndim <= most_axes or found.shape[-1] != 7 or len(found) == 0:
        raise UserError(f"the {what} has shape {found.shape}; it needs {needs}")
    return np.atleast_2d(found)


def _unit_poses(poses: np.ndarray, what: str, where: str = " at frame {}") -> np.ndarray:
    """Poses (T, 7), whose quaternions are made exactly unit in place, or a UserError that says where they are none."""
    bad = ~np.isfinite(poses).all(axis=1)
    if bad.any():
        frame = int(bad.argmax())
        raise UserError(
            f"the {what} is not finite{where.format(frame)}: {poses[frame].tolist()}; every pose must be finite"
        )
    with np.errstate(over="ignore"):  # the length is refused below
        length = np.linalg.norm(poses[:, 3:], axis=1)
    bad = np.abs(length - 1) > 1e-3
    if bad.any():
        frame = int(bad.argmax())
        raise UserError(
            f"the {what} has a quaternion of length {length[frame]:.4g}{where.format(frame)}; "
            "x, y, z, w must have length 1 (within 0.001)"
        )
    poses[:, 3:] /= length[:, None]
    return poses


# --- From a clock ---------------------------------------------------------------------------------------


def elapsed(began: float, now: float) -> float:
    """Time between two readings of a clock [s], above 0, so that one may divide by it.

    The clock of a virtual machine that was paused may stand still or go back.
    """
    return max(now - began, 1e-9)  # the clocks count in such steps


def duration_words(seconds: float) -> str:
    """A duration to two places at most: 40 s, 12 min, 3 h 20 min, 2 d 5 h."""
    minutes, hours = round(seconds / 60), round(seconds / 3600)
    if seconds < 99.5:
        return f"{max(1, round(seconds))} s"
    if minutes < 100:
        return f"{minutes} min"
    if hours < 48:
        return f"{minutes // 60} h {minutes % 60} min"
    return f"{hours // 24} d {hours % 24} h"


# --- To a person: how good a prediction is --------------------------------------------------------------


def counted(count: int, what: str) -> str:
    """As in "1 run" or "2 runs"."""
    return f"{count} {what}{'' if count == 1 else 's'}"


def error_words(soil: float, still: float, force: float, mean_force: float) -> str:
    """Errors of soil [m] and force [NRMSE], each beside that of the plainest guess."""
    return (
        f"soil error {1e3 * soil:.3g} mm ({1e3 * still:.3g} mm if the soil did not move), force NRMSE {force:.3f} "
        f"({mean_force:.3f} if it were always the mean force of the training runs)"
    )


def error_hint(soil: float, still: float, force: float, mean_force: float) -> str:
    """What to do about a prediction that is no better than the plainest guess; empty where it is better."""
    worse = []
    if soil >= still:
        worse.append("the soil is predicted no better than if nothing moved")
    if force >= mean_force:
        worse.append("the force is predicted no better than by the mean force of the training runs")
    cures = "more training runs, training.max_steps (longer) and reduction.num_modes (more modes)"
    return f"hint: {' and '.join(worse)}; what helps, most first: {cures}" if worse else ""
