"""The error that a person can repair, settings as plain data, and signals that end a command."""

from __future__ import annotations

import importlib
import shlex
import signal
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any

import yaml

# --- The error that a person can repair -----------------------------------------------------------------


class UserError(Exception):
    """Bad input from a person: one line with what, where, what is allowed and what to do."""


# --- What tells the jobs of a sweep apart ---------------------------------------------------------------

shared_overrides: list[str] = []
"""What all jobs of the sweep are given; empty outside of one, and in the processes of other launchers."""


def own_overrides(overrides: Sequence[str]) -> list[str]:
    """Of a job's, those that not all jobs have; all of them where none differs."""
    return [one for one in overrides if one not in shared_overrides] or list(overrides)


# --- Plain data from YAML text that anybody may have written --------------------------------------------

_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the same in C, where PyYAML has it
_DEEPEST = 100
_MOST = 1_000_000


def library(name: str, what: str) -> Any:
    """A library that only `what` needs."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise UserError(
            f"{what} needs {name}, which cannot be imported ({error}); pip install {name}"
        ) from error


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


def of_dataset(overrides: Sequence[str]) -> list[str]:
    """Those of a command's overrides with which the next command finds the same dataset, quoted for a shell."""
    making = ("dataset.draw", "dataset.runs", "dataset.split", "dataset.change")
    return [shlex.quote(one) for one in overrides if one.startswith("dataset") and not one.startswith(making)]


def differences(there: Mapping[str, Any], here: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Dotted key → the two values, for every key whose values differ; None stands for a key that is absent."""
    a, b = flattened(there), flattened(here)
    return {key: (a.get(key), b.get(key)) for key in a | b if a.get(key) != b.get(key)}


# --- Signals that end a command: Ctrl-C, and what a cluster or a closed terminal sends before it kills --


_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1", "SIGUSR2")
_ENDINGS = [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]  # Windows has only two
_NOT_CHOSEN = (signal.SIG_DFL, signal.default_int_handler)


class Interrupted(KeyboardInterrupt):
    """A signal ended the work; `said` is what a person has to know of what is kept, or nothing."""

    def __init__(self, number: int = signal.SIGINT, said: str = "") -> None:
        super().__init__(number, said)
        self.number, self.said = number, said

    @property
    def cause(self) -> str:
        """In words."""
        return f"interrupted by {signal.Signals(self.number).name}"


_holders = 0  # how many have something to finish first
_waiting: list[int] = []  # signals that came meanwhile


@contextmanager
def heeded_signals() -> Iterator[None]:
    """Within it those signals raise `Interrupted` in the main thread, where they would have ended the process at once.

    What this process was told to ignore, by `nohup` or a shell's background jobs, it goes on ignoring; handlers of
    others stay.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # no other thread may choose
        return
    before = {number: signal.getsignal(number) for number in _ENDINGS}
    ours = {number: handler for number, handler in before.items() if handler in _NOT_CHOSEN}
    for number in ours:
        signal.signal(number, _interrupt)
    try:
        yield
    finally:
        for number, handler in ours.items():
            signal.signal(number, handler)


def _interrupt(number: int, _: FrameType | None) -> None:
    if not _holders:
        raise Interrupted(number)
    if _waiting and number == signal.SIGINT:
        raise KeyboardInterrupt  # a person's second Ctrl-C; what was to be finished is lost
    _waiting.append(number)


@contextmanager
def held_back() -> Iterator[None]:
    """Within it a signal takes effect where `heed` is called, and at the end."""
    global _holders
    _holders += 1
    try:
        yield
        if _holders == 1:
            heed()
    finally:
        _holders -= 1
        if not _holders:
            _waiting.clear()


def heed() -> None:
    """Raise `Interrupted` if a signal was held back."""
    if _waiting:
        raise Interrupted(_waiting[0])
