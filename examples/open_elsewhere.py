"""A run in other programs: xarray, a table of forces, VTK (pip install xarray h5netcdf pandas; vtk for the last).

python examples/bucket_on_a_path.py     # makes the run
python examples/open_elsewhere.py
"""

import importlib.util
import subprocess
import sys

import numpy as np
import pandas as pd
import xarray as xr

from sgns import Run

file = "outputs/examples/bucket.h5"

# The run file as it is, with named dimensions. Nothing is read before it is asked for.
with xr.open_dataset(file) as data:
    print(data.sizes)
    top = data.position.sel(axis="z").max("particle")  # of the highest grain [m], by time
    work = -float((data.force.isel(time=slice(1, None)) * data.pose[:, :3].diff("time").values).sum())
print(f"highest grain {float(top.max()):.3f} m; work on the soil {work:.0f} J")

# As files of their own.
for output in ("bucket.csv", "bucket.vtkhdf"):
    command = ["convert", file, f"outputs/examples/{output}", "overwrite=true"]
    subprocess.run([sys.executable, "-m", "sgns", *command], check=True)
forces = pd.read_csv("outputs/examples/bucket.csv", index_col="time")
with Run(file) as run:
    assert (
        np.allclose(forces[["Fx", "Fy", "Fz"]], run.force)
        and float(top.max()) >= run.positions(0)[0, :, 2].max()
    )
    last, points, times = run.positions(-1)[0], run.mesh[0], run.time

# Soil and bucket, as ParaView shows them.
if importlib.util.find_spec("vtkmodules"):
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOHDF import vtkHDFReader

    reader = vtkHDFReader()
    reader.SetFileName("outputs/examples/bucket.vtkhdf")
    reader.UpdateInformation()
    reader.SetStep(reader.GetNumberOfSteps() - 1)
    reader.Update()
    soil, bucket = (reader.GetOutputDataObject(0).GetBlock(number) for number in range(2))
    print(
        f"{reader.GetNumberOfSteps()} steps, {soil.GetNumberOfPoints()} grains, {bucket.GetNumberOfPolys()} triangles"
    )
    assert reader.GetNumberOfSteps() == len(times) and bucket.GetNumberOfPoints() == len(points)
    assert np.array_equal(vtk_to_numpy(soil.GetPoints().GetData()), last)
