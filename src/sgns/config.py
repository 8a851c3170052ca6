"""Settings as plain data, and the error that a person can repair."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import yaml

# --- The error that a person can repair -----------------------------------------------------------------


class UserError(Exception):
    """Bad input from a person: one line with what, where, what is allowed and what to do."""


# --- Plain data from YAML text that anybody may have written --------------------------------------------

_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the same in C, where PyYAML has it
_DEEPEST = 100
_MOST = 1_000_000


def parse_yaml(text: str) -> Any:
    """Plain data; tags that would build Python objects are refused.

    Raises:
        ValueError: It is no YAML, has such tags, is nested more than 100 deep (deep nesting would end the process), or
            stands for more than a million values and for more than it has characters, since a few lines of aliases can
            stand for more than fits in memory.
    """
    try:
        _require_moderate(text)
        return yaml.load(text, Loader=_LOADER)
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:  # the last three: damaged text
        raise ValueError(" ".join(str(error).split()) or type(error).__name__) from error


def _require_moderate(text: str) -> None:
    sizes: dict[str, int] = {}  # of what aliases stand for
    unfinished: list[tuple[str | None, int]] = [(None, 0)]  # anchor and values so far, the innermost last

    most = max(_MOST, len(text))  # without aliases there are fewer values than characters

    def count(anchor: str | None, size: int) -> None:
        outer, so_far = unfinished[-1]
        if so_far + size > most:
            raise ValueError(f"it stands for more than {most} values")
        unfinished[-1] = outer, so_far + size
        if anchor is not None:
            sizes[anchor] = size

    for event in yaml.parse(text, Loader=_LOADER):
        if isinstance(event, yaml.CollectionStartEvent):
            unfinished.append((event.anchor, 1))
            if len(unfinished) > _DEEPEST:
                raise ValueError(f"it is nested more than {_DEEPEST} deep")
        elif isinstance(event, yaml.CollectionEndEvent):
            count(*unfinished.pop())
        elif isinstance(event, yaml.ScalarEvent):
            count(event.anchor, 1)
        elif isinstance(event, yaml.AliasEvent):
            if event.anchor not in sizes:
                raise ValueError(f"alias {event.anchor} has no value yet")
            count(None, sizes[event.anchor])


# --- Settings as plain nested data, and how two sets of them differ -------------------------------------


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
