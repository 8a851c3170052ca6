"""What is written is what was given, in H5MD's layout, complete or not at all."""

from __future__ import annotations

import math
import os
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from mpm_warp import State
from sgns.config import UserError
from sgns.data.run import Run
from sgns_testing.runs import make_run, make_writer, random_frame

TEXT = st.text(st.characters(exclude_categories=["Cs"]))
NAMES = st.text("abc_é", min_size=1, max_size=6)
PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | TEXT,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(NAMES, inner, max_size=3),
    max_leaves=8,
)


def test_everything_appended_is_read_back(tmp_path):
    frames = [random_frame(i) for i in range(5)]
    effects = {"yielding": {"on": False, "reason": "asked for: no"}}
    given = {"seed": 7, "producer": "rollout", "effects": effects, "extra": {"note": [1, "é"]}}
    with make_writer(tmp_path / "a.h5", **given) as writer:
        for each in frames:
            writer.append(**each)
        assert writer.frame_count == 5
        writer.finish(2.5)
    with Run(tmp_path / "a.h5") as run:
        assert (run.frame_count, run.particle_count, run.body_point_count) == (5, 4, 2)
        assert (run.seed, run.producer, run.wall_time_s, run.frame_rate) == (7, "rollout", 2.5, 60.0)
        assert run.arrangement_hash == "abc" and run.package_version
        assert run.effects == effects and run.extra == {"note": [1, "é"]} and run.scene == {}
        for name, key in [("time", "time"), ("pose", "body_pose"), ("force", "force"), ("torque", "torque")]:
            read = getattr(run, name)
            assert read.dtype == np.float64
            np.testing.assert_array_equal(read, [each[key] for each in frames])
        np.testing.assert_array_equal(run.body_points, [each["body_points"] for each in frames])
        for read, key in [(run.positions(), "position"), (run.velocities(), "velocity")]:
            np.testing.assert_array_equal(read, np.array([each[key] for each in frames], np.float32))


def test_a_large_array_of_a_state_is_in_several_chunks(tmp_path, monkeypatch):
    monkeypatch.setattr("sgns.data.writer._MOST_IN_CHUNK", 100)  # HDF5 takes no chunk of 4 GB
    arrays = {"position": np.arange(90.0).reshape(30, 3), "log_volume": np.arange(5.0), "bond": np.zeros(0)}
    with make_writer(tmp_path / "a.h5") as writer:
        writer.append(**random_frame(0))
        writer.finish(1.0, State(0, arrays))
    with Run(tmp_path / "a.h5") as run, h5py.File(tmp_path / "a.h5") as file:
        assert [file["state"][name].chunks for name in arrays] == [(4, 3), (5,), None]
        for name, array in run.state.arrays.items():
            np.testing.assert_array_equal(array, arrays[name])


def written(path, m=2, **settings):
    """A run of one frame, read back."""
    with make_writer(path, m=m, **settings) as writer:
        writer.append(**random_frame(0, m=m))
        writer.finish(0.0)
    return Run(path)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(scene=st.dictionaries(NAMES, PLAIN, max_size=4))
@example(scene={"path": [[0.1 * i, *range(7)] for i in range(5000)]})  # longer than an HDF5 header
def test_any_plain_scene_survives(tmp_path, scene):
    with written(tmp_path / "a.h5", scene=scene) as run:
        assert run.scene == scene


def test_numpy_tuples_and_paths_in_a_scene_become_plain_and_other_things_are_refused(tmp_path):
    scene = {"a": np.float32(0.5), "b": np.arange(3), "c": (1, (2.0,)), "d": Path("x/y"), "e": math.inf}
    with written(tmp_path / "a.h5", scene=scene) as run:
        expected = {"a": 0.5, "b": [0, 1, 2], "c": [1, [2.0]], "d": os.path.join("x", "y"), "e": math.inf}
        assert run.scene == expected
    with pytest.raises(TypeError, match="object cannot be stored"):
        make_writer(tmp_path / "b.h5", scene={"a": object()})
    assert [p.name for p in tmp_path.iterdir()] == ["a.h5"]


def test_content_hash_follows_the_data_and_nothing_else(tmp_path):
    def content(name, **kw):
        with Run(make_run(tmp_path / name, scene={"depth": 0.05, "speed": 0.1, "rake": 5.0}, **kw)) as run:
            return run.content_hash

    assert content("a.h5") == content("b.h5", wall_time_s=9.0, extra={"host": "x"})
    assert content("a.h5") != content("c.h5", frames=13)
    assert len(content("a.h5")) == 32


def test_h5py_alone_reads_an_h5md_file(tmp_path):
    path = make_run(tmp_path / "a.h5", frames=6, n=20, m=9, extra={"author": "Ada Løvelace"})
    with h5py.File(path) as file:
        assert list(file["h5md"].attrs["version"]) == [1, 1]
        assert file["h5md/author"].attrs["name"].decode() == "Ada Løvelace"
        assert file["h5md/creator"].attrs["name"] == b"sgns" and file["h5md/creator"].attrs["version"]
        shapes = {
            "particles/soil/position": (20, 3),
            "particles/soil/velocity": (20, 3),
            "particles/body/position": (9, 3),
            "observables/body/force": (3,),
            "observables/body/torque": (3,),
            "observables/body/pose": (7,),
        }
        clock = file["particles/soil/position/time"]
        for name, shape in shapes.items():
            value = file[name]["value"]
            assert value.shape == (6, *shape)
            assert "unit" not in value.attrs and value.attrs["si_unit"] and value.attrs["description"]
            assert file[name]["time"] == clock  # a hard link: the same object
            assert file[name]["step"][...].tolist() == list(range(6))
        for name in ("position", "velocity"):
            value = file["particles/soil"][name]["value"]
            assert value.dtype == np.float32 and value.chunks == (1, 20, 3)
        for group in ("soil", "body"):
            box = file["particles"][group]["box"].attrs
            assert box["dimension"] == 3 and list(box["boundary"]) == [b"none"] * 3
        assert file.attrs["format"] == b"sgns-run" and file.attrs["format_version"] == 1
        assert yaml.safe_load(file.attrs["scene"])["kind"] == "excavation"
        assert yaml.safe_load(file.attrs["effects"])["yielding"]["on"] is True


def test_mdanalysis_reads_the_soil(tmp_path):
    mda = pytest.importorskip("MDAnalysis")
    path = make_run(tmp_path / "a.h5", frames=5, n=20)
    with Run(path) as run:
        universe = mda.Universe.empty(20, trajectory=False)
        universe.load_new(str(path), format="H5MD", convert_units=False)
        assert universe.trajectory.n_frames == 5
        for step in universe.trajectory:
            np.testing.assert_array_equal(step.positions, run.positions(step.frame)[0])
            np.testing.assert_array_equal(step.velocities, run.velocities(step.frame)[0])
            np.testing.assert_array_equal(step.data["body/force"], run.force[step.frame])
            assert step.time == pytest.approx(run.time[step.frame])
        universe.trajectory.close()


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


def test_leaving_without_finish_keeps_nothing_and_says_so(tmp_path, caplog):
    with make_writer(tmp_path / "a.h5") as writer:
        writer.append(**random_frame(0))
    assert list(tmp_path.iterdir()) == [] and "without finish" in caplog.text
    for late in (lambda: writer.append(**random_frame(1)), lambda: writer.finish(0.0)):
        with pytest.raises(ValueError, match="already finished or discarded"):
            late()


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"position": np.full((4, 3), np.nan)}, UserError, "frame 1 .* position of particle 0 is not finite"),
        ({"force": [0.0, math.inf, 0.0]}, UserError, "force is not finite"),
        ({"position": np.zeros((5, 3))}, ValueError, r"position has shape \(5, 3\), expected \(4, 3\)"),
        ({"time": 0.0}, ValueError, "not after"),
        ({"time": [0.1]}, ValueError, "one number"),
    ],
)
def test_a_bad_frame_stops_the_run_and_keeps_nothing(tmp_path, change, error, words):
    with pytest.raises(error, match=words) as caught, make_writer(tmp_path / "a.h5") as writer:
        writer.append(**random_frame(0))
        writer.append(**{**random_frame(1), **change})
    assert "\n" not in str(caught.value) and list(tmp_path.iterdir()) == []


def test_a_frame_may_be_reused_by_its_maker(tmp_path):
    again = random_frame(0)
    with make_writer(tmp_path / "a.h5") as writer:
        for i in range(3):
            again["time"], again["force"][0] = i / 60, i
            writer.append(**again)
        writer.finish(0.0)
    with Run(tmp_path / "a.h5") as run:
        assert run.force[:, 0].tolist() == [0.0, 1.0, 2.0]


def test_a_run_without_frames_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no frame"), make_writer(tmp_path / "a.h5") as writer:
        writer.finish(0.0)
    assert list(tmp_path.iterdir()) == []
