"""How other programs see a run file: as a point cloud for ParaView and VTK, and with the names of xarray and netCDF.

Letters: T frames, n soil particles, M body points, k further bodies.
"""

from __future__ import annotations

from typing import Any

import h5py
import numpy as np

from sgns.data.run_file import recorded_in, series

# --- ParaView and VTK -----------------------------------------------------------------------------------
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


# --- xarray and netCDF ----------------------------------------------------------------------------------
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
