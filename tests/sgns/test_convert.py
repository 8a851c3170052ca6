"""`sgns convert`, and what other programs make of runs."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest

from mpm_warp import Bed, Effects, MeshBody, Other, Scene
from sgns.convert import surfaces
from sgns.data.run import Run
from sgns.simulate.run import simulate_scene
from sgns_testing.commands import refusal, sgns
from sgns_testing.meshes import BOX_FACES, box_corners, write_obj
from sgns_testing.runs import make_run


@pytest.fixture
def run_file(tmp_path: Path) -> Path:
    return make_run(tmp_path / "run.h5", frames=7, n=40)


def converted(folder: Path, name: str, *more: str) -> Path:
    done = sgns(folder, "convert", "run.h5", name, *more)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"{name}: ")
    return folder / name


def test_vtk_reads_soil_and_tool_as_blocks_in_time(run_file: Path, tmp_path: Path) -> None:
    pytest.importorskip("vtkmodules", reason="vtk is not installed")
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonDataModel import vtkCompositeDataSet
    from vtkmodules.vtkIOHDF import vtkHDFReader

    reader = vtkHDFReader()
    reader.SetFileName(str(converted(tmp_path, "run.vtkhdf", "every=2")))
    reader.UpdateInformation()
    assert reader.GetNumberOfSteps() == 4
    with Run(run_file) as run:
        ((poses, vertices, triangles),) = surfaces(run).values()
        assert (vertices.shape, triangles.shape) == ((8, 3), (12, 3))
        for step, frame in enumerate((0, 2, 4, 6)):
            reader.SetStep(step)
            reader.Update()
            found = reader.GetOutputDataObject(0)
            names = [found.GetMetaData(i).Get(vtkCompositeDataSet.NAME()) for i in range(2)]
            assert names == ["soil", "tool"]
            soil, tool = found.GetBlock(0), found.GetBlock(1)
            assert np.array_equal(vtk_to_numpy(soil.GetPoints().GetData()), run.positions(frame)[0])
            velocity = vtk_to_numpy(soil.GetPointData().GetArray("velocity"))
            assert np.array_equal(velocity, run.velocities(frame)[0])
            moved = vtk_to_numpy(tool.GetPoints().GetData()).mean(axis=0)
            assert moved == pytest.approx(poses[frame, :3], abs=1e-6) and tool.GetNumberOfPolys() == 12
            assert reader.GetTimeValue() == run.time[frame]


def test_pyvista_reads_it_by_its_name(run_file: Path, tmp_path: Path) -> None:
    pyvista = pytest.importorskip("pyvista", reason="pyvista is not installed")
    blocks = pyvista.read(converted(tmp_path, "run.vtkhdf"))
    assert blocks.keys() == ["soil", "tool"] and blocks["soil"].n_points == 40


def test_all_bodies_of_a_scene_have_a_surface(tmp_path: Path) -> None:
    file = write_obj(tmp_path / "box.obj", box_corners((0.1, 0.1, 0.08)), BOX_FACES)
    mesh = Other(tool=MeshBody(file=str(file)), position=(0.1, 0.1, 0.05), density=1000.0)
    bed = Bed(size=(0.4, 0.2, 0.16), spacing=0.04)
    simulate_scene(Scene(bed=bed, others=(mesh,), duration=1 / 60), tmp_path / "run.h5", effects=Effects())
    with h5py.File(converted(tmp_path, "run.vtkhdf")) as file:
        assert list(file["VTKHDF/Assembly"]) == ["soil", "other_0"]
        assert file["VTKHDF/other_0/Points"].shape == (2 * 8, 3)
    names = converted(tmp_path, "run.xyz").read_text().splitlines()
    assert len(names) == 2 * (int(names[0]) + 2)  # no own body, so no points of one


def test_xyz_holds_soil_and_body_points_with_velocities(run_file: Path, tmp_path: Path) -> None:
    lines = converted(tmp_path, "run.xyz", "every=3").read_text().splitlines()
    assert len(lines) == 3 * (2 + 40 + 15) and lines[0] == "55"
    with Run(run_file) as run:
        begin = 57  # of the second of them
        assert lines[begin + 1].startswith(
            'Properties=species:S:1:pos:R:3:velo:R:3 Time=0.05 pbc="F F F" force="'
        )
        kind, *numbers = lines[begin + 2].split()
        expected = np.hstack([run.positions(3)[0, 0], run.velocities(3)[0, 0]])
        assert kind == "soil" and np.array(numbers, float) == pytest.approx(expected, rel=1e-6)
        kind, *numbers = lines[begin + 2 + 40].split()
        assert kind == "tool" and np.array(numbers[:3], float) == pytest.approx(
            run.body_points[3, 0], rel=1e-6
        )


def test_csv_is_the_table_of_forces(run_file: Path, tmp_path: Path) -> None:
    table = np.genfromtxt(converted(tmp_path, "forces.csv"), delimiter=",", names=True)
    with Run(run_file) as run:
        assert list(table.dtype.names) == ["time", *run.forces().columns]
        assert table["Fx"] == pytest.approx(run.force[:, 0]) and table["qw"] == pytest.approx(run.pose[:, 6])


def test_npz_holds_the_arrays(run_file: Path, tmp_path: Path) -> None:
    with np.load(converted(tmp_path, "run.npz", "every=2")) as found, Run(run_file) as run:
        assert np.array_equal(found["position"], run.positions(slice(None, None, 2)))
        assert np.array_equal(found["torque"], run.torque[::2]) and found["time"][1] == run.time[2]
        assert json.loads(str(found["scene"])) == run.scene


def test_xarray_opens_a_run_with_names(run_file: Path) -> None:
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf", reason="h5netcdf is not installed")
    with xarray.open_dataset(run_file) as found, Run(run_file) as run:
        assert dict(found.sizes) == {"time": 7, "particle": 40, "axis": 3, "component": 7, "point": 15}
        height = found.position.sel(axis="z").isel(time=-1)
        assert np.array_equal(height, run.positions(-1)[0, :, 2])
        assert np.array_equal(found.pose.sel(component="qw"), run.pose[:, 6])
        assert np.array_equal(found.time, run.time) and found.force.attrs["si_unit"] == "N"


def test_the_names_are_links_that_take_no_room(run_file: Path) -> None:
    with h5py.File(run_file) as file:
        assert file["position"] == file["particles/soil/position/value"]
        assert file["particle"].id.get_storage_size() == 0


def test_wrong_names_are_refused(run_file: Path, tmp_path: Path) -> None:
    assert "must end in one of .vtkhdf, .xyz, .csv, .npz" in refusal(tmp_path, "convert", "run.h5", "run.foo")
    assert "give a run file and a name, as in sgns convert run.h5 run.vtkhdf" in refusal(tmp_path, "convert")
    assert "every is 0; allowed: 1 to" in refusal(tmp_path, "convert", "run.h5", "a.csv", "every=0")
    (tmp_path / "a.csv").write_text("mine")
    assert "is there already" in refusal(tmp_path, "convert", "run.h5", "a.csv")
