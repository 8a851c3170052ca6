"""ParaView's library sees the soil of a run, without a copy of it."""

from __future__ import annotations

import numpy as np
import pytest

from sgns.data.run import Run
from sgns_testing.runs import make_run


def test_vtk_reads_the_soil_in_any_order(tmp_path):
    pytest.importorskip("vtk")
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline
    from vtkmodules.vtkIOHDF import vtkHDFReader

    path = make_run(tmp_path / "a.h5", frames=5, n=20)
    (tmp_path / "elsewhere").mkdir()
    path = path.rename(tmp_path / "elsewhere" / "b.h5")  # the view does not know its file by name
    reader = vtkHDFReader()
    assert reader.CanReadFile(str(path))
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    times = reader.GetOutputInformation(0).Get(vtkStreamingDemandDrivenPipeline.TIME_STEPS())
    with Run(path) as run:
        np.testing.assert_allclose(times, run.time)
        for i in (3, 0, 4):
            reader.UpdateTimeStep(times[i])
            cloud = reader.GetOutputDataObject(0)
            assert cloud.GetNumberOfPoints() == cloud.GetNumberOfVerts() == cloud.GetNumberOfCells() == 20
            np.testing.assert_array_equal(vtk_to_numpy(cloud.GetPoints().GetData()), run.positions(i)[0])
            velocity = vtk_to_numpy(cloud.GetPointData().GetArray("velocity"))
            np.testing.assert_array_equal(velocity, run.velocities(i)[0])


def test_the_view_for_vtk_costs_no_copy(tmp_path):
    path = make_run(tmp_path / "a.h5", frames=100, n=500, m=3)
    assert path.stat().st_size < 1.1 * 100 * 500 * 2 * 3 * 4
