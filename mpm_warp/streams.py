"""Computations that take turns, on a GPU each on a CUDA stream of its own.

A computation is a generator that yields wherever it would have to wait for the device. While it pauses, others launch
work of their own. What lies on different streams runs side by side, so many small scenes fill a GPU together.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterable, Iterator
from typing import Any

import numpy as np
import warp as wp

from .start import find_device

__all__ = ["in_turns", "on_host"]


def in_turns(
    tasks: Iterable[Generator[Any, None, None]], at_once: int, device: str
) -> Iterator[tuple[int, Any]]:
    """Advances `at_once` generators in turns, the next one as soon as one has ended.

    Args:
        tasks: what to advance; each is taken when its first turn comes.
        at_once: how many take turns.
        device: where they compute.

    Yields:
        A task's number and what it yielded, unless that was None, a mere pause.
    """
    found = find_device(device)
    waiting = enumerate(tasks)
    running = deque(
        (wp.Stream(found) if found.is_cuda else None, *job)
        for _, job in zip(range(at_once), waiting, strict=False)
    )
    try:
        while running:
            stream, number, task = running.popleft()
            try:
                # No task reads what another one writes, so the streams need not wait for each other.
                with wp.ScopedStream(stream, sync_enter=False):
                    item = next(task)
            except StopIteration:
                if (job := next(waiting, None)) is not None:
                    running.append((stream, *job))
                continue
            running.append((stream, number, task))
            if item is not None:
                yield number, item
    finally:
        for _, _, task in running:
            task.close()


def on_host(array: wp.array) -> np.ndarray:
    """The array's numbers when the current stream has computed them; on the CPU the array's own memory.

    Warp's `array.numpy()` copies on the default stream, which waits for all other streams of the device.
    """
    copy = array.to("cpu")
    if array.device.is_cuda:
        wp.synchronize_stream(array.device)
    return copy.numpy()
