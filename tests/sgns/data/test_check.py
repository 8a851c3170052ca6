"""`check_run` finds every planted fault, and nothing in a good file."""

from __future__ import annotations

import logging
import re
import shutil

import h5py
import numpy as np
import pytest
from omegaconf import OmegaConf

from sgns.config import UserError
from sgns.data.check import check_run, main, run_files
from sgns.data.run import Run
from sgns_testing.runs import make_run, make_writer, random_frame


@pytest.fixture
def problems_after(tmp_path, good):
    """The problems of a good run after `change(file)`."""

    def problems_after(change):
        path = shutil.copy(good, tmp_path)
        with h5py.File(path, "r+") as file:
            change(file)
        return check_run(path)

    return problems_after


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("good") / "a.h5")


def put(name, where, value):
    def change(file):
        file[name][where] = value

    return change


def replace(name, value):
    def change(file):
        del file[name]
        file[name] = value

    return change


def attribute(name, value):
    def change(file):
        file.attrs[name] = value

    return change


GOOD = [{}, {"frames": 1}, {"n": 1, "m": 0}, {"producer": "rollout", "seed": 5}]


@pytest.mark.parametrize("kw", GOOD, ids=str)
def test_a_good_run_has_no_problems(tmp_path, kw):
    assert check_run(make_run(tmp_path / "a.h5", **kw)) == []


FAULTS = [
    # values that Run would read without complaint
    (put("particles/soil/position/value", (3, 7, 1), np.nan), "position of particle 7 is not finite"),
    (put("particles/soil/position/value", (3, 7, 1), 0.1), "changed or damaged"),
    (put("observables/body/torque/value", 4, np.nan), "torque is not finite at frame 4"),
    (put("observables/body/pose/value", (2, 6), 0.5), "quaternion of frame 2"),
    (put("observables/body/pose/value", (5, 0), 0.3), "of frame 5 is .* from where the pose puts it"),
    (put("particles/body/position/value", (1, 4, 2), 9.0), "body point 4 of frame 1"),
    (put("particles/soil/position/time", 5, 0.01), "time does not increase at frame 5"),
    (put("particles/soil/position/time", 5, np.nan), "time is not finite at frame 5"),
    (put("particles/soil/position/time", -1, 0.19), "not by 1 / frame_rate"),
    (put("particles/soil/position/step", 5, 0), "step does not increase at frame 5"),
    (replace("observables/body/force/time", np.arange(12) / 30), "force/time differs"),
    # structure
    (replace("observables/body/pose/value", np.zeros((12, 6))), r"shape \(12, 6\), expected \(12, 7\)"),
    (replace("particles/soil/position/step", np.zeros(12)), "step has the wrong type"),
    (lambda file: file.pop("h5md"), "/h5md is missing"),
    (lambda file: file.pop("h5md/author"), "name of /h5md/author"),
    (lambda file: file.pop("particles/body/box"), "/particles/body/box"),
    # provenance
    (attribute("scene", "a: [1"), "'scene' is not YAML"),
    (attribute("scene", "just text"), "'scene' is not a group of keys"),
    (attribute("effects", "yielding: true"), "effect 'yielding'"),
    (attribute("producer", "me"), "producer is 'me'"),
    (attribute("frame_rate", 0.0), "frame_rate is 0.0; it must be above 0 Hz"),
    (attribute("wall_time_s", np.nan), "wall_time_s is nan; it must be 0 s or more"),
    (attribute("scene", "blade: {width: [1], length: 1, thickness: 1}"), r"scene.blade.width is \[1\]"),
    (attribute("scene", "blade: plate"), "scene.blade is 'plate', not a group of keys"),
    (attribute("scene", "bed: text"), "scene.bed.size is None, not three lengths"),
    (attribute("scene", "bed: {size: [1, 2]}"), r"scene.bed.size is \[1, 2\], not three lengths"),
    (attribute("scene", "bed: {size: [1, 2, x]}"), r"scene.bed.size\[2\] is 'x', not a finite number"),
    (attribute("frame_rate", "fast"), "'frame_rate' has the wrong type"),
    # the view
    (lambda file: file.pop("VTKHDF"), "/VTKHDF is missing"),
    (lambda file: file.pop("VTKHDF/Points"), "/VTKHDF/Points is missing"),
    (put("VTKHDF/NumberOfPoints", 0, 3), "NumberOfPoints does not fit"),
    (lambda file: file["VTKHDF"].attrs.__delitem__("Version"), r"Version of /VTKHDF is not \(2, 0\)"),
    (lambda file: file["VTKHDF"].attrs.create("Type", "Image"), "Type of /VTKHDF is not PolyData"),
    (put("VTKHDF/Lines/Offsets", 0, 3), "Lines/Offsets does not fit"),
    (replace("VTKHDF/Points", np.zeros((600, 3), "f4")), "is a copy"),
    (replace("VTKHDF/Points", np.zeros((600, 3), "f4")), "shows another position at frame 0"),
    (replace("VTKHDF/PointData/velocity", np.zeros((5, 3), "f4")), "velocity has shape"),
    (replace("force", np.zeros((12, 3))), "dataset /force is another one than /observables/body/force/value"),
]


@pytest.mark.parametrize(("change", "words"), FAULTS, ids=[words for _, words in FAULTS])
def test_a_planted_fault_is_found(problems_after, change, words):
    problems = problems_after(change)
    assert any(re.search(words, problem) for problem in problems), problems
    assert all("\n" not in problem for problem in problems)


def test_earlier_files_without_names_at_the_root_are_good(problems_after):
    assert (
        problems_after(lambda file: [file.pop(name) for name in ("time", "axis", "force", "particle")]) == []
    )


def missing_parts(file):
    del file["h5md"], file["observables/body/force"], file["VTKHDF"], file.attrs["seed"]
    file.attrs["producer"] = "me"


def bad_values(file):
    file["particles/soil/position/value"][3, 7] = np.nan
    file["observables/body/pose/value"][2] = 1.0
    file["particles/soil/position/time"][5] = 9.0


@pytest.mark.parametrize(
    ("change", "listed"),
    [
        (missing_parts, ("h5md", "force/value", "force/step", "force/time", "seed", "producer")),
        (bad_values, ("particle 7", "quaternion", "time", "content_hash")),
    ],
)
def test_all_problems_are_listed(problems_after, change, listed):
    text = "\n".join(problems_after(change))
    assert [words for words in listed if words not in text] == []


CORNERS = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.1, 0.1)])
FACES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
BOX = CORNERS, np.array([[f[0], f[k], f[k + 1]] for f in FACES for k in (1, 2)])
TOOL = {"tool": {"shape": "mesh", "file": "/etc/passwd", "digest": "0123"}}


def test_a_load_is_a_number_or_rows_of_numbers(tmp_path):
    for load, wrong in ((5.0, 0), ([[0.0, 5.0], [1.0, 6.0]], 0), ("much", 1)):
        found = check_run(make_run(tmp_path / "a.h5", scene={"load": load}))
        assert sum("scene.load" in words for words in found) == wrong
    found = check_run(make_run(tmp_path / "a.h5", scene={"load": [[0.0, float("nan")]]}))
    assert any("scene.load is nan, not a finite number" in words for words in found)


def mesh_run(path, mesh=BOX, scene=TOOL):
    """A run of two frames whose tool is a box."""
    with make_writer(path, n=3, m=2, scene=scene, meshes=(mesh,)) as writer:
        for i in range(2):
            frame = random_frame(i, n=3, m=2)
            writer.append(**frame | {"body_points": frame["body_pose"][:3] + CORNERS[[0, 5]]})
        writer.finish(1.0)
    return path


def test_a_run_holds_the_mesh_of_its_tool(tmp_path):
    path = mesh_run(tmp_path / "a.h5")
    assert check_run(path) == []
    with Run(path) as run, h5py.File(path) as file:
        for found, kept in zip(run.mesh, BOX, strict=True):
            np.testing.assert_array_equal(found, kept)
        assert file["parameters/tool/vertices"].dtype == "<f8"
        assert file["parameters/tool/triangles"].dtype == "<i4"
    with Run(make_run(tmp_path / "b.h5")) as run:
        assert run.mesh is None


VERTICES, TRIANGLES = "parameters/tool/vertices", "parameters/tool/triangles"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (put(VERTICES, (0, 0), np.nan), "not finite"),
        (put(VERTICES, (0, 0), 0.2), "centre of mass"),
        (put(VERTICES, ..., 1.01 * CORNERS), "the mesh is of another tool"),
        (put(TRIANGLES, (0, 0), 8), "vertex that is not there"),
        (put(TRIANGLES, (0, 0), -1), "vertex that is not there"),
        (put(TRIANGLES, ..., BOX[1][:, ::-1]), "faces inwards"),
        (replace(TRIANGLES, BOX[1].astype("f8")), "wrong type float64"),
        (replace(VERTICES, CORNERS.ravel()), "has shape (24,)"),
        (replace(TRIANGLES, h5py.SoftLink("/particles")), "is a link to elsewhere"),
        (replace(VERTICES, h5py.ExternalLink("other.h5", "/x")), "is a link to elsewhere"),
        (lambda file: file.__delitem__(VERTICES), f"dataset /{VERTICES} is missing"),
        (lambda file: file.__delitem__(TRIANGLES), f"dataset /{TRIANGLES} is missing"),
        (attribute("scene", "tool: {shape: mesh, file: /etc/passwd}"), "without the digest"),
    ],
)
def test_damage_to_a_mesh_is_found(tmp_path, change, words):
    path = mesh_run(tmp_path / "a.h5")
    with h5py.File(path, "r+") as file:
        change(file)
    (problem,) = check_run(path)
    assert words in problem and "\n" not in problem
    if "another tool" not in words:
        with pytest.raises(UserError, match=re.escape(words)), Run(path) as run:
            _ = run.scene, run.mesh


# --- Which files `sgns check` reads, and what it says of them -------------------------------------------


def test_a_dataset_stands_for_its_runs_in_order(tmp_path):
    (tmp_path / "runs").mkdir()
    for name in ("b.h5", "a.h5", ".a.h5.123", ".half.h5", "notes.txt"):
        (tmp_path / "runs" / name).touch()
    (tmp_path / "basis.h5").touch()
    expected = [tmp_path / "runs/a.h5", tmp_path / "runs/b.h5"]
    assert run_files([tmp_path]) == run_files([tmp_path / "runs"]) == expected
    assert run_files([expected[1], expected[0]]) == expected[::-1]


@pytest.mark.parametrize(
    ("names", "words"),
    [([""], "holds no run file"), (["nope.h5"], "no such file"), ([], "nothing to check")],
)
def test_what_cannot_be_checked_is_said(tmp_path, names, words):
    with pytest.raises(UserError, match=words):
        run_files([tmp_path / name for name in names])


def test_every_file_is_read_before_a_bad_one_is_reported(tmp_path, caplog):
    good, bad = make_run(tmp_path / "good.h5"), tmp_path / "bad.h5"
    bad.write_bytes(b"not HDF5")
    with caplog.at_level(logging.INFO):
        assert main(OmegaConf.create({"files": str(good)})) == 0
        with pytest.raises(UserError, match="1 of 2 files checked is not good"):
            main(OmegaConf.create({"files": [str(bad), str(good)]}))
    first, problem, last = caplog.messages
    assert first == last == f"{good}: good"
    assert problem.startswith(str(bad)) and problem.count("bad.h5") == 1


def test_files_that_are_missing_are_listed_with_the_problems_of_the_others(tmp_path, caplog):
    good = make_run(tmp_path / "good.h5")
    with caplog.at_level(logging.INFO), pytest.raises(UserError, match="2 of 3 files checked are not good"):
        main(OmegaConf.create({"files": [str(tmp_path / "a.h5"), str(good), str(tmp_path / "b.h5")]}))
    assert [line.partition(": ")[2][:12] for line in caplog.messages] == [
        "no such file",
        "no such file",
        "good",
    ]
