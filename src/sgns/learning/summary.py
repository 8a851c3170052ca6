"""`training.json`, the numbers of a complete training, beside its checkpoint."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from sgns.errors import UserError
from sgns.smallfile import read_json

__all__ = ["SUMMARY", "read_summary"]

SUMMARY = "training.json"

_WRONG = "not the summary of a training"
_ADVICE = "remove it or train again"


def read_summary(folder: Path) -> dict[str, Any]:
    """What the summary in a folder says: at least `seconds` (wall time) and `skill`; of networks `steps`.

    Raises:
        UserError: It cannot be read, or says something else.
    """
    file = folder / SUMMARY
    summary = read_json(file, _WRONG, _ADVICE)
    kinds = {"seconds": (int, float), "skill": (int, float), "steps": int}
    if not isinstance(summary, dict):
        raise UserError(f"{file} is {_WRONG} (no group of keys); {_ADVICE}")
    for key, kind in kinds.items():
        value = summary.get(key, 1 if key == "steps" else None)  # polynomials are fitted without any
        # The skill is no number where nothing moves; no other may be none.
        good = isinstance(value, kind) and not isinstance(value, bool)
        if not good or (key != "skill" and not (key == "steps") <= value < math.inf):
            raise UserError(f"{file} is {_WRONG} ({key} is {value!r:.40}); {_ADVICE}")
    return summary
