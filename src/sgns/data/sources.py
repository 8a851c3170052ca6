"""Arrays of one run from files of other simulators, for `sgns import`.

A source is a file (.npz, .h5, .hdf5), or a folder with all files of one run: these, CSV tables of the body, and series
of .vtu or .vtp files of the soil.
"""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import h5py
import numpy as np

from sgns.config import UserError, library
from sgns.data.files import read_arrays, read_table
from sgns.data.hdf5 import BROKEN, open_hdf5, own_attribute, own_dataset
from sgns.data.run import POSE

PAGE = "docs/guides/import.md says what a run must hold"

ARRAYS = (
    "position",
    "velocity",
    "id",
    "time",
    "pose",
    "force",
    "torque",
    "body_points",
    "vertices",
    "triangles",
)
"""What is looked for in a source, by the names of `Import.names`; single numbers besides become values of the scene."""
_TAKEN = ("kind", "name", "bed", "tool", "duration", "frame_rate", "others", "material")
"""Keys of a scene that are no single number, or follow from the run."""
_COLUMNS = {"pose": POSE, "force": ["Fx", "Fy", "Fz"], "torque": ["Tx", "Ty", "Tz"]}
_SOIL, _ARCHIVES = (".vtu", ".vtp"), (".npz", ".h5", ".hdf5")


def found_sources(given: str | Sequence[str]) -> list[Path]:
    """Files and folders that paths and patterns stand for, in the order of their names' numbers."""
    found: list[Path] = []
    for one in [given] if isinstance(given, str) else given:
        if os.path.exists(one):
            found.append(Path(one))
        elif matches := glob.glob(one):
            found += sorted(map(Path, matches), key=_natural)
        else:
            raise UserError(f"source: no file or folder {one} in {Path.cwd()}")
    if not found:
        raise UserError("source is []; give files or folders, each with one run: sgns import run.npz run.h5")
    return found


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sorts file_2 before file_10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", str(path))]


def read_source(source: Path, names: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Arrays and single numbers of one run, by our names.

    Raises:
        UserError: A file cannot be read, or two hold the same array.
    """
    files = sorted(source.iterdir(), key=_natural) if source.is_dir() else [source]
    soil = [file for file in files if file.suffix.lower() in _SOIL]
    if "*" in names["position"]:
        soil = [file for file in soil if file.match(names["position"])]
    found: dict[str, np.ndarray] = {}
    where: dict[str, Path] = {}
    for file in files:
        kind = file.suffix.lower()
        if kind in _ARCHIVES:
            arrays = _archive(file, names)
        elif kind == ".csv":
            arrays = _table(file)
        elif file in soil[:1]:
            arrays = _series(soil, names)
        else:
            continue
        for name, values in arrays.items():
            if name in found:
                raise UserError(
                    f"{source}: {name} is in {where[name].name} and in {file.name}; leave one out"
                )
            found[name], where[name] = values, file
    if not found:
        kinds = ", ".join((*_ARCHIVES, ".csv", *_SOIL))
        raise UserError(
            f"{source} holds nothing that can be imported; it needs files of these kinds: {kinds}"
        )
    return found


def _archive(file: Path, names: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Of an NPZ or HDF5 file."""
    advice = f"write it again; {PAGE}"
    if file.suffix.lower() == ".npz":
        every = read_arrays(file, "no archive of arrays", advice, large=True)
        found = {name: every[names[name]] for name in ARRAYS if names[name] in every}
        single, there = {name: values for name, values in every.items() if values.ndim == 0}, list(every)
    else:
        try:
            with open_hdf5(file) as content:
                found = {
                    name: own_dataset(content, names[name])[...]
                    for name in ARRAYS
                    if isinstance(content.get(names[name]), h5py.Dataset)
                }
                single = {name: np.asarray(own_attribute(content, name)) for name in content.attrs}
                there = list(content)
        except BROKEN as error:
            raise UserError(
                f"{file} cannot be read as HDF5 ({str(error).splitlines()[0]}); {advice}"
            ) from error
    if not found:
        wanted = ", ".join(names[name] for name in ARRAYS)
        raise UserError(
            f"{file} holds none of {wanted}, but {', '.join(there[:8]) or 'nothing'}; say which is which, as in "
            "names.position=x; in HDF5 as a path"
        )
    numbers = {
        name: values for name, values in single.items() if values.ndim == 0 and values.dtype.kind in "iuf"
    }
    return {
        name: values for name, values in numbers.items() if name not in _TAKEN or name == "frame_rate"
    } | found


def _table(file: Path) -> dict[str, np.ndarray]:
    """Of a CSV table with a row for each frame, columns as of `sgns convert run.h5 out.csv` or of a path."""
    rows = read_table(file, "no table of a body", f"repair it; {PAGE}")
    columns = {("time" if name == "t" else name): name for name in (rows[0] if rows else {})}
    found = {}
    for name, wanted in {"time": ["time"], **_COLUMNS}.items():
        if set(wanted) <= set(columns):
            try:
                values = np.array([[float(row[columns[one]]) for one in wanted] for row in rows])
            except ValueError as error:
                raise UserError(f"{file}: {error}; its rows must be numbers") from None
            found[name] = values[:, 0] if name == "time" else values
    return found


def _series(files: Sequence[Path], names: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Points of .vtu or .vtp files, a frame each; their point data velocity and id, and their time."""
    if len(kinds := {re.sub(r"\d+", "#", file.name) for file in files}) > 1:
        one, other = sorted(kinds)[:2]
        pattern = one.replace("#", "*")
        raise UserError(
            f"{files[0].parent} holds several series, {one} and {other}; say which is the soil: "
            f"names.position='{pattern}'"
        )
    reader = library("vtkmodules.vtkIOXML", "reading .vtu and .vtp files").vtkXMLGenericDataObjectReader()
    to_numpy = library("vtkmodules.util.numpy_support", "reading .vtu and .vtp files").vtk_to_numpy
    parts: dict[str, list[np.ndarray]] = {}
    for file in files:
        reader.SetFileName(str(file))
        reader.Update()
        data = reader.GetOutput()
        if data is None or data.GetNumberOfPoints() == 0:
            raise UserError(f"{file} holds no points; it needs those of the soil")
        frame = {"position": data.GetPoints().GetData(), "time": data.GetFieldData().GetArray("TimeValue")}
        frame |= {name: data.GetPointData().GetArray(names[name]) for name in ("velocity", "id")}
        for name, values in frame.items():
            if values is not None:
                parts.setdefault(name, []).append(to_numpy(values).copy())
    for name, values in parts.items():
        if len(values) != len(files) or len({len(one) for one in values}) > 1:
            raise UserError(f"{files[0].parent}: not all {len(files)} files have the same number of {name}")
    found = {name: np.stack(values) for name, values in parts.items()}
    return found | ({"time": found["time"][:, 0]} if "time" in found else {})
