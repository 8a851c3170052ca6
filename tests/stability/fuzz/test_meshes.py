"""Meshes of tools."""

from __future__ import annotations

import struct
from typing import Any

import hypothesis.strategies as st
import numpy as np
from hypothesis import given

from mpm_warp.bodies import closed_mesh, read_mesh
from sgns_testing.fuzzing import OUTCOMES, cases, damaged, refused_or_read

FACES = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
LINES = ["v 1 2 3", "f 1 2 3", "f 1/2 2 9", "f 1e9", "f -1 -2 -3", "v a b c", f"f {10**30} 1 2"]


def binary_stl(corners: np.ndarray, faces: list[tuple[int, ...]]) -> bytes:
    """Triangles as most programs write them."""
    head = b"x" * 80 + struct.pack("<I", len(faces))
    return head + b"".join(struct.pack("<12fH", 0, 0, 0, *corners[list(face)].flat, 0) for face in faces)


def text_stl(corners: np.ndarray, faces: list[tuple[int, ...]]) -> bytes:
    """The same as text."""
    lines = ["solid a"]
    for face in faces:
        lines += ["facet normal 0 0 0", "outer loop"]
        lines += ["vertex {!r} {!r} {!r}".format(*map(float, corners[k])) for k in face]
        lines += ["endloop", "endfacet"]
    return "\n".join([*lines, "endsolid a"]).encode()


def obj(corners: np.ndarray, faces: list[tuple[int, ...]]) -> bytes:
    """Numbered corners, with what else may stand in such files."""
    lines = ["# a tool", "o tool", *("v {!r} {!r} {!r}".format(*map(float, corner)) for corner in corners)]
    lines += ["vn 0 0 1", "s off", *("f " + " ".join(f"{k + 1}//1" for k in face) for face in faces)]
    return "\n".join(lines).encode()


KINDS = {"binary.stl": binary_stl, "text.stl": text_stl, "a.obj": obj}


@st.composite
def tetrahedra(draw: Any) -> tuple[np.ndarray, str, bytes]:
    """Corners of a tetrahedron, shape (4, 3), the name of a file and its content."""
    number = st.floats(-1.0, 1.0, width=32)
    sides = np.array(draw(st.tuples(*[number] * 9))).reshape(3, 3) + 3.0 * np.eye(
        3
    )  # so they do not lie in a plane
    origin = np.array(draw(st.tuples(*[number] * 3)))
    corners = np.concatenate([[origin], origin + sides]).astype(np.float32).astype(float)
    faces = [
        face[turn:] + face[:turn]
        for face in draw(st.permutations(FACES))
        for turn in [draw(st.integers(0, 2))]
    ]
    if draw(st.booleans()):
        faces = [face[::-1] for face in faces]  # all of them look inwards
    name = draw(st.sampled_from(sorted(KINDS)))
    return corners, name, KINDS[name](corners, faces)


def read_closed(file: Any) -> tuple[np.ndarray, np.ndarray, bool]:
    """A mesh as a tool takes it."""
    return closed_mesh(*read_mesh(file), file.name)


def test_good_meshes_keep_their_volume(tmp_path) -> None:
    @cases(40)
    @given(tetrahedra())
    def check(made: tuple[np.ndarray, str, bytes]) -> None:
        corners, name, content = made
        (tmp_path / name).write_bytes(content)
        vertices, triangles, _ = read_closed(tmp_path / name)
        a, b, c = (vertices[triangles[:, k]] for k in range(3))
        volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0
        true = abs(np.linalg.det(corners[1:] - corners[0])) / 6.0
        np.testing.assert_allclose(volume, true, rtol=1e-9)
        np.testing.assert_allclose(vertices.mean(axis=0), 0.0, atol=1e-9)
        assert sorted(map(tuple, vertices.round(6))) == sorted(
            map(tuple, (corners - corners.mean(axis=0)).round(6))
        )
        OUTCOMES["accepted"] += 1

    check()


def test_meshes(tmp_path) -> None:
    words = st.lists(st.sampled_from(LINES), max_size=3).map(lambda lines: "\n" + "\n".join(lines))
    good = tetrahedra()

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
