"""Paths of tools as CSV."""

from __future__ import annotations

import csv
import io
from typing import Any

import hypothesis.strategies as st
import numpy as np
from hypothesis import given
from scipy.spatial.transform import Rotation, Slerp

from mpm_warp import Scene
from sgns.simulate.scene import read_path
from sgns_testing.fuzzing import OUTCOMES, cases, damaged, refused_or_read

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
def paths(draw: Any) -> np.ndarray:
    """Rows t, x, y, z, qx, qy, qz, qw of a path that is good, shape (k, 8)."""
    count = draw(st.integers(1, 6))
    steps = draw(st.lists(st.floats(1e-3, 0.2), min_size=count, max_size=count))
    start = draw(st.floats(-0.1, 0.1))
    rows = []
    for time in start + np.cumsum(steps):
        place = [draw(st.floats(*limits)) for limits in ((0.08, 0.32), (0.08, 0.12), (0.05, 0.15))]
        quaternion = np.array(draw(st.tuples(*[st.floats(-1.0, 1.0)] * 4)))
        length = np.linalg.norm(quaternion)
        rows.append([time, *place, *(quaternion / length if length > 0.1 else (0.0, 0.0, 0.0, 1.0))])
    return np.array(rows)


@st.composite
def files(draw: Any) -> tuple[bytes, np.ndarray]:
    """A good path and its file, written in one of the ways that programs have."""
    path = draw(paths())
    number = draw(st.sampled_from([repr, "{:.17e}".format, "{:+.17g}".format, " {!r} ".format]))
    quoting = draw(st.sampled_from([csv.QUOTE_MINIMAL, csv.QUOTE_ALL]))
    text = io.StringIO()
    writer = csv.writer(text, quoting=quoting, lineterminator=draw(st.sampled_from(["\n", "\r\n"])))
    writer.writerow([draw(st.sampled_from([name, f" {name}", f"{name} "])) for name in COLUMNS])
    writer.writerows([[number(float(value)) for value in row] for row in path])
    content = text.getvalue()
    return (content.rstrip() if draw(st.booleans()) else content).encode(), path


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
    @given(files())
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
    good = files().map(lambda written: written[0])
    extra = st.lists(DAMAGED_LINES, max_size=3).map(lambda lines: "\n".join(lines).encode())

    @cases(150)
    @given(
        good.flatmap(damaged)
        | st.tuples(good, extra).map(lambda parts: parts[0].rstrip() + b"\n" + parts[1])
        | extra.map(lambda lines: header + lines)
    )
    def check(content: bytes) -> None:
        file.write_bytes(content)
        refused_or_read(lambda: moves(read_path(file)))

    def moves(rows: list[list[float]]) -> None:
        poses = Scene.from_dict(SCENE | {"path": rows}).body_poses()
        position, _ = poses_of(np.array(rows), np.arange(len(poses)) / 60.0)
        np.testing.assert_allclose(poses[:, :3], position, rtol=0, atol=1e-12)

    check()
    assert OUTCOMES["accepted"] >= 0.2 * OUTCOMES.total()
