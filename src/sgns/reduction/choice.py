"""How many modes are enough: `reduction.num_modes=auto`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sgns.errors import UserError
from sgns.reduction.basis import Basis
from sgns.reduction.reconstruction import reconstruction_curve

__all__ = ["MEASURES", "choose_modes"]

MEASURES = ("position", "energy", "displacement_energy")
"""What the number of modes is chosen by: error of positions, or one of the two energies."""


def choose_modes(basis: Basis, settings: Mapping[str, Any], validation: Sequence[Path]) -> tuple[int, str]:
    """The fewest modes that are good enough, and why.

    Args:
        basis: With all its modes.
        settings: `conf/reduction`; used are choose, tolerance and share.
        validation: Run files that the basis was not fitted on, for `position`; without any, the error on
            the runs that it was fitted on counts.

    Returns:
        Number of modes; the reason as part of a sentence.

    Raises:
        UserError: All modes together are not good enough; the line says what they reach.
    """
    if settings["choose"] == "position":
        curve = (
            reconstruction_curve(validation, basis)[1:] if validation else np.asarray(basis.residual_mse())
        )
        values = 1e3 * np.sqrt(curve)
        limit, key, unit, sign = settings["tolerance"], "tolerance", " mm", "≤"
        what = f"RMSE on {len(validation)} validation runs" if validation else "RMSE on the training runs"
        enough = values <= limit
    else:
        values = np.asarray(getattr(basis, settings["choose"])())
        limit, key, unit, sign = settings["share"], "share", "", "≥"
        what = f"{settings['choose'].replace('_', ' ')} of the training runs"
        enough = values >= limit
    if not enough.any():
        # With fewer modes than were asked for there are no more to be had.
        more = "" if basis.num_modes < settings["max_modes"] else ", or raise reduction.max_modes"
        raise UserError(
            f"reduction.num_modes=auto: {what} must be {sign} reduction.{key}={limit:g}{unit} but all "
            f"{basis.num_modes} modes reach {_shown(values[-1], limit)}{unit}; "
            f"{'raise' if key == 'tolerance' else 'lower'} reduction.{key}{more}"
        )
    first = int(enough.argmax())
    return (
        first + 1,
        f"{what} is {_shown(values[first], limit)}{unit}, {sign} reduction.{key}={limit:g}{unit}",
    )


def _shown(value: float, limit: float) -> str:
    """`value` with enough digits to tell it from `limit`."""
    digits = 4
    if value != limit:
        digits = max(digits, 1 + math.ceil(-math.log10(abs(value - limit) / max(abs(value), abs(limit)))))
    return f"{value:.{digits}g}"
