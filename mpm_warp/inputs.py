"""Reading files that a person names: whole, but never without bound."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import BinaryIO

MOST_BYTES = 1 << 30
"""Of a file that is read whole."""


def open_file(path: Path, most: int = MOST_BYTES) -> BinaryIO:
    """A file, open for reading.

    Raises:
        OSError: it cannot be read.
        ValueError: it is larger than `most` bytes, or a pipe or device, which may never end.
    """
    # Without this flag opening a pipe waits for somebody to write to it.
    file = open(path, "rb", opener=lambda name, flags: os.open(name, flags | getattr(os, "O_NONBLOCK", 0)))
    status = os.fstat(file.fileno())
    if stat.S_ISREG(status.st_mode) and status.st_size <= most:
        return file
    file.close()
    if stat.S_ISREG(status.st_mode):
        raise ValueError(f"it is larger than {most / 1e6:.0f} MB")
    raise ValueError("it is not a file but a pipe or device")


def read_bytes(path: Path, most: int = MOST_BYTES) -> bytes:
    """Content of a file; errors as `open_file`."""
    with open_file(path, most) as file:
        content = file.read(most + 1)  # some files of the system say that they are empty, and never end
    if len(content) > most:
        raise ValueError(f"it is larger than {most / 1e6:.0f} MB")
    return content


def read_text(path: Path, most: int = MOST_BYTES) -> str:
    """Content of a text file in UTF-8, with or without a byte order mark; errors as `read_bytes`."""
    return read_bytes(path, most).decode("utf-8-sig")
