"""Files that are read: bytes lost or changed, and values, parts and lines that are missing, wrong or huge."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import struct
from pathlib import Path
from typing import Any

import h5py
import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given
from kills import as_bytes
from scipy.spatial.transform import Rotation, Slerp

from mpm_warp import Scene
from mpm_warp.mesh_files import read_mesh
from mpm_warp.solids import Solid, closed_mesh
from sgns.config import parse_yaml
from sgns.data.check import check_run
from sgns.data.dataset import Dataset
from sgns.data.run import Run
from sgns.model.checkpoint import load_surrogate
from sgns.reduction.basis import Basis
from sgns.reduction.published import published_dataset
from sgns.rollout import main as roll_out
from sgns.simulate.scene import read_path
from sgns_testing.commands import SMALL, composed
from sgns_testing.fuzzing import OUTCOMES, VALUES, YAML, bounded, cases, changed, damaged, refused_or_read
from sgns_testing.meshes import write_obj, write_stl, write_text_stl
from sgns_testing.published import record

# --- dataset.yaml -----------------------------------------------------------------------------------------


@pytest.fixture
def runs(tmp_path: Path) -> None:
    """Files that are looked for, not into."""
    (tmp_path / "runs").mkdir()
    for name in "abc":
        (tmp_path / "runs" / f"{name}.h5").touch()


def test_yaml_of_data(tmp_path, runs) -> None:
    @cases(100)
    @given(YAML, st.booleans())
    def check(text: str, alone: bool) -> None:
        with bounded(), contextlib.suppress(ValueError):
            parse_yaml(text)
        content = text if alone else f"split: {{train: [a], validation: [], test: []}}\n{text}"
        (tmp_path / "dataset.yaml").write_text(content, encoding="utf-8", errors="surrogatepass")
        refused_or_read(lambda: Dataset.open(tmp_path, {"gravity": 9.81} if alone else None))

    check()


def test_dataset_yaml(tmp_path, runs) -> None:
    content = {
        "name": "a",
        "split": {"train": ["a", "b"], "validation": [], "test": ["c"]},
        "scenes": {key: {"gravity": 1.0} for key in "abc"},
    }

    @cases(60)
    @given(changed(content), st.sampled_from([None, {"gravity": 1.0}, {"gravity": [1.0]}]))
    def check(tree: Any, where: Any) -> None:
        (tmp_path / "dataset.yaml").write_text(json.dumps(tree))
        refused_or_read(lambda: Dataset.open(tmp_path, where))

    check()


# --- runs and bases ---------------------------------------------------------------------------------------


def spoiled(path: Path) -> st.SearchStrategy[list[tuple[Any, ...]]]:
    """What is done to an HDF5 file."""
    names: list[str] = []
    with h5py.File(path) as file:
        file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
        attributes = list(file.attrs)
    kinds = ["more", "missing", "shape", "huge", "type", "values", "group", "link", "attribute", "text"]
    action = st.tuples(
        st.sampled_from(kinds),
        st.sampled_from(names),
        st.lists(st.sampled_from([0, 1, 2, 3, 4, 6, 7]), max_size=4).map(tuple),
        st.sampled_from(["<f4", "<f8", "<i8", "u1", "S5", ">f8", "<f2", "c16", "?"]),
        st.sampled_from([10**6, 10**9, 10**12, 10**15]),
        st.sampled_from(attributes),
        VALUES,
        YAML,
    )
    return st.lists(action, min_size=1, max_size=3)


def spoil(file: h5py.File, actions: list[tuple[Any, ...]]) -> None:
    """Do it."""
    for kind, name, shape, dtype, huge, attribute, value, text in actions:
        old = file.get(name)
        if kind in ("attribute", "text"):
            with contextlib.suppress(TypeError, ValueError, OverflowError, UnicodeEncodeError):
                other = np.zeros(shape, dtype) if value is None else value
                file.attrs[attribute] = np.bytes_(text.encode()) if kind == "text" else other
        elif kind == "more":  # something of somebody else's, which nobody reads
            group = file.require_group("more")
            group.create_dataset(f"{len(group)}", shape, dtype)
            group.attrs["note"] = huge
        elif isinstance(old, h5py.Dataset) and not (kind == "values" and old.size > 10**6):
            shown, tail = old.shape, old.shape[1:]
            values = old[...] if kind == "values" else np.zeros(0)
            del file[name]
            if kind in ("shape", "type"):
                file.create_dataset(name, shape if kind == "shape" else shown, dtype)
            elif kind == "huge":
                plain = dtype if dtype[0] == "<" else "<f8"
                file.create_dataset(name, (huge, *tail), plain, chunks=(1, *tail), maxshape=(None, *tail))
            elif kind == "values":
                if values.dtype in (np.float32, np.float64) and values.size:
                    values.flat[huge % values.size] = np.nan if huge % 2 else 1e30
                file[name] = values
            elif kind == "group":
                file.create_group(name)
            elif kind == "link":
                outside = h5py.ExternalLink("/etc/hostname", "/x")
                file[name] = outside if huge > 10**9 else h5py.SoftLink("/nowhere")


def read_run(path: Path) -> list[Any]:
    """Everything a command reads of a run; returns its arrays."""
    with Run(path) as run:
        run.scene, run.effects, run.extra, run.seed, run.frame_rate, run.wall_time_s, run.content_hash  # noqa: B018
        soil = [(run.positions(frame), run.velocities(frame)) for frame in range(min(run.frame_count, 10))]
        return [run.time, run.pose, run.force, run.torque, run.body_points, *soil]


@pytest.mark.parametrize(
    ("pattern", "read", "count"), [("run.h5", read_run, 30), ("data/reduced/*/basis.h5", Basis.load, 12)]
)
def test_hdf5_with_other_parts(good, tmp_path, pattern, read, count) -> None:
    whole, path = next(good.glob(pattern)), tmp_path / "a.h5"

    @cases(count)
    @given(spoiled(whole))
    def check(actions: list[tuple[Any, ...]]) -> None:
        path.write_bytes(whole.read_bytes())
        with h5py.File(path, "r+") as file:
            spoil(file, actions)
        if read is read_run:
            with bounded():
                assert all(isinstance(problem, str) for problem in check_run(path))
        refused_or_read(lambda: read(path))

    check()


def test_runs_cut_short_or_changed(good, tmp_path) -> None:
    path, known = tmp_path / "a.h5", as_bytes(read_run(good / "run.h5"))

    @cases(20)
    @given(damaged((good / "run.h5").read_bytes()))
    def check(content: bytes) -> None:
        path.write_bytes(content)
        with bounded():
            problems = check_run(path)
        refused_or_read(lambda: read_run(path))
        assert problems or as_bytes(read_run(path)) == known  # bytes that no number depends on

    check()


@pytest.mark.parametrize(
    ("pattern", "read", "count"),
    [("data/reduced/*/basis.h5", Basis.load, 10), ("out/best.ckpt", load_surrogate, 8)],
)
def test_bases_and_checkpoints_cut_short_or_changed(good, tmp_path, pattern, read, count) -> None:
    whole = next(good.glob(pattern))

    @cases(count)
    @given(damaged(whole.read_bytes()))
    def check(content: bytes) -> None:
        (tmp_path / whole.name).write_bytes(content)
        refused_or_read(lambda: read(tmp_path / whole.name))

    check()


# --- checkpoints ------------------------------------------------------------------------------------------


def test_checkpoints_with_other_cards_and_weights(good, tmp_path) -> None:
    whole, path = torch.load(good / "out" / "best.ckpt", weights_only=True), tmp_path / "a.ckpt"
    card, state = whole["hyper_parameters"], whole["state_dict"]
    cfg = composed(*SMALL, f"checkpoint={path}", f"output={tmp_path / 'rollout.h5'}", command="rollout")

    def rolled_out(state: Any, card: Any) -> None:
        torch.save({"state_dict": state, "hyper_parameters": card}, path)
        refused_or_read(lambda: roll_out(cfg))

    @cases(15)
    @given(changed(card))
    def other_card(changed_card: Any) -> None:
        rolled_out(state, changed_card)

    @cases(8)
    @given(
        st.sampled_from(sorted(state)),
        st.sampled_from(["missing", "huge", "shape", "type", "nan", "sparse", "none"]),
    )
    def other_state(name: str, kind: str) -> None:
        value = state[name]
        changes = {
            "huge": torch.zeros(1).expand(10**12),
            "shape": torch.zeros(*value.shape, 2),
            "type": torch.zeros(value.shape, dtype=torch.int8),
            "nan": torch.full_like(value, torch.nan),
            "sparse": torch.zeros(value.shape).to_sparse(),
            "none": None,
        }
        kept = {k: v for k, v in state.items() if k != name}
        rolled_out(kept if kind == "missing" else kept | {name: changes[kind]}, card)

    other_card()
    other_state()


# --- meshes -----------------------------------------------------------------------------------------------

WRITERS = {"binary.stl": write_stl, "text.stl": write_text_stl, "a.obj": write_obj}
FACES = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
LINES = ["v 1 2 3", "f 1 2 3", "f 1/2 2 9", "f 1e9", "f -1 -2 -3", "v a b c", f"f {10**30} 1 2"]


@st.composite
def tetrahedra(draw: Any, folder: Path) -> tuple[np.ndarray, str, bytes]:
    """Corners of a tetrahedron, shape (4, 3), the name of a file and its content."""
    number = st.floats(-1.0, 1.0, width=32)
    sides = np.array(draw(st.tuples(*[number] * 9))).reshape(3, 3) + 3.0 * np.eye(3)  # not in a plane
    origin = np.array(draw(st.tuples(*[number] * 3)))
    corners = np.concatenate([[origin], origin + sides]).astype(np.float32).astype(float)
    faces = np.array([np.roll(face, draw(st.integers(0, 2))) for face in draw(st.permutations(FACES))])
    if draw(st.booleans()):
        faces = faces[:, ::-1]  # all of them look inwards
    file = folder / draw(st.sampled_from(sorted(WRITERS)))
    WRITERS[file.name](file, corners, faces)
    return corners, file.name, file.read_bytes()


def read_closed(file: Path) -> Solid:
    """A mesh as a tool takes it."""
    vertices, triangles, _ = read_mesh(file)
    return closed_mesh(vertices, triangles, file.name)


def test_good_meshes_keep_their_volume(tmp_path) -> None:
    @cases(40)
    @given(tetrahedra(tmp_path))
    def check(made: tuple[np.ndarray, str, bytes]) -> None:
        corners, name, _ = made
        vertices, triangles, *_ = read_closed(tmp_path / name)
        a, b, c = (vertices[triangles[:, k]] for k in range(3))
        volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0
        true = abs(np.linalg.det(corners[1:] - corners[0])) / 6.0
        np.testing.assert_allclose(volume, true, rtol=1e-9)
        np.testing.assert_allclose(vertices.mean(axis=0), 0.0, atol=1e-9)
        there = (corners - corners.mean(axis=0)).round(6)
        assert sorted(map(tuple, vertices.round(6))) == sorted(map(tuple, there))
        OUTCOMES["accepted"] += 1

    check()


def test_meshes(tmp_path) -> None:
    words = st.lists(st.sampled_from(LINES), max_size=3).map(lambda lines: "\n" + "\n".join(lines))
    good = tetrahedra(tmp_path)

    @cases(60)
    @given(
        good.flatmap(lambda made: damaged(made[2]).map(lambda content: (made[1], content)))
        | st.tuples(good, words).map(lambda parts: (parts[0][1], parts[0][2] + parts[1].encode()))
        | words.map(lambda lines: ("a.obj", lines.encode()))
    )
    def check(file: tuple[str, bytes]) -> None:
        name, content = file
        (tmp_path / name).write_bytes(content)
        refused_or_read(lambda: read_closed(tmp_path / name))

    check()


# --- paths ------------------------------------------------------------------------------------------------

COLUMNS = ["t", "x", "y", "z", "qx", "qy", "qz", "qw"]
SCENE = {
    "kind": "body",
    "bed": {"size": [0.4, 0.2, 0.16], "spacing": 0.04},
    "duration": 0.2,
    "tool": {"shape": "box", "size": [0.05, 0.05, 0.05]},
}
DAMAGED_LINES = st.lists(
    st.sampled_from(["0", "1.5", "nan", "inf", "-1e400", "", "a", '"', "0x1", "1_0", "\0", "é"]), max_size=9
).map(",".join)


@st.composite
def paths(draw: Any) -> tuple[bytes, np.ndarray]:
    """A good path, shape (k, 8), and before it its file, written in one of the ways that programs have."""
    count = draw(st.integers(1, 6))
    steps = draw(st.lists(st.floats(1e-3, 0.2), min_size=count, max_size=count))
    rows = []
    for time in draw(st.floats(-0.1, 0.1)) + np.cumsum(steps):
        place = [draw(st.floats(*limits)) for limits in ((0.08, 0.32), (0.08, 0.12), (0.05, 0.15))]
        quaternion = np.array(draw(st.tuples(*[st.floats(-1.0, 1.0)] * 4)))
        length = np.linalg.norm(quaternion)
        rows.append([time, *place, *(quaternion / length if length > 0.1 else (0.0, 0.0, 0.0, 1.0))])
    number = draw(st.sampled_from([repr, "{:.17e}".format, "{:+.17g}".format, " {!r} ".format]))
    quoting = draw(st.sampled_from([csv.QUOTE_MINIMAL, csv.QUOTE_ALL]))
    text = io.StringIO()
    writer = csv.writer(text, quoting=quoting, lineterminator=draw(st.sampled_from(["\n", "\r\n"])))
    writer.writerow([draw(st.sampled_from([name, f" {name}", f"{name} "])) for name in COLUMNS])
    writer.writerows([[number(float(value)) for value in row] for row in rows])
    content = text.getvalue()
    return (content.rstrip() if draw(st.booleans()) else content).encode(), np.array(rows)


def poses_of(path: np.ndarray, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (T, 3) and rotation matrices (T, 3, 3) between the samples, worked out with scipy."""
    time = np.clip(time, path[0, 0], path[-1, 0])
    position = np.stack([np.interp(time, path[:, 0], path[:, axis]) for axis in (1, 2, 3)], axis=-1)
    rotation = Rotation.from_quat(path[:, 4:])
    if len(path) == 1:
        return position, np.repeat(rotation.as_matrix(), len(time), axis=0)
    return position, Slerp(path[:, 0], rotation)(time).as_matrix()


def test_what_a_good_path_says_is_what_the_body_does(tmp_path) -> None:
    file = tmp_path / "path.csv"

    @cases(100)
    @given(paths())
    def check(written: tuple[bytes, np.ndarray]) -> None:
        content, path = written
        file.write_bytes(content)
        rows = read_path(file)
        np.testing.assert_array_equal(rows, path)
        scene = Scene.from_dict(SCENE | {"path": rows})
        position, rotation = poses_of(path, scene.times())
        poses = scene.body_poses()
        np.testing.assert_allclose(poses[:, :3], position, rtol=0, atol=1e-12)
        np.testing.assert_allclose(Rotation.from_quat(poses[:, 3:]).as_matrix(), rotation, rtol=0, atol=1e-7)
        OUTCOMES["accepted"] += 1

    check()


def test_paths(tmp_path) -> None:
    """Good files with bytes changed, or with lines of anything after their own."""
    file = tmp_path / "path.csv"
    header = ",".join(COLUMNS).encode() + b"\n"
    good = paths().map(lambda written: written[0])
    extra = st.lists(DAMAGED_LINES, max_size=3).map(lambda lines: "\n".join(lines).encode())

    def moves(rows: list[list[float]]) -> None:
        poses = Scene.from_dict(SCENE | {"path": rows}).body_poses()
        position, _ = poses_of(np.array(rows), np.arange(len(poses)) / 60.0)
        np.testing.assert_allclose(poses[:, :3], position, rtol=0, atol=1e-12)

    @cases(150)
    @given(
        good.flatmap(damaged)
        | st.tuples(good, extra).map(lambda parts: parts[0].rstrip() + b"\n" + parts[1])
        | extra.map(lambda lines: header + lines)
    )
    def check(content: bytes) -> None:
        file.write_bytes(content)
        refused_or_read(lambda: moves(read_path(file)))

    check()
    assert OUTCOMES["accepted"] >= 0.2 * OUTCOMES.total()


# --- published files --------------------------------------------------------------------------------------


def test_published_files(tmp_path) -> None:
    first = [[0.82, 0.30, 0.50], [0.82, 0.4, 0.50], [0.82, 0.3, 0.6], [1.0, 2.0, 3.0]]
    one = record([first] * 4, [3, 3, 3, 6], [[9, 9, 9]] * 4)
    data, about = struct.pack("<Q", len(one)) + b"crc!" + one + b"crc!", {"dataset_split": {"valid": [186]}}

    @cases(80)
    @given(damaged(data) | st.just(data), changed(about) | st.just(about))
    def check(content: bytes, metadata: Any) -> None:
        (tmp_path / "valid.tfrecord").write_bytes(content)
        (tmp_path / "metadata.json").write_text(json.dumps(metadata))
        refused_or_read(lambda: published_dataset({"path": str(tmp_path)}, 1))

    check()
