"""How objects print: short, with shapes in place of large arrays."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any

LONGEST = 60
"""Characters of one value."""
MOST_NUMBERS = 7
"""Of an array that is printed itself, such as a pose."""


def short_repr(self: Any) -> str:
    """`__repr__` of dataclasses and named tuples: public fields by name, large arrays by shape and type."""
    names = [one.name for one in fields(self) if one.repr] if is_dataclass(self) else self._fields
    words = [f"{name}={short(getattr(self, name))}" for name in names if not name.startswith("_")]
    return f"{type(self).__name__}({', '.join(words)})"


def short(value: Any) -> str:
    """A value in few characters, on one line."""
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        if len(value.shape) == 1 and value.shape[0] <= MOST_NUMBERS:
            return f"[{', '.join(f'{number:.4g}' for number in value.tolist())}]"
        return f"<{tuple(value.shape)} {str(value.dtype).removeprefix('torch.')}>"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, (list, tuple, dict)) and type(value).__repr__ in _PLAIN:
        whole = repr(value) if len(value) <= LONGEST else ""
        return whole if 0 < len(whole) <= LONGEST and "\n" not in whole else f"<{len(value)} items>"
    text = repr(value)
    return f"{text[:LONGEST]}…" if isinstance(value, str) and len(text) > LONGEST else text


_PLAIN = (list.__repr__, tuple.__repr__, dict.__repr__)
