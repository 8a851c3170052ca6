"""What this process may use of the machine, within a container, too: cores and memory."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from pathlib import Path

ROOT = Path("/")
"""Of the file system."""


def usable_cores() -> int:
    """Cores that this process may use at once: those it is bound to, and at most its container's quota, rounded up."""
    bound = getattr(os, "sched_getaffinity", None)  # not on macOS and Windows
    cores = (os.cpu_count() or 1) if bound is None else len(bound(0))
    for group in _control_groups("cpu"):
        quota = _numbers(group / "cpu.max")
        quota = quota or [*_numbers(group / "cpu.cfs_quota_us"), *_numbers(group / "cpu.cfs_period_us")]
        if len(quota) == 2 and 0.0 < quota[0] < math.inf and quota[1] > 0.0:
            cores = min(cores, math.ceil(quota[0] / quota[1]))
    return cores


def usable_memory() -> float:
    """Memory of the machine, and at most the limit of its container [bytes]; infinite where the system does not say."""
    try:
        memory = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, ValueError, OSError):
        memory = math.inf
    for group in _control_groups("memory"):
        for name in ("memory.max", "memory.limit_in_bytes"):
            memory = min([memory, *_numbers(group / name)])
    return memory


def _control_groups(controller: str) -> Iterator[Path]:
    """Folders of Linux's control groups that this process is in, and of those above them; some may not be there, since
    a container sees the top of its own only. Of version 2, and of a controller's own tree of version 1."""
    try:
        lines = (ROOT / "proc/self/cgroup").read_text().splitlines()
    except (OSError, ValueError):
        return
    top = ROOT / "sys/fs/cgroup"
    for line in lines:
        number, controllers, path = line.split(":", 2)
        if number != "0" and controller not in controllers.split(","):
            continue
        tree = top if number == "0" else top / controller
        own = tree / path.lstrip("/")
        yield from (group for group in (own, *own.parents) if group.is_relative_to(tree))


def _numbers(file: Path) -> list[float]:
    """Of the first line of a control group's file; empty if there is none."""
    try:
        return [math.inf if word == "max" else float(word) for word in file.read_text().split()]
    except (OSError, ValueError):
        return []
