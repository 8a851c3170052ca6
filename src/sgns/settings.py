"""Settings as plain nested data: their types, and how two sets of them differ."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import UnionType
from typing import Any, get_args, get_type_hints

from sgns.errors import UserError

__all__ = ["check_fields", "differences", "flattened"]

_WORDS = {
    bool: "true or false",
    int: "a whole number",
    float: "a finite number",
    str: "text",
    type(None): "null",
}


def check_fields(cls: type, values: Mapping[str, Any], group: str) -> None:
    """Refuses values that cannot be the fields of a settings dataclass; fields of other types are not looked at.

    Args:
        cls: The dataclass.
        values: Its fields by name.
        group: Name of the group of settings, for the error.

    Raises:
        UserError: A field is unknown, missing, or of the wrong type; the line names it.
    """
    hints = get_type_hints(cls)
    if wrong := sorted(set(values) ^ set(hints)):
        key = wrong[0]
        raise UserError(
            f"{group}.{key} is {'unknown' if key in values else 'missing'}; keys: {', '.join(sorted(hints))}"
        )
    for key, hint in hints.items():
        kinds = get_args(hint) if isinstance(hint, UnionType) else (hint,)
        if set(kinds) <= _WORDS.keys() and not any(_is(values[key], kind) for kind in kinds):
            allowed = " or ".join(_WORDS[kind] for kind in kinds)
            raise UserError(f"{group}.{key} is {values[key]!r}; it must be {allowed}")


def _is(value: Any, kind: type) -> bool:
    if kind is float:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    return isinstance(value, kind) and not (kind is int and isinstance(value, bool))


def flattened(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings as one level with dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping):
            flat |= flattened(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def differences(there: Mapping[str, Any], here: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Dotted key → the two values, for every key whose values differ; None stands for a key that is absent."""
    a, b = flattened(there), flattened(here)
    return {key: (a.get(key), b.get(key)) for key in a | b if a.get(key) != b.get(key)}
