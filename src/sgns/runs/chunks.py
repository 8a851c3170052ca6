"""Reading or decoding a run a few frames at a time, so that memory does not grow with its length."""

from __future__ import annotations

from collections.abc import Iterator

__all__ = ["frame_chunks"]

# Positions held at one time [bytes, float64].
CHUNK_BYTES = 32e6


def frame_chunks(particle_count: int, stop: int, start: int = 0) -> Iterator[slice]:
    """Slices of at least one frame that cover start ... stop - 1."""
    size = max(1, int(CHUNK_BYTES / (24.0 * particle_count)))
    for first in range(start, stop, size):
        yield slice(first, min(first + size, stop))
