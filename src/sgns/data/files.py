"""Files that are whole or not there, made by one process at a time; and files of others, read within bounds."""

from __future__ import annotations

import csv
import errno
import io
import json
import logging
import os
import socket
import stat
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
from filelock import FileLock, Timeout

from mpm_warp.settings import open_file, read_bytes
from mpm_warp.settings import read_text as text_of
from sgns.config import UserError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

log = logging.getLogger(__name__)


def one_line(error: object) -> str:
    """An error's text without line breaks, for a one-line message."""
    return " ".join(str(error).split()) or type(error).__name__


# --- Names that a file may take -------------------------------------------------------------------------

_FILE_TYPES = {
    stat.S_IFLNK: "a symbolic link; give the name of the file itself",
    stat.S_IFDIR: "a folder; give the name of a file in it, or another name",
    stat.S_IFIFO: "a pipe; give the name of a file",
    stat.S_IFSOCK: "a socket; give the name of a file",
    stat.S_IFCHR: "a device; give the name of a file",
    stat.S_IFBLK: "a device; give the name of a file",
}
"""What is never replaced by a file. A link is not either, wherever it leads: /dev/stdout is one, and may lead to a
plain file."""


def require_replaceable(*paths: Path) -> None:
    """Refuse names that stand for something else than a plain file, or nothing yet: a file that takes such a name would
    destroy a device, a pipe or a link.

    Raises:
        UserError: says what it is.
    """
    for path in paths:
        kind = _file_type(path)
        if kind not in (None, stat.S_IFREG):
            what = _FILE_TYPES.get(kind, "no plain file; give the name of a file")
            raise UserError(f"cannot write {path}: it is {what}")


def require_new(path: Path, overwrite: bool, what: str = "", suffix: str = "") -> None:
    """Refuse the name of an output that lacks the suffix of what it is, or that is taken, unless `overwrite` is true.

    Raises:
        UserError: says which name to give, or what to do.
    """
    if path.suffix.lower() != suffix and suffix:
        raise UserError(f"output is {path}; {what} is a {suffix} file: output={path.with_suffix(suffix)}")
    if path.is_file() and not overwrite:
        raise UserError(f"{path} is there already; choose another output, or replace it with overwrite=true")


def _file_type(path: Path) -> int | None:
    """What the name itself stands for, as in `stat`; None for nothing, or where that cannot be asked."""
    try:
        return stat.S_IFMT(os.lstat(path).st_mode)
    except (OSError, ValueError):  # a name that no file can have is refused when the file is made
        return None


# --- One process makes a file, however many were asked to -----------------------------------------------

_NO_LOCKS = {errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOLCK}  # file systems that know none


@contextmanager
def only_here(path: Path) -> Iterator[None]:
    """Locks the making of what a person asks for; of a folder of results one of its files stands for all.

    Raises:
        UserError: another process is making it, the name stands for something else than a file, or the folder cannot be
            written.
    """
    require_replaceable(path)
    with ExitStack() as stack:
        try:
            ours = stack.enter_context(file_lock(path))
        except OSError as error:
            reason = f"{error.filename or path}: {error.strerror}"
            raise UserError(f"cannot write {path}: {reason}; choose another output") from error
        if not ours:
            raise UserError(
                f"{path} is being made by {_holder(_lock_file(path))}; wait until that ends, or choose another output"
            )
        yield


@contextmanager
def file_lock(path: Path, wait: bool = False) -> Iterator[bool]:
    """Locks the making of a file; gives False when another process has the lock, or waits for it.

    The lock is one on a hidden file beside `path`, so it ends with the process that holds it, even if that is killed.
    Where the file system knows no locks, everybody is given one.

    Raises:
        UserError: the name of the hidden file stands for something else.
        OSError: the folder cannot be made or written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    hidden = _lock_file(path)
    require_replaceable(hidden)
    lock = FileLock(
        hidden,
        timeout=-1 if wait else 0,
        mode=0o666,  # other users may lock it, too, whatever the umask
        thread_local=False,
        fallback_to_soft=False,  # a soft lock outlives its process
        on_acquired=_sign,
    )
    ours = True
    try:
        lock.acquire()
    except Timeout:
        ours = False
    except OSError as error:
        # filelock does not trust the free lock of another user in a sticky folder, such as one who was killed.
        distrusted = isinstance(error, PermissionError) and os.access(hidden, os.W_OK)
        if error.errno not in _NO_LOCKS and not distrusted:
            raise
    try:
        yield ours
    finally:
        if ours:
            with suppress(OSError):  # in some shared folders nobody may remove another user's file
                hidden.unlink()  # before the lock is given up: who opened it meanwhile sees that it is gone
            lock.release()


def _lock_file(path: Path) -> Path:
    return path.with_name(f".{path.name}.lock")


def _holder(hidden: Path) -> str:
    """Who has a lock, in words."""
    with suppress(OSError, ValueError), open_file(hidden) as file:
        pid, host = file.read(1000).decode("ascii").split()
        return f"process {int(pid)}" + (f" on {host}" if host != socket.gethostname() else "")
    return "another process"


def _sign(descriptor: int) -> None:
    """Say in the lock file who has the lock; a full disk is no reason not to have it."""
    with suppress(OSError):
        os.ftruncate(descriptor, 0)
        os.write(descriptor, f"{os.getpid()} {socket.gethostname()}\n".encode("ascii", "replace"))


# --- Hidden files that take their name when they are complete, and what killed processes leave of them --

_SUFFIX = ".partial"


class HiddenFile:
    """A new file beside `path`, open, whose lock shows other processes that it is being written.

    Its name says which process of which machine writes it. Those that killed processes of this machine left of `path`
    are removed.

    Raises:
        OSError: The folder cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.hidden = path.with_name(f"{_hidden_start(path)}{os.getpid()}-{uuid4().hex[:8]}{_SUFFIX}")
        remove_abandoned(path)
        while True:
            self.file: io.FileIO = open(self.hidden, "xb+", buffering=0)
            if fcntl is not None:
                with suppress(OSError):  # some file systems have no locks
                    fcntl.flock(self.file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if self.hidden.exists():
                return
            self.file.close()  # before it was locked another process took it for abandoned

    def complete(self, path: Path | None = None) -> None:
        """Give the file its name, or that of `path` in the same folder, and the place of a plain file that had it, once
        the disk has everything.

        Raises:
            UserError: By now the name stands for something else.
            OSError: The system refuses.
        """
        path = path or self.path
        os.fsync(self.file.fileno())
        if fcntl is None:
            self.file.close()  # Windows names closed files only; elsewhere the lock lasts until it has its name
        require_replaceable(path)
        os.replace(self.hidden, path)
        self.file.close()

    def discard(self) -> None:
        """Remove the file if it has not got its name; does nothing the second time."""
        with suppress(OSError):
            self.file.close()
        with suppress(OSError):
            self.hidden.unlink(missing_ok=True)


def _hidden_start(path: Path) -> str:
    return f".{path.name}.{socket.gethostname()}-"


def remove_abandoned(path: Path) -> None:
    """Delete the hidden files that killed processes of this machine left of `path`: the ones without a lock."""
    if fcntl is None:
        return
    start = _hidden_start(path)
    for found in path.parent.iterdir():
        if not (found.name.startswith(start) and found.name.endswith(_SUFFIX)):
            continue
        if _file_type(found) == stat.S_IFREG:  # others are none of ours; opening a pipe may never end
            with suppress(OSError, ValueError), open_file(found, ANY_SIZE) as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                found.unlink()
                log.info("removed %s, left by a process that was killed", found)


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A hidden path beside `path` to write to; it gets its name at the end, or is removed after an exception.

    For small files; for runs, which may fill the disk, see `sgns.data.hdf5.NewFile`.

    Raises:
        UserError: `path` is a device, pipe, link or folder.
        OSError: The disk does not take it; the error names `path`.
    """
    require_replaceable(path)
    try:
        new = HiddenFile(path)
        try:
            yield new.hidden
            new.complete()
        finally:
            new.discard()
    except OSError as error:
        # A full disk is reported without a name.
        if error.filename is None or str(error.filename).endswith(_SUFFIX):
            error.filename = str(path)
        if error.errno == errno.ENOENT:  # there are folders that take no files, such as /proc
            raise UserError(f"cannot write {path}: {error.strerror}; choose another output") from error
        raise


def write_whole(path: Path, text: str) -> None:
    """Write a text file in UTF-8."""
    with whole_file(path) as hidden:
        hidden.write_text(text, encoding="utf-8")


# --- Small files that anybody may have written, read whole within bounds --------------------------------
# Each reader takes the file, what it is where it is damaged (as in "no table of points"), and what a person can do
# then. It raises a `UserError` of one line from these when the file cannot be read. Pipes and devices are refused
# without waiting for them, larger files before they are read.

_MOST_BYTES = 1 << 22  # of text; a thousand times what this package writes of most
_MOST_OF_TABLE = 1 << 24
MOST_OF_ARRAYS = 1 << 27
"""Of an NPZ file [bytes], also after unpacking."""
ANY_SIZE = 1 << 62


def read_text(path: Path, wrong: str, advice: str, most: int = _MOST_BYTES) -> str:
    """Content of a text file in UTF-8, of at most so many bytes."""
    with _readable(path, wrong, advice):
        return text_of(path, most)


def read_json(path: Path, wrong: str, advice: str) -> Any:
    """Data of a JSON file."""
    with _readable(path, wrong, advice):
        return parse_json(text_of(path, _MOST_BYTES))


def parse_json(text: str | bytes) -> Any:
    """Data of JSON text.

    Raises:
        ValueError: it is none, or nested deeper than Python can follow.
    """
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("it is nested too deep") from error


def read_table(path: Path, wrong: str, advice: str) -> list[dict[str, str]]:
    """Lines of a CSV file by the names in its first line."""
    with _readable(path, wrong, advice):
        lines = csv.reader(io.StringIO(text_of(path, _MOST_OF_TABLE), newline=""))
        columns = next(lines, [])
        if len(set(columns)) < len(columns) or not columns:
            raise ValueError("its first line does not name columns, each once")
        table = []
        for values in filter(None, lines):
            if len(values) != len(columns):
                raise ValueError(
                    f"line {lines.line_num} has {len(values)} values, the first line {len(columns)}"
                )
            table.append(dict(zip(columns, values, strict=True)))
        return table


def read_arrays(path: Path, wrong: str, advice: str, large: bool = False) -> dict[str, np.ndarray]:
    """Arrays of an NPZ file by name, without Python objects; what its parts unfold to counts as its size does.

    A `large` one may have any size, and unfold to 20 times as much.
    """
    with _readable(path, wrong, advice):
        size = max(path.stat().st_size, MOST_OF_ARRAYS) if large else MOST_OF_ARRAYS
        packed = io.BytesIO(read_bytes(path, size))
        most = max(MOST_OF_ARRAYS, 20 * packed.getbuffer().nbytes) if large else MOST_OF_ARRAYS
        with zipfile.ZipFile(packed) as archive:
            if sum(part.file_size for part in archive.infolist()) > most:
                raise ValueError(f"it unfolds to more than {most / 1e6:.0f} MB")
        packed.seek(0)
        with np.load(packed, allow_pickle=False) as content:
            return dict(content)


def write_arrays(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write an NPZ file; it appears complete or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, **arrays)


@contextmanager
def _readable(path: Path, wrong: str, advice: str) -> Iterator[None]:
    try:
        yield
    except Exception as error:  # numpy, zipfile and csv raise almost anything on damaged bytes
        if isinstance(error, OSError) and error.strerror:
            raise UserError(f"cannot read {path}: {error.strerror}; {advice}") from error
        raise UserError(f"{path} is {wrong} ({one_line(error)}); {advice}") from error
