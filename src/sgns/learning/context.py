"""Constants of a run that the tool's path does not show: gravity, load, the friction angle of the soil, ..."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from numbers import Real
from typing import TYPE_CHECKING, Any

import numpy as np

from sgns.errors import UserError

if TYPE_CHECKING:
    from sgns.reduction.reduced import ReducedRun

__all__ = ["context_of", "varying_context"]


def varying_context(runs: Sequence[ReducedRun], candidates: Sequence[str]) -> list[str]:
    """Those of the candidates, keys of the scene such as `load` or `material.friction_angle`, whose numbers differ
    between runs: a constant tells nothing."""
    values = {key: [_value(run.scene, key) for run in runs] for key in candidates}
    numbers = {
        key: found for key, found in values.items() if all(v is not None and math.isfinite(v) for v in found)
    }
    return [key for key, found in numbers.items() if len(set(found)) > 1]


def context_of(scene: Mapping[str, Any], keys: Sequence[str]) -> np.ndarray:
    """The numbers of a scene by their keys, in the units of the scene, shape (K,).

    Raises:
        UserError: The scene lacks one, or it is not finite.
    """
    values = [_value(scene, key) for key in keys]
    if None in values:
        raise UserError(
            f"the scene has no number {keys[values.index(None)]}, which this network needs; "
            f"it was trained with different values of {', '.join(keys)}"
        )
    for key, value in zip(keys, values, strict=True):
        if not math.isfinite(value):
            raise UserError(f"the scene's {key} is {value}; it must be finite")
    return np.array(values, dtype=np.float64)


def _value(scene: Mapping[str, Any], key: str) -> float | None:
    found: Any = scene
    for part in key.split("."):
        found = found.get(part) if isinstance(found, Mapping) else None
    return float(found) if isinstance(found, Real) and not isinstance(found, bool) else None
