"""Signals that end a command: Ctrl-C, and what a cluster or a closed terminal sends before it kills."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

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
