"""What is in a run file, whether the solver or a network made it, and where; opening one that may be anything; how
other programs see it.

Letters: T frames, n soil particles, M body points, k further bodies; V vertices and F triangles of a mesh.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from mpm_warp import SceneError
from mpm_warp.settings import MOST_BYTES, open_file
from mpm_warp.solids import checked_mesh
from sgns import __version__
from sgns.config import UserError
from sgns.data.files import ANY_SIZE, one_line
from sgns.data.hdf5 import BROKEN, opened, own_attribute, own_dataset, own_object

# --- What is in the file: the H5MD 1.1 tree, its units and its root attributes --------------------------

FORMAT = "sgns-run"
"""Root attribute `format`: says that the file is ours."""
FORMAT_VERSION = 1
"""Root attribute `format_version`: raised when an older program could no longer read the file."""
PRODUCERS = ("mpm", "rollout", "imported")
"""Who may have made a run: the material point solver, a trained network, or another simulator."""
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
STOPPED = "stopped"
"""Root attribute that only some files have: why a run ended before its time."""
STATE = "state"
"""Group of a solver's run: its arrays at the last frame, to go on or to start another run from."""
WHOLE = "whole"
"""The one of them that says how the whole bed follows from the half that was computed."""


@dataclass(frozen=True)
class Recorded:
    """Numbers in a run file."""

    path: str
    """Of the dataset; of a time-dependent one, an H5MD element, the group with `value`, `step` and `time`."""
    tail: tuple[int | str, ...]
    """Shape, of one frame of a time-dependent one; letters stand for the counts of this run."""
    dtype: str
    si_unit: str
    description: str


# H5MD's own attribute `unit` is left unset on purpose: MDAnalysis refuses lengths in metres.
SERIES = {
    "position": Recorded("particles/soil/position", ("n", 3), "<f4", "m", "soil particles, world frame"),
    "velocity": Recorded("particles/soil/velocity", ("n", 3), "<f4", "m/s", "soil particles, world frame"),
    "body_points": Recorded(
        "particles/body/position", ("M", 3), "<f8", "m", "fixed to the body, world frame"
    ),
    "force": Recorded(
        "observables/body/force", (3,), "<f8", "N", "by the soil on the body, world frame, mean of the frame"
    ),
    "torque": Recorded(
        "observables/body/torque",
        (3,),
        "<f8",
        "N m",
        "by the soil on the body about its centre of mass, world frame, mean over the frame",
    ),
    "pose": Recorded(
        "observables/body/pose",
        (7,),
        "<f8",
        "m, 1",
        "centre of mass x y z [m], then unit quaternion x y z w, body to world",
    ),
}
"""What is recorded in every frame."""
OTHERS = {
    "other_pose": Recorded("observables/others/pose", ("k", 7), "<f8", "m, 1", "as of the body"),
    "other_force": Recorded("observables/others/force", ("k", 3), "<f8", "N", "as of the body"),
    "other_torque": Recorded("observables/others/torque", ("k", 3), "<f8", "N m", "as of the body"),
}
"""What a run has besides whose scene has further bodies."""
SPREAD = {
    "force_spread": Recorded(
        "observables/body/force_spread",
        (3,),
        "<f8",
        "N",
        "half the width of a band that is to hold 90 %",
    )
}
"""What a rollout has besides whose checkpoint holds several networks, where it was asked for."""
OTHER_MESHES = "parameters/others"
"""Group of the meshes of further bodies, each in a group that has its number."""


def mesh_parts(body: int = 0) -> tuple[Recorded, Recorded]:
    """What a run has besides where a body is a mesh: the tool, number 0, or a further one, from 1 on."""
    place = f"{OTHER_MESHES}/{body - 1}" if body else "parameters/tool"
    words = "of the tool, about its centre of mass, body frame"
    return (
        Recorded(f"{place}/vertices", ("V", 3), "<f8", "m", words),
        Recorded(f"{place}/triangles", ("F", 3), "<i4", "", "vertices of each triangle, facing outwards"),
    )


def series(file: h5py.File, name: str, part: str = "value") -> h5py.Dataset:
    """A dataset of one of `SERIES`, `OTHERS` or `SPREAD`: its `value`, `step` or `time`."""
    return file[f"{(SERIES | OTHERS | SPREAD)[name].path}/{part}"]


def recorded_in(file: h5py.File) -> dict[str, Recorded]:
    """`SERIES`, and what there is of `OTHERS` and `SPREAD`."""
    found = dict(SERIES)
    for path, more in (("observables/others", OTHERS), (SPREAD["force_spread"].path, SPREAD)):
        found |= more if own_object(file, path) is not None else {}
    return found


# --- Opening a file that may be anything ----------------------------------------------------------------


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
        open_file(path, ANY_SIZE).close()
    except ValueError:
        raise UserError(f"{path} is a pipe or device, not a run file") from None
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}; check its permissions") from error
    if not h5py.is_hdf5(path):
        raise UserError(f"{path} is not an HDF5 file; give a run made by `sgns simulate` or `sgns rollout`")
    try:
        file = opened(path)
    except BROKEN as error:
        raise UserError(
            f"{path} is cut short or damaged and cannot be opened ({_reason(error)}); "
            "copy it again or repeat the run"
        ) from error
    with ExitStack() as unless_ours:
        unless_ours.callback(file.close)
        try:
            made_as, version = own_attribute(file, "format"), own_attribute(file, "format_version")
        except BROKEN as error:
            raise UserError(
                f"{path} is damaged ({_reason(error)}); copy it again or repeat the run"
            ) from error
        if not isinstance(made_as, str) or made_as != FORMAT:
            raise UserError(
                f"{path} is HDF5 but not a run of sgns (root attribute `format` is not {FORMAT!r}); "
                "give a file made by `sgns simulate` or `sgns rollout`"
            )
        if not isinstance(version, _WHOLE):
            raise UserError(f"{path} has no whole number as root attribute `format_version`; repeat the run")
        if version > FORMAT_VERSION:
            raise UserError(
                f"{path} has run format {version}, but sgns {__version__} reads up to {FORMAT_VERSION}; "
                "upgrade sgns"
            )
        unless_ours.pop_all()
    return file


def _reason(error: Exception) -> str:
    """The part of an HDF5 message that tells a person something."""
    text = one_line(error)
    if "truncated" in text:
        return "the file is shorter than its header says"
    if "already open for" in text:
        return "it is being written, or its writer never closed it"
    return text


def read_attributes(file: h5py.File) -> dict[str, Any]:
    """The root attributes that are there, text as str."""
    return {name: own_attribute(file, name) for name in (*ATTRIBUTES, STOPPED) if name in file.attrs}


def read_mesh(file: h5py.File, body: int = 0) -> tuple[np.ndarray, np.ndarray] | None:
    """Vertices (V, 3) about the centre of mass [m] and triangles (F, 3) of a body that is a mesh, see `mesh_parts`,
    checked; None if there is none.

    Raises:
        One of sgns.data.hdf5.BROKEN: It is damaged.
    """
    parts = mesh_parts(body)
    if own_object(file, parts[0].path) is None:
        return None
    try:
        return checked_mesh(*(own_dataset(file, part.path)[...] for part in parts))
    except SceneError as error:
        raise ValueError(str(error)) from error


def require_mesh_was_read(scene: object) -> None:
    """Refuses a scene out of a file in which a body is a mesh without a digest: such a scene is a person's wish to read
    the file it names, and no file may have wishes.

    Raises:
        ValueError: It is one.
    """
    if not isinstance(scene, dict):
        return
    others = scene.get("others")
    for body in (scene, *(others if isinstance(others, list) else ())):
        tool = body.get("tool") if isinstance(body, dict) else None
        if isinstance(tool, dict) and tool.get("shape") == "mesh":
            if not isinstance(tool.get("digest"), str) or not tool["digest"]:
                raise ValueError("its scene names a mesh file without the digest of what was read from it")


def structure_problems(file: h5py.File) -> list[str]:
    """What is missing or has the wrong shape, in words; reads no bulk data.

    A file without such problems can be read by `Run` without surprises.
    """
    counts: dict[str, int] = {}  # T, n and M, from the first that shows them
    problems = list(_attribute_problems(file))
    for recorded in recorded_in(file).values():
        problems += _series_problems(file, recorded, counts)
    meshes = own_object(file, OTHER_MESHES)
    numbers = meshes if isinstance(meshes, h5py.Group) else ()
    bodies = [0, *(1 + int(number) for number in numbers if number.isdecimal())]
    return problems + [words for body in bodies for words in _mesh_problems(file, body)]


def _attribute_problems(file: h5py.File) -> Iterator[str]:
    values = read_attributes(file)
    yield from (f"root attribute {name!r} is missing" for name in ATTRIBUTES if name not in values)
    for name, kind in ATTRIBUTES.items():
        if name in values and not isinstance(values[name], kind):
            yield f"root attribute {name!r} has the wrong type ({type(values[name]).__name__})"
    for name, allowed in (("frame_rate", "above 0 Hz"), ("wall_time_s", "0 s or more")):
        value = values.get(name)
        if isinstance(value, _REAL) and not (0 <= value < math.inf and (value > 0 or name == "wall_time_s")):
            yield f"{name} is {value}; it must be {allowed}"
    digest = values.get("content_hash")  # it becomes the name of a file
    if isinstance(digest, str) and not re.fullmatch("[0-9a-f]{32}", digest):
        yield f"root attribute 'content_hash' is {digest[:40]!r}, not 32 hexadecimal digits"


def _series_problems(file: h5py.File, recorded: Recorded, counts: dict[str, int]) -> Iterator[str]:
    datasets = {}
    for part in ("value", "step", "time"):
        path = f"{recorded.path}/{part}"
        try:
            found = own_dataset(file, path, by_frame=part == "value" and "n" in recorded.tail)
        except KeyError:
            yield f"dataset /{path} is missing"
            continue
        except ValueError as error:
            yield str(error)
            continue
        if found.dtype.kind in ("iu" if part == "step" else "f"):
            datasets[part] = found
        else:
            yield f"dataset /{path} has the wrong type {found.dtype}"
    for part, found in datasets.items():
        expected = ("T", *recorded.tail) if part == "value" else ("T",)
        known = [counts.get(size, size) if isinstance(size, str) else size for size in expected]
        fits = len(found.shape) == len(known) and all(
            isinstance(size, str) or size == actual for size, actual in zip(known, found.shape, strict=True)
        )
        if not fits:
            shown = ", ".join(map(str, known))  # a letter if not known yet
            yield f"dataset {found.name} has shape {found.shape}, expected ({shown})"
            continue
        if found.shape[0] == 0:
            yield f"dataset {found.name} holds no frame"
        counts |= {size: n for size, n in zip(known, found.shape, strict=True) if isinstance(size, str)}


def _mesh_problems(file: h5py.File, body: int) -> list[str]:
    missing, problems = [], []
    for part in mesh_parts(body):
        path = part.path
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
        elif found.dtype != np.dtype(part.dtype):
            problems.append(f"dataset /{path} has the wrong type {found.dtype}")
        elif found.size * found.dtype.itemsize > MOST_BYTES:
            problems.append(f"dataset /{path} is larger than {MOST_BYTES / 1e6:.0f} MB")
    return problems or (missing if len(missing) == 1 else [])  # without both there is no mesh


# --- How ParaView and VTK see it --------------------------------------------------------------------
# The group /VTKHDF describes a point cloud that changes with time (VTKHDF 2.0, PolyData with one vertex per
# particle). `Points` and `PointData/velocity` are HDF5 virtual datasets: they show the H5MD arrays, reshaped
# from (T, n, 3) to (T n, 3), and hold no copy. Format: docs.vtk.org, "VTKHDF file format".

VIEW_ATTRIBUTES = {
    "Version": np.array((2, 0), dtype="<i8"),  # the first with PolyData in time; newer readers take every 2.x
    "Type": np.bytes_("PolyData"),  # the reader wants ASCII of fixed length
}
VIEWS = {"position": "Points", "velocity": "PointData/velocity"}
"""Recorded soil → the dataset of /VTKHDF that shows it."""


def view_arrays(frames: int, points: int, triangles: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Path → numbers of what is in the group besides the points, their velocities and the times.

    Without triangles, numbers of points (t, 3), the points are particles, each with a velocity.
    """
    # Sizes and cells are the same in every frame, so one part is described and every frame points at it. (One
    # entry per frame would also be good VTKHDF, but VTK 9.3 then looks for the cells in the wrong place.)
    arrays: dict[str, Any] = {"NumberOfPoints": [points]}
    known = {"Vertices": np.arange(points)[:, None]} if triangles is None else {"Polygons": triangles}
    for name in ("Vertices", "Lines", "Polygons", "Strips"):
        cells = known.get(name, np.zeros((0, 1)))
        arrays |= {
            f"{name}/NumberOfCells": [len(cells)],
            f"{name}/NumberOfConnectivityIds": [cells.size],
            f"{name}/Offsets": np.arange(len(cells) + 1) * cells.shape[1],
            f"{name}/Connectivity": cells.ravel(),
        }
    arrays |= {
        "Steps/PartOffsets": np.zeros(frames),
        "Steps/NumberOfParts": np.ones(frames),
        "Steps/PointOffsets": np.arange(frames) * points,
        "Steps/CellOffsets": np.zeros((frames, 4)),
        "Steps/ConnectivityIdOffsets": np.zeros((frames, 4)),
    }
    if triangles is None:
        arrays["Steps/PointDataOffsets/velocity"] = np.arange(frames) * points
    return {path: np.asarray(values, dtype="<i8") for path, values in arrays.items()}


def write_steps(group: h5py.Group, times: Any, points: int, triangles: np.ndarray | None = None) -> None:
    """What makes a group with points PolyData in time, see `view_arrays`; `times` [s] may be a dataset to link."""
    group.attrs.update(VIEW_ATTRIBUTES)
    for path, values in view_arrays(len(times), points, triangles).items():
        group[path] = values
    group["Steps/Values"] = times
    group["Steps"].attrs["NSteps"] = np.int64(len(times))


def _write_cloud(file: h5py.File) -> None:
    frames, particles, axes = series(file, "position").shape
    group = file.create_group("VTKHDF")
    for name, path in VIEWS.items():
        source = series(file, name)
        layout = h5py.VirtualLayout(shape=(frames * particles, axes), dtype=source.dtype)
        # "." is HDF5's name for the file that holds the virtual dataset, whatever it is called later.
        layout[...] = h5py.VirtualSource(".", source.name, shape=source.shape, dtype=source.dtype)
        group.create_virtual_dataset(path, layout)
    write_steps(group, series(file, "position", "time"), particles)


# --- How xarray and netCDF see it -------------------------------------------------------------------
# What is recorded has a second name at the root of the file, and dimensions with names there: HDF5's dimension scales,
# as netCDF has them. So `xarray.open_dataset("run.h5", engine="h5netcdf")` needs no help.

DIMENSIONS: dict[int | str, str] = {
    "n": "particle",
    "M": "point",
    "k": "body",
    3: "axis",
    7: "component",
}
"""Size of one frame's arrays, as in `Recorded.tail` → the name of the dimension."""
COORDINATES = {"axis": list("xyz"), "component": "x y z qx qy qz qw".split()}
_NO_VARIABLE = "This is a netCDF dimension but not a netCDF variable.{:10d}"


def _write_names(file: h5py.File) -> None:
    file["time"] = series(file, "position", "time")
    file["time"].make_scale("time")
    for name, recorded in recorded_in(file).items():
        values = file[name] = series(file, name)  # a hard link
        for axis, size in enumerate(("time", *(DIMENSIONS[size] for size in recorded.tail))):
            if size not in file:
                _write_dimension(file, size, values.shape[axis])
            values.dims[axis].attach_scale(file[size])


def _write_dimension(file: h5py.File, name: str, size: int) -> None:
    if name in COORDINATES:
        file.create_dataset(name, data=COORDINATES[name], dtype=h5py.string_dtype())
        file[name].make_scale(name)
    else:  # it takes no room: nothing is ever written into it
        file.create_dataset(name, (size,), "<i4").make_scale(_NO_VARIABLE.format(size))


def write_views(file: h5py.File) -> None:
    """Add both to a file that has everything else."""
    _write_cloud(file)
    _write_names(file)
