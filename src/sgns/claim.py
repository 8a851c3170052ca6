"""One process makes a file, however many were asked to."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

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
            with suppress(OSError):  # in some shared folders nobody may remove another user's file
                lock.unlink()  # before the lock is given up: who opened it meanwhile sees that it is gone
            os.close(file)


def _locked(lock: Path) -> int | None:
    """Descriptor of the lock file, locked; None when another process holds it."""
    while True:
        file = _opened(lock)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(file)
            return None
        except OSError:  # no locks here
            return file
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file), lock.stat()):
                return file
        os.close(file)  # the process that held it removed it between our opening and locking it


def _opened(lock: Path) -> int:
    """Descriptor of the lock file, which other users may open, too, whatever the umask."""
    while True:
        try:
            file = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        except FileExistsError:
            with suppress(FileNotFoundError):  # removed in between
                return os.open(lock, os.O_RDWR)  # network file systems lock only what may be written
        else:
            with suppress(OSError):  # some file systems have no permissions to set
                os.fchmod(file, 0o666)
            return file
