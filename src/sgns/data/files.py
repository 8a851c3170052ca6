"""Files that are whole or not there, made by one process at a time."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import stat
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO, TypeVar
from uuid import uuid4

import h5py

from mpm_warp.inputs import open_file
from sgns.config import UserError

log = logging.getLogger(__name__)


# --- Hidden files that become the real ones when they are complete, and what killed processes leave of them

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]
_SUFFIX = ".partial"
_KINDS = {
    stat.S_IFLNK: "a symbolic link; give the name of the file itself",
    stat.S_IFDIR: "a folder; give the name of a file in it, or another name",
    stat.S_IFIFO: "a pipe; give the name of a file",
    stat.S_IFSOCK: "a socket; give the name of a file",
    stat.S_IFCHR: "a device; give the name of a file",
    stat.S_IFBLK: "a device; give the name of a file",
}
"""What is never replaced by a file. A link is not either, wherever it leads: /dev/stdout is one, and may lead to a
plain file."""


def hidden_beside(path: Path) -> Path:
    """A name in the same folder that says which process of which machine writes `path`."""
    return path.with_name(f"{_start(path)}{os.getpid()}-{uuid4().hex[:8]}{_SUFFIX}")


def require_replaceable(*paths: Path) -> None:
    """Refuse names that stand for something else than a plain file, or nothing yet: a file that takes such a name would
    destroy a device, a pipe or a link.

    Raises:
        UserError: says what it is.
    """
    for path in paths:
        kind = _kind(path)
        if kind not in (None, stat.S_IFREG):
            what = _KINDS.get(kind, "no plain file; give the name of a file")
            raise UserError(f"cannot write {path}: it is {what}")


def is_replaceable(path: Path) -> bool:
    """Whether a file of ours may be there, or be put there: see `require_replaceable`."""
    return _kind(path) in (None, stat.S_IFREG)


def give_name(temporary: Path, path: Path) -> None:
    """Let a complete file take its name, and the place of a plain file that had it.

    Raises:
        UserError: By now the name stands for something else.
        OSError: The system refuses.
    """
    require_replaceable(path)
    os.replace(temporary, path)


def _kind(path: Path) -> int | None:
    """What the name itself stands for, as in `stat`; None for nothing, or where that cannot be asked."""
    try:
        return stat.S_IFMT(os.lstat(path).st_mode)
    except (OSError, ValueError):  # a name that no file can have is refused when the file is made
        return None


def hold(file: IO[bytes]) -> None:
    """Show other processes, also those that cannot see this one's number, that the file is being written."""
    if fcntl is not None:
        with contextlib.suppress(OSError):  # some file systems have no locks
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def remove_leftovers(path: Path) -> None:
    """Delete what killed processes of this machine left of `path`."""
    if fcntl is None:
        return
    start = _start(path)
    for found in path.parent.iterdir():
        if not (found.name.startswith(start) and found.name.endswith(_SUFFIX)):
            continue
        pid = found.name[len(start) :].split("-")[0]
        if not pid.isdecimal() or _alive(int(pid)):
            continue
        if _kind(found) != stat.S_IFREG:  # none of ours; opening a pipe may never end
            continue
        # A live process in a container may have a number that we cannot see; its lock shows that it is there.
        with contextlib.suppress(OSError, ValueError), open_file(found, 1 << 62) as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            found.unlink()
            log.info("removed %s, left by a process that was killed", found)


def _start(path: Path) -> str:
    return f".{path.name}.{socket.gethostname()}-"


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:
        return True
    return not _ended(pid)


def _ended(pid: int) -> bool:
    """Whether only the number of a process is left until its parent asks for its status, which may be never."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()[0]
    except (OSError, IndexError):  # another system, or gone by now
        return False
    return state in ("Z", "X")


# --- One process makes a file, however many were asked to -----------------------------------------------

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]
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


# --- Small files that appear complete or not at all; for runs, which may fill the disk, see `sgns.runs.newf


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A hidden path beside `path` to write to; it gets its name at the end, or is removed after an exception.

    Raises:
        UserError: `path` is a device, pipe, link or folder.
        OSError: The disk does not take it; the error names `path`.
    """
    require_replaceable(path)
    temporary = hidden_beside(path)
    try:
        remove_leftovers(path)
        with temporary.open("xb") as held:
            hold(held)
            yield temporary
            os.fsync(held.fileno())
        give_name(temporary, path)
    except OSError as error:
        if error.filename in (None, str(temporary)):  # a full disk is reported without a name
            error.filename = str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def write_whole(path: Path, text: str) -> None:
    """Write a text file in UTF-8."""
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


# --- A file that appears under its name only when it is complete ----------------------------------------
# HDF5 writes through `NewFile` rather than to the disk itself: when the disk is full HDF5 can neither close a
# file nor give it up, and takes the whole process down. `NewFile` keeps the error to itself and lets the caller
# raise it.

T = TypeVar("T")


class NewFile:
    """A hidden file beside `path`, for `h5py.File(NewFile(path), "w")`; `complete` gives it its name.

    Until then an existing file of that name stays as it is. Hidden files that killed processes of this
    machine left for the same path are removed.

    Args:
        path: where the file goes; missing folders are made.

    Raises:
        UserError: the folder cannot be made or written, or `path` is a device, pipe, link or folder.
    """

    def __init__(self, path: Path) -> None:
        require_replaceable(path)
        self.path = path
        self._error: BaseException | None = None
        self._temp = hidden_beside(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            remove_leftovers(path)
            self._file = open(self._temp, "xb+", buffering=0)
        except OSError as error:
            raise _cannot_write(path, error) from error
        hold(self._file)

    def check(self) -> None:
        """Raise what a read or write since the last check ran into."""
        if self._error is None:
            return
        error = self._error
        if isinstance(error, OSError):
            raise _cannot_write(self.path, error) from error
        raise error

    def complete(self, path: Path | None = None) -> None:
        """Wait until the disk has everything, then give the file its name, or that of `path` in the same folder. Close
        the HDF5 file before.

        Raises:
            UserError: the disk did not take it; nothing is left behind.
        """
        try:
            self.check()
            os.fsync(self._file.fileno())
            self._file.close()
            give_name(self._temp, path or self.path)
            # Again: when this file was begun, a process just killed may still have been seen.
            with contextlib.suppress(OSError):
                remove_leftovers(self.path)
        except OSError as error:
            self.discard()
            raise _cannot_write(self.path, error) from error
        except BaseException:
            self.discard()
            raise
        if os.name == "posix":
            with contextlib.suppress(OSError):  # the file is complete; some file systems cannot sync a folder
                descriptor = os.open(self.path.parent, os.O_RDONLY)
                try:
                    os.fsync(descriptor)
                finally:
                    os.close(descriptor)

    def discard(self) -> None:
        """Remove the hidden file; does nothing the second time."""
        with contextlib.suppress(OSError):
            self._file.close()
        with contextlib.suppress(OSError):
            self._temp.unlink(missing_ok=True)

    # --- what h5py asks of a file: nothing of this may raise ----------------------------------------------

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move; see io.IOBase."""
        return self._kept(lambda: self._file.seek(offset, whence), 0)

    def tell(self) -> int:
        """Where we are; see io.IOBase."""
        return self._kept(self._file.tell, 0)

    def read(self, size: int = -1) -> bytes:
        """Read; see io.RawIOBase."""
        return self._kept(lambda: self._file.read(size), b"") or b""

    def readinto(self, buffer: memoryview) -> int:
        """Fill the buffer, with zeros where nothing can be read."""
        view = memoryview(buffer).cast("B")
        done = 0
        while done < len(view):
            count = self._kept(lambda part=view[done:]: self._file.readinto(part), 0)
            if not count:
                view[done:] = bytes(len(view) - done)
                break
            done += count
        return len(view)

    def write(self, data: memoryview) -> int:
        """Write everything, or remember why not."""
        view = memoryview(data).cast("B")
        done = 0
        while done < len(view) and self._error is None:
            done += self._kept(lambda part=view[done:]: self._file.write(part), 0) or 0
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        """Set the length; see io.IOBase."""
        return self._kept(lambda: self._file.truncate(size), 0)

    def flush(self) -> None:
        """Nothing is buffered here."""

    def _kept(self, action: Callable[[], T], otherwise: T) -> T:
        try:
            return action()
        except BaseException as error:  # also an interrupt: HDF5 must not see it half-way through a write
            self._error = self._error or error
            return otherwise


@contextmanager
def new_hdf5(path: Path) -> Iterator[h5py.File]:
    """An HDF5 file to fill; it appears under its name at the end, complete, or not at all.

    Raises:
        UserError: the disk does not take it; nothing is left behind.
    """
    disk = NewFile(path)
    try:
        with h5py.File(disk, "w") as file:
            yield file
        disk.complete()
    finally:
        disk.discard()


def _cannot_write(path: Path, error: OSError) -> UserError:
    """What a person can do about a failed write, in one line."""
    reason = error.strerror or str(error)
    advice = {
        "No space left on device": "free some space or choose another output",
        "Disk quota exceeded": "free some space or choose another output",
        "File name too long": "choose a shorter name",
    }.get(reason, "choose an output in a folder that you may write to")
    return UserError(f"cannot write {path}: {reason}; nothing is kept; {advice}")
