"""Reading runs: as numpy would, and every bad file is named in one line."""

from __future__ import annotations

import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from mpm_warp.motions import Passes
from sgns.config import UserError
from sgns.data.check import check_run
from sgns.data.run import Run
from sgns.data.surface import soil_surface
from sgns_testing.runs import make_run


@pytest.mark.parametrize(
    "frames",
    [
        *(
            slice(*limits)
            for limits in [(None,), (3, 8), (-3, None), (None, None, 4), (None, None, -1), (5, 2)]
        ),
        *(3, -1, [4, 0, 0, 11], np.array([2, 1]), np.arange(12) % 3 == 0, []),
    ],
    ids=str,
)
def test_frames_are_chosen_as_numpy_does(tmp_path, frames):
    with Run(make_run(tmp_path / "a.h5")) as run:
        index = np.arange(12)[np.array(frames, dtype=int) if isinstance(frames, list) else frames]
        expected = run.positions()[np.atleast_1d(index)]
        np.testing.assert_array_equal(run.positions(frames), expected)
        assert run.velocities(frames).shape == expected.shape
        assert run.positions(frames).dtype == np.float32


def test_what_is_given_out_may_be_changed(tmp_path):
    with Run(make_run(tmp_path / "a.h5")) as run:
        run.force[...] = 0.0
        run.scene["depth"] = -1
        assert run.force.any() and run.scene["depth"] > 0


def test_a_closed_run_keeps_what_was_read(tmp_path):
    with Run(make_run(tmp_path / "a.h5")) as run:
        force = run.force
    np.testing.assert_array_equal(run.force, force)
    assert run.scene and run.producer == "mpm"
    with pytest.raises(UserError, match="is closed; read it inside"):
        run.positions()


def test_a_run_that_is_open_elsewhere_is_not_called_damaged(tmp_path):
    fcntl = pytest.importorskip("fcntl")
    path = make_run(tmp_path / "a.h5")
    with path.open("r+b") as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # as HDF5 does for who writes
        with pytest.raises(
            UserError, match=r"a\.h5 is open for writing in another program; wait until"
        ) as caught:
            Run(path)
        assert "damaged" not in str(caught.value)
        assert check_run(path) == [str(caught.value)]
    assert check_run(path) == []


def test_opening_reads_no_soil(tmp_path):
    path = make_run(tmp_path / "a.h5", frames=3, n=20)
    with h5py.File(path) as file:
        chunk = file["particles/soil/position/value"].id.get_chunk_info(1)
    with path.open("r+b") as file:  # spoil a frame: whoever does not read it cannot notice
        file.seek(chunk.byte_offset)
        file.write(b"\xff" * chunk.size)
    with Run(path) as run:
        assert np.isfinite(run.force).all() and run.frame_count == 3
        assert not np.isfinite(run.positions(1)).any()


def test_a_table_of_forces_has_named_columns(tmp_path):
    with Run(make_run(tmp_path / "a.h5")) as run:
        table = run.forces()
        assert list(table.columns) == "Fx Fy Fz Tx Ty Tz x y z qx qy qz qw".split()
        assert table.index.name == "time" and (table.index == run.time).all()
        np.testing.assert_array_equal(table[["Fx", "Fy", "Fz"]], run.force)
        np.testing.assert_array_equal(table[["Tx", "Ty", "Tz"]], run.torque)
        np.testing.assert_array_equal(table.loc[:, "x":], run.pose)


def test_a_table_of_a_wheel_has_its_own_axes_too(tmp_path):
    """Turned by 30 degrees: forces and torque along its heading and along its axle."""
    with Run(make_run(tmp_path / "a.h5", scene={"kind": "wheel", "slip_angle": 30.0})) as run:
        table, force, torque = run.forces(), run.force, run.torque
    c, s = np.sqrt(0.75), 0.5
    np.testing.assert_allclose(table.pull, c * force[:, 0] + s * force[:, 1])
    np.testing.assert_allclose(table.lateral, c * force[:, 1] - s * force[:, 0])
    np.testing.assert_allclose(table.drive, c * torque[:, 1] - s * torque[:, 0])


def test_a_table_of_passes_says_which_one_cuts(tmp_path):
    scene = {"motion": "passes", "passes": {"number": 2, "length": 0.0}, "depth": 0.01, "speed": 1.0}
    with Run(make_run(tmp_path / "a.h5", scene=scene)) as run:
        expected = 1 + Passes(number=2, length=0.0).cutting(run.time, 0.01, 1.0)
        assert 1 in expected and run.forces()["pass"].tolist() == expected.tolist()


def test_xarray_knows_dimensions_by_name(tmp_path):
    with Run(make_run(tmp_path / "a.h5")) as run:
        found = run.to_xarray([0, -1])
        assert found.sizes == {"time": 2, "particle": 50, "axis": 3, "component": 7, "point": 15}
        np.testing.assert_array_equal(found.position, run.positions([0, -1]))
        np.testing.assert_array_equal(found.velocity.sel(axis="x"), run.velocities([0, -1])[..., 0])
        assert float(found.force.sel(axis="z", time=run.time[-1])) == run.force[-1, 2]
        assert float(found.pose.sel(component="qw")[0]) == run.pose[0, 6]
        assert found.torque.units == "N m" and found.body_points.dims == ("time", "point", "axis")
        assert run.to_xarray().sizes["time"] == 12 and run.to_xarray(3).sizes["time"] == 1


@pytest.mark.parametrize(("name", "ask"), [("pandas", Run.forces), ("xarray", Run.to_xarray)])
def test_a_library_that_is_missing_is_named(tmp_path, monkeypatch, name, ask):
    monkeypatch.setitem(sys.modules, name, None)
    with Run(make_run(tmp_path / "a.h5")) as run, pytest.raises(UserError, match=f"pip install {name}"):
        ask(run)


def test_the_surface_of_a_frame(tmp_path):
    with Run(make_run(tmp_path / "a.h5", n=4000)) as run:
        x, y, z = run.surface(0)
        expected = soil_surface(run.positions(0)[0], run.scene)
        np.testing.assert_array_equal(z, expected.z)
        assert z.shape == (len(x), len(y)) and np.nanmax(z) < 0.02
        assert (np.nan_to_num(run.surface().z) == np.nan_to_num(run.surface(11).z)).all()
        with pytest.raises(UserError, match=r"round\(t \* run.frame_rate\)"):
            run.surface(0.05)


def refused(path: Path) -> str:
    with pytest.raises(UserError) as caught:
        Run(path)
    text = str(caught.value)
    assert str(path) in text and "\n" not in text
    return text


def test_what_is_no_run_file(tmp_path):
    assert "no such run file" in refused(tmp_path / "none.h5")
    assert "is a folder" in refused(tmp_path)
    for content in ("not a run", ""):
        (tmp_path / "text.h5").write_text(content)
        assert "not an HDF5 file" in refused(tmp_path / "text.h5")
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["particles/soil/position/value"] = np.zeros((2, 3, 3))
    assert "not a run of sgns" in refused(tmp_path / "foreign.h5")


@pytest.mark.parametrize("share", [0.01, 0.1, 0.5, 0.9, 0.999])
def test_truncated(tmp_path, share):
    path = make_run(tmp_path / "a.h5")
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    assert "cut short" in refused(path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda file: file.attrs.create("format_version", 99), ["upgrade"]),
        (lambda file: file.attrs.create("format_version", 1.5), ["no whole number as root attribute"]),
        *(
            (lambda file, name=name: file.pop(name), [f"/{name}", "sgns check"])
            for name in (
                "particles/soil/position/value",
                "particles/soil/velocity/time",
                "observables/body/pose",
                "particles",
            )
        ),
        *(
            (lambda file, name=name: file.attrs.pop(name), [name])
            for name in ("scene", "seed", "content_hash", "wall_time_s", "format_version")
        ),
    ],
)
def test_what_is_missing_or_newer_is_named(tmp_path, change, words):
    path = make_run(tmp_path / "a.h5")
    with h5py.File(path, "r+") as file:
        change(file)
    said = refused(path)
    assert all(word in said for word in words)


def test_frames_that_a_run_does_not_have(tmp_path):
    with Run(make_run(tmp_path / "a.h5", frames=5)) as run:
        for read in (run.positions, run.surface, run.velocities):
            with pytest.raises(UserError, match=r"frames is 500: .* has 5 frames, 0 to 4"):
                read(500)
        with pytest.raises(UserError, match=r"frames is \[0, -6\]: .* has 5 frames"):
            run.positions([0, -6])
