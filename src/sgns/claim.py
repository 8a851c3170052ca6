"""One process makes a file, however many were asked to."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

__all__ = ["claimed"]


@contextmanager
def claimed(path: Path) -> Iterator[bool]:
    """Claims the making of a file; gives False when another process has claimed it.

    A claim is a lock on a hidden file beside `path`, so it ends with the process that holds it, even if that is killed.
    Where the file system knows no locks, every claim is granted.
    """
    if fcntl is None:
        yield True
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = path.with_name(f".{path.name}.lock")
    file = _locked(lock)
    try:
        yield file is not None
    finally:
        if file is not None:
            lock.unlink(
                missing_ok=True
            )  # before the lock is given up: who opened it meanwhile sees that it is gone
            file.close()


def _locked(lock: Path) -> BinaryIO | None:
    """The lock file, open; None when another process holds it."""
    while True:
        file = lock.open("ab")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.close()
            return None
        except OSError:  # no locks here
            return file
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), lock.stat()):
                return file
        file.close()  # the process that held it removed it between our opening and locking it
