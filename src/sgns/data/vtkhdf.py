"""A view of a run's soil for ParaView and VTK inside the run file itself.

The group /VTKHDF describes a point cloud that changes with time (VTKHDF 2.0, PolyData with one vertex per
particle). `Points` and `PointData/velocity` are HDF5 virtual datasets: they show the H5MD arrays, reshaped
from (T, n, 3) to (T n, 3), and hold no copy. Format: docs.vtk.org, "VTKHDF file format".
"""

from __future__ import annotations

import h5py
import numpy as np

from sgns.data.layout import own_dataset, own_object, require_own_view

_GROUP = "VTKHDF"
_VERSION = (2, 0)  # the first with PolyData in time; newer readers take every 2.x
_TOPOLOGIES = ("Vertices", "Lines", "Polygons", "Strips")


def write_view(file: h5py.File, position: h5py.Dataset, velocity: h5py.Dataset, time: h5py.Dataset) -> None:
    """Add /VTKHDF to an open run.

    Args:
        file: run open for writing.
        position: [m], shape (T, n, 3).
        velocity: [m/s], shape (T, n, 3).
        time: [s], shape (T,); shared by a hard link.
    """
    frames, particles, _ = position.shape
    group = file.create_group(_GROUP)
    group.attrs["Version"] = np.array(_VERSION, dtype="<i8")
    group.attrs["Type"] = np.bytes_("PolyData")  # the reader wants ASCII of fixed length

    _virtual(group, "Points", position)
    _virtual(group.create_group("PointData"), "velocity", velocity)
    # Sizes and cells are the same in every frame, so one part is described and every frame points at it. (One
    # entry per frame would also be good VTKHDF, but VTK 9.3 then looks for the cells in the wrong place.)
    group["NumberOfPoints"] = np.array([particles], dtype="<i8")
    for name in _TOPOLOGIES:
        count = particles if name == "Vertices" else 0
        topology = group.create_group(name)
        topology["NumberOfCells"] = np.array([count], dtype="<i8")
        topology["NumberOfConnectivityIds"] = np.array([count], dtype="<i8")
        topology["Offsets"] = np.arange(count + 1, dtype="<i8")
        topology["Connectivity"] = np.arange(count, dtype="<i8")

    steps = group.create_group("Steps")
    steps.attrs["NSteps"] = np.int64(frames)
    steps["Values"] = time
    point_offsets = np.arange(frames, dtype="<i8") * particles
    steps["PartOffsets"] = np.zeros(frames, dtype="<i8")
    steps["NumberOfParts"] = np.ones(frames, dtype="<i8")
    steps["PointOffsets"] = point_offsets
    steps["CellOffsets"] = np.zeros((frames, len(_TOPOLOGIES)), dtype="<i8")
    steps["ConnectivityIdOffsets"] = np.zeros((frames, len(_TOPOLOGIES)), dtype="<i8")
    steps.create_group("PointDataOffsets")["velocity"] = point_offsets


def _virtual(group: h5py.Group, name: str, source: h5py.Dataset) -> None:
    """A dataset (T n, 3) that shows `source` (T, n, 3) of the same file."""
    frames, particles, axes = source.shape
    layout = h5py.VirtualLayout(shape=(frames * particles, axes), dtype=source.dtype)
    # "." is HDF5's name for the file that holds the virtual dataset, whatever it is called later.
    layout[...] = h5py.VirtualSource(".", source.name, shape=source.shape, dtype=source.dtype)
    group.create_virtual_dataset(name, layout)


def view_problems(file: h5py.File, frames: int, particles: int) -> list[str]:
    """Where /VTKHDF does not fit the H5MD arrays, in words; the values behind it are not compared."""
    group = own_object(file, _GROUP)
    if not isinstance(group, h5py.Group):
        return ["group /VTKHDF is missing: ParaView cannot open the file"]
    problems = []
    if tuple(np.atleast_1d(group.attrs.get("Version", ()))) != _VERSION:
        problems.append(f"attribute Version of /VTKHDF is not {_VERSION}")
    if group.attrs.get("Type") != np.bytes_("PolyData"):
        problems.append("attribute Type of /VTKHDF is not PolyData")
    expected = {
        "NumberOfPoints": np.array([particles]),
        "Vertices/NumberOfCells": np.array([particles]),
        "Vertices/Connectivity": np.arange(particles),
        "Vertices/Offsets": np.arange(particles + 1),
        "Steps/Values": file["particles/soil/position/time"][...],
        "Steps/PartOffsets": np.zeros(frames),
        "Steps/PointOffsets": np.arange(frames) * particles,
        "Steps/CellOffsets": np.zeros((frames, len(_TOPOLOGIES))),
        "Steps/ConnectivityIdOffsets": np.zeros((frames, len(_TOPOLOGIES))),
        "Steps/PointDataOffsets/velocity": np.arange(frames) * particles,
    }
    for name, values in expected.items():
        try:
            found = own_dataset(group, name)
        except KeyError:
            problems.append(f"dataset /VTKHDF/{name} is missing")
            continue
        if found.shape != values.shape or not np.array_equal(found[...], values):
            problems.append(f"dataset /VTKHDF/{name} does not fit {frames} frames of {particles} particles")
    for name in ("Points", "PointData/velocity"):
        found = own_object(group, name)
        if not isinstance(found, h5py.Dataset):
            problems.append(f"dataset /VTKHDF/{name} is missing")
        elif found.shape != (frames * particles, 3):
            expected_shape = (frames * particles, 3)
            problems.append(f"dataset /VTKHDF/{name} has shape {found.shape}, expected {expected_shape}")
        elif not found.is_virtual:
            problems.append(f"dataset /VTKHDF/{name} is a copy, not a view")
        else:
            require_own_view(found)
    return problems
