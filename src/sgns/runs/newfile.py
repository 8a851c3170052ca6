"""A file that appears under its name only when it is complete.

HDF5 writes through `NewFile` rather than to the disk itself: when the disk is full HDF5 can neither close a
file nor give it up, and takes the whole process down. `NewFile` keeps the error to itself and lets the caller
raise it.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import h5py

from sgns.errors import UserError
from sgns.leftovers import give_name, hidden_beside, hold, remove_leftovers, require_replaceable

__all__ = ["NewFile", "new_hdf5"]

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
