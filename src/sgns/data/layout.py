"""What a run file holds and where, and HDF5 files that anybody may have written."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from mpm_warp import SceneError
from mpm_warp.bodies import checked_mesh
from mpm_warp.inputs import MOST_BYTES, open_file
from sgns import __version__
from sgns.config import UserError

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


# --- What a run file holds and where: the H5MD 1.1 tree, its units and its root attributes --------------
# Letters: T frames, n soil particles, M body points.

FORMAT = "sgns-run"
"""Root attribute `format`: says that the file is ours."""
FORMAT_VERSION = 1
"""Root attribute `format_version`: raised when an older program could no longer read the file."""
PRODUCERS = ("mpm", "rollout")
"""Who may have made a run: the material point solver, or a trained network."""
_WHOLE, _REAL = (int, np.integer), (float, np.floating)
ATTRIBUTES: dict[str, type | tuple[type, ...]] = {
    "format": str,
    "format_version": _WHOLE,
    "package_version": str,
    "producer": str,
    "seed": _WHOLE,
    "frame_rate": _REAL,
    "wall_time_s": _REAL,
    "arrangement_hash": str,
    "content_hash": str,
    "scene": str,
    "effects": str,
    "extra": str,
}
"""Root attributes and their types; `scene`, `effects` and `extra` are YAML text in UTF-8."""
OPTIONAL = ("stopped",)
"""Root attributes that only some files have: why a run ended before its time."""
_SCENE_NUMBERS = "depth speed rake diameter width grouser_height load slip friction_angle gravity".split()
_BLADE_NUMBERS = ("thickness", "width", "length")
MESH = {"vertices": ("parameters/tool/vertices", "<f8"), "triangles": ("parameters/tool/triangles", "<i4")}
"""Path and type of the datasets that a run has whose tool is a mesh, shape (V, 3) [m] and (F, 3)."""


@dataclass(frozen=True)
class Element:
    """A time-dependent H5MD element: a group with `value`, `step` and `time`."""

    path: str
    tail: tuple[int | str, ...]
    """Shape of one frame; "n" and "M" stand for the counts of this run."""
    dtype: str
    si_unit: str
    description: str

    def shape(self, counts: dict[str, int]) -> tuple[int, ...]:
        """Shape of one frame when the letters have these values."""
        return tuple(counts[size] if isinstance(size, str) else size for size in self.tail)


# H5MD's own attribute `unit` is left unset on purpose: MDAnalysis refuses lengths in metres.
ELEMENTS = {
    "position": Element("particles/soil/position", ("n", 3), "<f4", "m", "soil particles, world frame"),
    "velocity": Element("particles/soil/velocity", ("n", 3), "<f4", "m/s", "soil particles, world frame"),
    "body_points": Element("particles/body/position", ("M", 3), "<f8", "m", "fixed to the body, world frame"),
    "force": Element(
        "observables/body/force", (3,), "<f8", "N", "by the soil on the body, world frame, mean of the frame"
    ),
    "torque": Element(
        "observables/body/torque",
        (3,),
        "<f8",
        "N m",
        "by the soil on the body about its centre of mass, world frame, mean over the frame",
    ),
    "pose": Element(
        "observables/body/pose",
        (7,),
        "<f8",
        "m, 1",
        "centre of mass x y z [m], then unit quaternion x y z w, body to world",
    ),
}


def read_attributes(file: h5py.File) -> dict[str, Any]:
    """The root attributes, those that only some files have too; text as str."""
    return {name: own_attribute(file, name) for name in (*ATTRIBUTES, *OPTIONAL) if name in file.attrs}


def write_text(owner: h5py.Group | h5py.Dataset, name: str, text: str) -> None:
    """Set a text attribute, in UTF-8 of fixed length.

    H5MD asks for that, and HDF5 guards it by a checksum, unlike text of variable length.
    """
    data = text.encode("utf-8") or b" "  # HDF5 has no text of length 0
    owner.attrs.create(name, data, dtype=h5py.string_dtype("utf-8", len(data)))


def one_line(error: object) -> str:
    """An error's text without line breaks, for a one-line message."""
    return " ".join(str(error).split()) or type(error).__name__


def open_run(path: str | os.PathLike[str]) -> h5py.File:
    """The run file, open for reading; only that it is a run of ours is certain.

    Raises:
        UserError: missing, unreadable, not HDF5, cut short, written by something else or by a newer sgns.
    """
    path = Path(path)
    if not os.path.exists(path):  # unlike Path.exists, takes any name
        raise UserError(f"no such run file: {path}; check the path, or make one with `sgns simulate`")
    if path.is_dir():
        raise UserError(f"{path} is a folder, not a run file; give one of the .h5 files in it")
    try:
        open_file(path, _ANY_SIZE).close()
    except ValueError:
        raise UserError(f"{path} is a pipe or device, not a run file") from None
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}; check its permissions") from error
    if not h5py.is_hdf5(path):
        raise UserError(f"{path} is not an HDF5 file; give a run made by `sgns simulate` or `sgns rollout`")
    try:
        file = h5py.File(path, "r")
    except BROKEN as error:
        raise UserError(
            f"{path} is cut short or damaged and cannot be opened ({_reason(error)}); "
            "copy it again or repeat the run"
        ) from error
    try:
        _require_ours(file, path)
    except BaseException:
        file.close()
        raise
    return file


def _reason(error: Exception) -> str:
    """The part of an HDF5 message that tells a person something."""
    text = one_line(error)
    if "truncated" in text:
        return "the file is shorter than its header says"
    if "already open for" in text:
        return "its writer never closed it"
    return text


def _require_ours(file: h5py.File, path: Path) -> None:
    try:
        made_as = own_attribute(file, "format")
        version = own_attribute(file, "format_version")
    except BROKEN as error:
        raise UserError(f"{path} is damaged ({_reason(error)}); copy it again or repeat the run") from error
    if not isinstance(made_as, str) or made_as != FORMAT:
        raise UserError(
            f"{path} is HDF5 but not a run of sgns (root attribute `format` is not {FORMAT!r}); "
            "give a file made by `sgns simulate` or `sgns rollout`"
        )
    if not isinstance(version, (int, np.integer)):
        raise UserError(f"{path} has no whole number as root attribute `format_version`; repeat the run")
    if version > FORMAT_VERSION:
        raise UserError(
            f"{path} has run format {version}, but sgns {__version__} reads up to {FORMAT_VERSION}; "
            "upgrade sgns"
        )


def structure_problems(file: h5py.File) -> list[str]:
    """What is missing or has the wrong shape, in words; reads no bulk data.

    A file without such problems can be read by `Run` without surprises.
    """
    problems = _attribute_problems(file)
    counts: dict[str, int] = {}
    for element in ELEMENTS.values():
        problems += _element_problems(file, element, counts)
    return problems + _mesh_problems(file)


def read_mesh(file: h5py.File) -> tuple[np.ndarray, np.ndarray] | None:
    """Vertices (V, 3) about the centre of mass [m] and triangles (F, 3) of a run whose tool is a mesh, checked; None if
    there is none.

    Raises:
        One of sgns.data.layout.BROKEN: It is damaged.
    """
    if own_object(file, MESH["vertices"][0]) is None:
        return None
    try:
        return checked_mesh(*(own_dataset(file, path)[...] for path, _ in MESH.values()))
    except SceneError as error:
        raise ValueError(str(error)) from error


def require_mesh_was_read(scene: object) -> None:
    """Refuses a scene out of a file whose tool is a mesh without a digest: such a scene is a person's wish to read the
    file it names, and no file may have wishes.

    Raises:
        ValueError: It is one.
    """
    tool = scene.get("tool") if isinstance(scene, dict) else None
    if isinstance(tool, dict) and tool.get("shape") == "mesh":
        if not isinstance(tool.get("digest"), str) or not tool["digest"]:
            raise ValueError("its scene names a mesh file without the digest of what was read from it")


def _mesh_problems(file: h5py.File) -> list[str]:
    missing, problems = [], []
    for path, dtype in MESH.values():
        try:
            if own_object(file, path) is None:
                missing.append(f"dataset /{path} is missing")
                continue
            found = own_dataset(file, path)
        except (KeyError, ValueError) as error:
            problems.append(one_line(error).strip("'"))
            continue
        if found.ndim != 2 or found.shape[1] != 3 or not len(found):
            problems.append(f"dataset /{path} has shape {found.shape}, expected (at least 1, 3)")
        elif found.dtype != np.dtype(dtype):
            problems.append(f"dataset /{path} has the wrong type {found.dtype}")
        elif found.size * found.dtype.itemsize > MOST_BYTES:
            problems.append(f"dataset /{path} is larger than {MOST_BYTES / 1e6:.0f} MB")
    return problems or (missing if len(missing) == 1 else [])  # without both there is no mesh


def _attribute_problems(file: h5py.File) -> list[str]:
    problems = [f"root attribute {name!r} is missing" for name in ATTRIBUTES if name not in file.attrs]
    values = read_attributes(file)
    for name, kind in ATTRIBUTES.items():
        if name in values and not isinstance(values[name], kind):
            problems.append(f"root attribute {name!r} has the wrong type ({type(values[name]).__name__})")
    for name, allowed in (("frame_rate", "above 0 Hz"), ("wall_time_s", "0 s or more")):
        value = values.get(name)
        if isinstance(value, _REAL) and not (0 <= value < math.inf and (value > 0 or name == "wall_time_s")):
            problems.append(f"{name} is {value}; it must be {allowed}")
    digest = values.get("content_hash")  # it becomes the name of a file
    if isinstance(digest, str) and not re.fullmatch("[0-9a-f]{32}", digest):
        problems.append(f"root attribute 'content_hash' is {digest[:40]!r}, not 32 hexadecimal digits")
    return problems


def scene_problems(scene: Mapping[str, Any]) -> list[str]:
    """Values of a scene that are not the numbers which others calculate with, in words; what is not there is none."""
    found = [(key, scene[key]) for key in _SCENE_NUMBERS if scene.get(key) is not None]
    blade = scene.get("blade")
    if blade is not None:
        if not isinstance(blade, Mapping):
            return [f"scene.blade is {blade!r:.40}, not a group of keys"]
        found += [(f"blade.{key}", blade.get(key)) for key in _BLADE_NUMBERS]
    return [
        f"scene.{key} is {value!r:.40}, not a finite number"
        for key, value in found
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < math.inf
    ]


def _element_problems(file: h5py.File, element: Element, counts: dict[str, int]) -> list[str]:
    """Problems of one element; `counts` gathers T, n and M from the first element that shows them."""
    datasets = {}
    problems = []
    for part in ("value", "step", "time"):
        path = f"{element.path}/{part}"
        try:
            found = own_dataset(file, path, by_frame="n" in element.tail and part == "value")
        except KeyError:
            problems.append(f"dataset /{path} is missing")
            continue
        except ValueError as error:
            problems.append(str(error))
            continue
        if found.dtype.kind not in ("iu" if part == "step" else "f"):
            problems.append(f"dataset /{path} has the wrong type {found.dtype}")
        else:
            datasets[part] = found
    for part, found in datasets.items():
        expected = ("T", *element.tail) if part == "value" else ("T",)
        wanted = tuple(
            counts.get(size, actual) if isinstance(size, str) else size
            for size, actual in zip(expected, found.shape, strict=False)
        )
        if len(found.shape) != len(expected) or found.shape != wanted:
            shown = ", ".join(str(counts.get(size, size)) for size in expected)  # a letter if not known yet
            problems.append(f"dataset {found.name} has shape {found.shape}, expected ({shown})")
            continue
        if found.shape[0] == 0:
            problems.append(f"dataset {found.name} holds no frame")
        for size, actual in zip(expected, found.shape, strict=True):
            if isinstance(size, str):
                counts.setdefault(size, actual)
    return problems
