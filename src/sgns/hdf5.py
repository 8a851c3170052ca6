"""Parts of an HDF5 file that anybody may have written.

HDF5 can point out of a file: links, virtual datasets and raw data may lie in any other file that the reader may
open. And a file of a few kilobytes can claim arrays of any size. This package writes neither, and refuses both.
"""

from __future__ import annotations

import h5py
import numpy as np

__all__ = ["BROKEN", "own_dataset", "own_object", "require_own_view"]

BROKEN = (OSError, RuntimeError, KeyError, ValueError, TypeError, MemoryError)
"""What h5py raises on damaged files, and this module on those that are not plain."""

_FILTERS = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}
"""Built into HDF5; others are libraries that it would look for and load."""
_DENSEST = 1100  # deflate makes no data smaller than by this factor


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


def own_dataset(file: h5py.Group, path: str) -> h5py.Dataset:
    """The dataset at `path`, whose values are in the file itself, all of them.

    Raises:
        KeyError: There is none.
        ValueError: Its values are elsewhere, or it claims more of them than the file holds.
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
    chunk = int(np.prod(found.chunks, dtype=float)) if found.chunks else 0
    claimed = max(float(np.prod(found.shape, dtype=float)), chunk if found.size else 0) * found.dtype.itemsize
    stored = found.id.get_storage_size() * (_DENSEST if h5py.h5z.FILTER_DEFLATE in filters else 1)
    if claimed > stored:
        raise ValueError(f"dataset /{path} claims {claimed:.3g} bytes, but the file holds less of it")
    return found


def require_own_view(view: h5py.Dataset) -> None:
    """Refuses a virtual dataset that shows other files than its own.

    Raises:
        ValueError: It does.
    """
    if any(source.file_name != "." for source in view.virtual_sources()):
        raise ValueError(f"dataset {view.name} shows values of another file")
