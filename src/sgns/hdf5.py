"""Parts of an HDF5 file that anybody may have written.

HDF5 can point out of a file: links, virtual datasets and raw data may lie in any other file that the reader may
open. And a file of a few kilobytes can claim arrays of any size. This package writes neither, and refuses both.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from mpm_warp.inputs import open_file

__all__ = ["BROKEN", "open_hdf5", "own_attribute", "own_dataset", "own_object", "require_own_view"]

BROKEN = (OSError, RuntimeError, KeyError, ValueError, TypeError, MemoryError)
"""What h5py raises on damaged files, and this module on those that are not plain."""

_FILTERS = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}
"""Built into HDF5; others are libraries that it would look for and load."""
_DENSEST = 1100  # deflate makes no data smaller than by this factor
_LIKELY = 20  # numbers of a simulation, or an array of other than zeros, get smaller by less
_MOST_UNPACKED = 1 << 26  # so much may be read at once whatever it was packed into [bytes]
_ANY_SIZE = 1 << 62
_MOST_IN_ATTRIBUTE = 1000  # values; this package writes at most 4


@contextmanager
def open_hdf5(path: str | os.PathLike[str]) -> Iterator[h5py.File]:
    """An HDF5 file, open for reading.

    Raises:
        OSError: It cannot be read.
        ValueError: It is a pipe or device, for whose data HDF5 would wait.
    """
    open_file(Path(path), _ANY_SIZE).close()
    with h5py.File(path, "r") as file:
        yield file


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

    Args:
        file: Where to look.
        path: From there.
        by_frame: Whether it is read a frame (an index of the first axis) at a time, and not whole.

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
    at_once = max(whole / found.shape[0] if by_frame and found.size else whole, chunk)
    if packed and at_once > max(_MOST_UNPACKED, _LIKELY * stored):
        raise ValueError(
            f"dataset /{path} would unfold from {stored:.3g} to {at_once:.3g} bytes; store it without compression"
        )
    return found


def require_own_view(view: h5py.Dataset) -> None:
    """Refuses a virtual dataset that shows other files than its own.

    Raises:
        ValueError: It does.
    """
    if any(source.file_name != "." for source in view.virtual_sources()):
        raise ValueError(f"dataset {view.name} shows values of another file")
