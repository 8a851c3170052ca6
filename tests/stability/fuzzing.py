"""Random cases within bounds: bad input ends in one line and never in a traceback, a hang, or memory without end.

The cases follow from a fixed seed; `SGNS_FUZZ=20` makes twenty times as many from random seeds.
"""

from __future__ import annotations

import contextlib
import os
import resource
import signal
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any

from hypothesis import HealthCheck, Phase, settings

from mpm_warp import SceneError
from sgns.config import UserError

__all__ = ["OUTCOMES", "bounded", "cases", "refused_or_read"]

MORE = int(os.environ.get("SGNS_FUZZ", "1"))
SECONDS = 10
"""Of computing time, that a case may take."""
MEMORY = 2 << 30
"""Bytes of address space that a case may take beside what the tests have."""
OUTCOMES: Counter[str] = Counter()


def cases(count: int) -> Any:
    """Decorator's settings: so many cases, the same every time."""
    return settings(
        max_examples=count * MORE,
        derandomize=MORE == 1,
        database=None,
        deadline=None,
        phases=[Phase.generate],  # looking for smaller examples takes minutes
        suppress_health_check=list(HealthCheck),
    )


@contextlib.contextmanager
def bounded() -> Any:
    """Time and memory that a case may take."""

    def too_slow(number: int, frame: FrameType | None) -> None:
        raise AssertionError(f"more than {SECONDS} s of computing")

    limits = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = signal.signal(signal.SIGPROF, too_slow)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def refused_or_read(action: Any) -> None:
    """The action does its work, or says in one line why not."""
    with bounded():
        try:
            action()
            OUTCOMES["accepted"] += 1
        except (UserError, SceneError) as error:
            OUTCOMES["refused"] += 1
            assert str(error).strip() and len(str(error)) < 5000, error
