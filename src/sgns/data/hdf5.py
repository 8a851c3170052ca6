"""HDF5 files: written whole whatever the disk does, and read without trust in who wrote them."""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from mpm_warp.settings import open_file
from sgns.config import UserError
from sgns.data.files import ANY_SIZE, HiddenFile, remove_abandoned, require_replaceable

if TYPE_CHECKING:
    from typing_extensions import Buffer

# --- A file that appears under its name only when it is complete ----------------------------------------


class NewFile(io.RawIOBase):
    """A hidden file beside `path`, for `h5py.File(NewFile(path), "w")`; `complete` gives it its name, `discard` removes
    it.

    Until then an existing file of that name stays as it is. Missing folders are made, and hidden files that killed
    processes of this machine left for the same path are removed.

    HDF5 writes through this and not to the disk itself: when the disk is full HDF5 can neither close a file nor give it
    up, and takes the whole process down. This keeps the error to itself and lets the caller raise it.

    Raises:
        UserError: the folder cannot be made or written, or `path` is a device, pipe, link or folder.
    """

    def __init__(self, path: Path) -> None:
        require_replaceable(path)
        self.path = path
        self._error: BaseException | None = None
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._new = HiddenFile(path)
        except OSError as error:
            raise _cannot_write(path, error) from error

    def check(self) -> None:
        """Raise what a read or write since the last check ran into."""
        if isinstance(self._error, OSError):
            raise _cannot_write(self.path, self._error) from self._error
        if self._error is not None:
            raise self._error

    def complete(self, path: Path | None = None) -> None:
        """Wait until the disk has everything, then give the file its name, or that of `path` in the same folder. Close
        the HDF5 file before.

        Raises:
            UserError: the disk did not take it.
        """
        self.check()
        try:
            self._new.complete(path)
        except OSError as error:
            raise _cannot_write(self.path, error) from error
        # Again: when this file was begun, a process just killed may still have had its lock.
        with suppress(OSError):
            remove_abandoned(self.path)
        if os.name == "posix":
            with suppress(OSError):  # the file is complete; some file systems cannot sync a folder
                descriptor = os.open(self.path.parent, os.O_RDONLY)
                try:
                    os.fsync(descriptor)
                finally:
                    os.close(descriptor)

    def discard(self) -> None:
        """Remove the hidden file; does nothing the second time."""
        self._new.discard()

    # --- what h5py asks of a file, as in `io.RawIOBase`: nothing of this may raise ------------------------

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return self._kept(self._new.file.seek, offset, whence)

    def truncate(self, size: int | None = None) -> int:
        return self._kept(self._new.file.truncate, size)

    def readinto(self, buffer: Buffer) -> int:
        """Fill the buffer, with zeros where nothing can be read."""
        view = memoryview(buffer).cast("B")
        done = 0
        while done < len(view):
            count = self._kept(self._new.file.readinto, view[done:])
            if not count:
                view[done:] = bytes(len(view) - done)
                break
            done += count
        return len(view)

    def write(self, data: Buffer) -> int:
        """Write everything, or remember why not."""
        view = memoryview(data).cast("B")
        done = 0
        while done < len(view) and self._error is None:
            done += self._kept(self._new.file.write, view[done:])
        return len(view)

    def _kept(self, action: Callable[..., int | None], *arguments: Any) -> int:
        """What an action answers; 0 if it fails, which is kept for `check`."""
        try:
            return action(*arguments) or 0
        except BaseException as error:  # also an interrupt: HDF5 must not see it half-way through a write
            self._error = self._error or error
            return 0


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


# --- Parts of an HDF5 file that anybody may have written ------------------------------------------------
# HDF5 can point out of a file: links, virtual datasets and raw data may lie in any other file that the reader
# may open. And a file of a few kilobytes can claim arrays of any size. This package writes neither, and refuses
# both.

BROKEN = (OSError, RuntimeError, KeyError, ValueError, TypeError, MemoryError)
"""What h5py raises on damaged files, and this module on those that are not plain."""
_FILTERS = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}
"""Built into HDF5; others are libraries that it would look for and load."""
_DENSEST = 1100  # deflate makes no data smaller than by this factor
_LIKELY = 20  # numbers of a simulation, or an array of other than zeros, get smaller by less
_MOST_UNPACKED = 1 << 26  # so much may be read at once whatever it was packed into [bytes]
_MOST_IN_ATTRIBUTE = 1000  # values; this package writes at most 4


@contextmanager
def open_hdf5(path: str | os.PathLike[str]) -> Iterator[h5py.File]:
    """An HDF5 file, open for reading.

    Raises:
        OSError: It cannot be read.
        ValueError: It is a pipe or device, for whose data HDF5 would wait.
        UserError: Somebody writes to it.
    """
    open_file(Path(path), ANY_SIZE).close()
    with opened(path) as file:
        yield file


def opened(path: str | os.PathLike[str]) -> h5py.File:
    """`h5py.File(path, "r")`, but a file that has a writer is not taken for damaged.

    Raises:
        UserError: Somebody writes to it.
    """
    try:
        return h5py.File(path, "r")
    except BlockingIOError as error:  # HDF5 locks what it writes to
        raise UserError(
            f"{path} is open for writing in another program; wait until that has closed it, or copy the file"
        ) from error


def own_attribute(owner: h5py.Group | h5py.Dataset, name: str) -> Any:
    """The value of an attribute, bytes as text; None where there is none.

    Raises:
        ValueError: It holds many values, of which each may be a text as long as the file.
    """
    if name not in owner.attrs:
        return None
    if np.prod(owner.attrs.get_id(name).shape or (), dtype=float) > _MOST_IN_ATTRIBUTE:
        raise ValueError(f"attribute {name!r} holds more than {_MOST_IN_ATTRIBUTE} values")
    value = owner.attrs[name]
    return value.decode("utf-8", errors="replace") if isinstance(value, bytes) else value


def own_object(file: h5py.Group, path: str) -> h5py.Group | h5py.Dataset | None:
    """The group or dataset at `path`; None where there is none.

    Raises:
        ValueError: A link on the way leads elsewhere.
    """
    found: h5py.Group | h5py.Dataset = file
    for part in path.strip("/").split("/"):
        link = found.get(part, getlink=True) if isinstance(found, h5py.Group) else None
        if link is None:
            return None
        if not isinstance(link, h5py.HardLink):
            raise ValueError(f"/{path} is a link to elsewhere; it must be in the file itself")
        found = found[part]
    return found


def own_dataset(file: h5py.Group, path: str, by_frame: bool = False) -> h5py.Dataset:
    """The dataset at `path`, whose values are in the file itself, all of them.

    `by_frame` says that it is read an index of the first axis at a time, not whole.

    Raises:
        KeyError: There is none.
        ValueError: Its values are elsewhere, it claims more of them than the file holds, or they unfold to more at once
            than what the file holds makes likely.
    """
    found = own_object(file, path)
    if not isinstance(found, h5py.Dataset):
        raise KeyError(f"dataset /{path} is missing")
    if found.is_virtual or found.external:
        raise ValueError(f"dataset /{path} shows values of another file; they must be in the file itself")
    layout = found.id.get_create_plist()
    filters = {layout.get_filter(i)[0] for i in range(layout.get_nfilters())}
    if filters - _FILTERS:
        raise ValueError(f"dataset /{path} is compressed in a way that needs more software; use deflate")
    if found.shape and found.dtype.hasobject:
        raise ValueError(f"dataset /{path} holds many texts, of which each may be as long as the file")
    stored = found.id.get_storage_size()
    packed = h5py.h5z.FILTER_DEFLATE in filters
    whole = float(np.prod(found.shape or (), dtype=float)) * found.dtype.itemsize
    chunk = float(np.prod(found.chunks or (0,), dtype=float)) * found.dtype.itemsize if found.size else 0.0
    if max(whole, chunk) > stored * (_DENSEST if packed else 1):
        raise ValueError(
            f"dataset /{path} claims {max(whole, chunk):.3g} bytes, but the file holds less of it"
        )
    at_once = max(whole / found.shape[0] if by_frame and found.shape and found.size else whole, chunk)
    if packed and at_once > max(_MOST_UNPACKED, _LIKELY * stored):
        raise ValueError(
            f"dataset /{path} would unfold from {stored:.3g} to {at_once:.3g} bytes; store it without compression"
        )
    return found


def own_view(file: h5py.Group, path: str) -> h5py.Dataset:
    """The virtual dataset at `path`, which shows values of the file itself.

    Raises:
        KeyError: There is none.
        ValueError: It shows those of another file.
    """
    found = own_object(file, path)
    if not isinstance(found, h5py.Dataset) or not found.is_virtual:
        raise KeyError(f"view /{path} is missing")
    if any(source.file_name != "." for source in found.virtual_sources()):
        raise ValueError(f"dataset {found.name} shows values of another file")
    return found
