"""One process makes a file, however many were asked to."""

from __future__ import annotations

import os
import socket
import stat
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

from sgns.errors import UserError
from sgns.leftovers import require_replaceable

__all__ = ["claimed", "claimed_in_turn", "only_here"]

_INTERVAL = 0.05  # seconds between two looks at a claim that is waited for


@contextmanager
def only_here(path: Path) -> Iterator[None]:
    """Claims the making of what a person asks for, before anything is computed.

    Args:
        path: the file; of a folder of results one of its files stands for all.

    Raises:
        UserError: another process is making it, the name stands for something else than a file, or the folder cannot be
            written.
    """
    require_replaceable(path)
    with ExitStack() as stack:
        try:
            ours = stack.enter_context(claimed(path))
        except OSError as error:
            reason = f"{error.filename or path}: {error.strerror}"
            raise UserError(f"cannot write {path}: {reason}; choose another output") from error
        if not ours:
            raise UserError(
                f"{path} is being made by {_holder(_lock_of(path))}; wait until that ends, or choose another output"
            )
        yield


@contextmanager
def claimed_in_turn(path: Path) -> Iterator[None]:
    """Claims a file for a moment, after whoever has it."""
    while True:
        with claimed(path) as ours:
            if ours:
                yield
                return
        time.sleep(_INTERVAL)


@contextmanager
def claimed(path: Path) -> Iterator[bool]:
    """Claims the making of a file; gives False when another process has claimed it.

    A claim is a lock on a hidden file beside `path`, so it ends with the process that holds it, even if that is killed.
    Where the file system knows no locks, every claim is granted.

    Raises:
        UserError: the lock file's name stands for something else.
        OSError: the folder cannot be made or written.
    """
    if fcntl is None:
        yield True
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = _lock_of(path)
    file = _locked(lock)
    try:
        yield file is not None
    finally:
        if file is not None:
            with suppress(OSError):  # in some shared folders nobody may remove another user's file
                lock.unlink()  # before the lock is given up: who opened it meanwhile sees that it is gone
            os.close(file)


def _lock_of(path: Path) -> Path:
    return path.with_name(f".{path.name}.lock")


def _holder(lock: Path) -> str:
    """Who has a claim, in words."""
    with suppress(OSError, ValueError, UserError):
        with open(lock, "rb", opener=_opened_safely) as file:
            pid, host = file.read(1000).decode("ascii").split()
        return f"process {int(pid)}" + (f" on {host}" if host != socket.gethostname() else "")
    return "another process"


def _sign(file: int) -> None:
    """Say in the lock file who has the claim; a full disk is no reason not to have it."""
    with suppress(OSError):
        os.ftruncate(file, 0)
        os.pwrite(file, f"{os.getpid()} {socket.gethostname()}\n".encode("ascii", "replace"), 0)


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
                _sign(file)
                return file
        os.close(file)  # the process that held it removed it between our opening and locking it


def _opened(lock: Path) -> int:
    """Descriptor of the lock file, which other users may open, too, whatever the umask."""
    while True:
        require_replaceable(lock)
        try:
            file = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        except FileExistsError:
            with suppress(FileNotFoundError):  # removed in between
                # Network file systems lock only what may be written.
                return _opened_safely(str(lock), os.O_RDWR)
        else:
            with suppress(OSError):  # some file systems have no permissions to set
                os.fchmod(file, 0o666)
            return file


def _opened_safely(path: str, flags: int) -> int:
    """Descriptor of a plain file: no link is followed and no pipe waited for."""
    file = os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK)
    if not stat.S_ISREG(os.fstat(file).st_mode):
        os.close(file)
        raise UserError(f"cannot lock {path}: it is no plain file; remove it or choose another output")
    return file
