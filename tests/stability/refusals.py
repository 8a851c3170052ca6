"""How good a refusal is: a line that names what is wrong and where."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from sgns.config import UserError

__all__ = ["unsaid"]


def unsaid(act: Callable[[], Any], *words: str) -> tuple[float, str]:
    """How many of some words the one line of a refusal lacks; NaN if nothing is refused."""
    try:
        act()
    except UserError as error:
        line = str(error)
        lacking = [word for word in words if word not in line]
        return len(lacking) + line.count("\n"), f"lacks {', '.join(lacking)}: {line}" if lacking else ""
    return math.nan, "nothing was refused"
