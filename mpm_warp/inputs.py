"""Reading files that a person names: whole, but never without bound."""

from __future__ import annotations

import os
import stat
from pathlib import Path

__all__ = ["read_bytes", "read_text"]

MOST_BYTES = 1 << 30
"""Of a file that is read whole."""


def read_bytes(path: Path, most: int = MOST_BYTES) -> bytes:
    """Content of a file.

    Raises:
        OSError: It cannot be read.
        ValueError: It is larger than `most` bytes, or a pipe or device, which may never end.
    """
    with open(path, "rb", opener=_opened) as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise ValueError("it is not a file but a pipe or device")
        if os.fstat(file.fileno()).st_size > most:
            raise ValueError(f"it is larger than {most / 1e6:.0f} MB")
        return file.read()


def read_text(path: Path, most: int = MOST_BYTES) -> str:
    """Content of a text file in UTF-8, with or without a byte order mark; errors as `read_bytes`."""
    return read_bytes(path, most).decode("utf-8-sig")


def _opened(path: str, flags: int) -> int:
    # Without this flag opening a pipe waits for somebody to write to it.
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))
