"""Mesh files as people have them: STL, OBJ, PLY and OFF are read here, GLB and 3MF by the library trimesh."""

from __future__ import annotations

import io
import json
import re
import struct
import zipfile
from collections.abc import Callable, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .settings import read_bytes
from .state import SceneError

MOST_TRIANGLES = 1_000_000
_MOST_OF_MESH = 1 << 28  # bytes: a text STL of so many triangles
_MOST_COMPONENTS = 24  # of a 3MF file: parts of parts multiply
_FEWER = (
    f"a tool has at most {MOST_TRIANGLES} triangles: decimate it, in a mesh editor or with trimesh's "
    "simplify_quadric_decimation; what is finer than scene.bed.spacing has no effect"
)
_STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("extra", "<u2")])
_UNITS = {
    "micron": 1e-6,
    "millimeter": 1e-3,
    "centimeter": 1e-2,
    "inch": 0.0254,
    "foot": 0.3048,
    "meter": 1.0,
}


class Polygons(NamedTuple):
    """What stands in a file."""

    points: np.ndarray  # (k, 3), in the file's unit
    corners: np.ndarray  # (c,) indices of points, face after face
    sizes: np.ndarray  # (f,) corners of each face
    unit: float | None = None  # [m], of a file that says it


def read_mesh(file: Path) -> tuple[np.ndarray, np.ndarray, float | None]:
    """Vertices (k, 3), in the file's unit, triangles (t, 3), and this unit [m] where the file says it.

    Corners at the same place become one vertex. A face that no fan of triangles fills is cut so that it is filled.

    Raises:
        SceneError: the file cannot be read, or is no such mesh.
    """
    suffix = file.suffix.lower()
    if suffix not in _READERS:
        raise SceneError(
            f"tool.file is {file}; allowed: {', '.join(f'*{s}' for s in _READERS)}; export it as STL"
        )
    try:
        found = _READERS[suffix](mesh_content(file))
        triangles = _triangles(found)
    except ImportError as error:
        raise SceneError(
            f"tool.file: {file} needs the library {error.name}: pip install 'sgns[meshes]'; or export it as STL"
        ) from None
    except OSError as error:
        raise SceneError(f"tool.file: cannot read {file}: {error.strerror}") from None
    except Exception as error:  # a damaged file leads anywhere
        words = error if isinstance(error, ValueError) else f"{type(error).__name__} {error}"
        raise SceneError(f"tool.file: {file} is not a good {suffix[1:].upper()} file: {words}") from None
    if len(triangles) == 0:
        raise SceneError(f"tool.file: {file} holds no triangles")
    vertices = found.points
    if not np.isfinite(vertices).all():
        raise SceneError(f"tool.file: {file} holds a coordinate that is not finite")
    vertices, place = np.unique(vertices, axis=0, return_inverse=True)
    return (*without_idle(vertices, place.reshape(-1)[triangles]), found.unit)


def without_idle(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A mesh without triangles that are lines and without vertices of no triangle."""
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]
    used, place = np.unique(triangles, return_inverse=True)
    return vertices[used], place.reshape(-1, 3)


def mesh_content(file: Path) -> bytes:
    """Content of a mesh file; errors as `read_bytes`."""
    try:
        return read_bytes(file, _MOST_OF_MESH)
    except ValueError as error:
        raise ValueError(f"{error}; {_FEWER}" if "larger" in str(error) else str(error)) from None


# --- Polygons → triangles -------------------------------------------------------------------------------


def _triangles(found: Polygons) -> np.ndarray:
    """Triangles (t, 3) that fill the faces, in their order."""
    points, corners, sizes = found.points, found.corners, found.sizes
    if corners.size and not (0 <= corners.min() and corners.max() < len(points)):
        raise ValueError("a face names a vertex that is not there")
    if np.maximum(sizes - 2, 0).sum() > MOST_TRIANGLES:
        raise ValueError(f"it has {np.maximum(sizes - 2, 0).sum()} triangles; {_FEWER}")
    starts = np.cumsum(sizes) - sizes
    parts, order = [np.zeros((0, 3), dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    for size in np.unique(sizes[sizes > 2]):
        faces = np.flatnonzero(sizes == size)
        polygons = corners[starts[faces][:, None] + np.arange(size)]  # (f, size)
        fans = np.stack(np.broadcast_arrays(polygons[:, :1], polygons[:, 1:-1], polygons[:, 2:]), axis=-1)
        if size > 3:
            for face in np.flatnonzero(~_filled(points[fans])):
                fans[face] = _cut(points[polygons[face]], polygons[face], int(faces[face]))
        parts.append(fans.reshape(-1, 3))
        order.append(np.repeat(faces, size - 2))
    return np.concatenate(parts)[np.argsort(np.concatenate(order), kind="stable")]


def _filled(corners: np.ndarray) -> np.ndarray:
    """Whether triangles (f, n, 3, 3) fill their faces without folds, the sum of their areas being the face's; (f,)."""
    areas = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    normal = areas.sum(axis=1)
    along = np.einsum("fni,fi->fn", areas, normal)
    return np.abs(along).sum(axis=1) <= (1.0 + 1e-6) * (normal**2).sum(axis=1)


def _cut(points: np.ndarray, corners: np.ndarray, face: int) -> np.ndarray:
    """Triangles (n - 2, 3) that fill a polygon which a fan does not fill."""
    import manifold3d

    spokes = points[1:] - points[0]
    normal = np.cross(spokes[:-1], spokes[1:]).sum(axis=0)
    length = np.linalg.norm(normal)
    if length > 0.0:
        u = np.cross(normal / length, np.eye(3)[np.argmin(np.abs(normal))])
        u /= np.linalg.norm(u)
        flat = np.stack([points @ u, points @ np.cross(normal / length, u)], axis=-1)
        found = manifold3d.triangulate([flat]).astype(np.int64)
        if len(found) == len(corners) - 2 and _filled(points[found][None])[0]:
            return corners[found]
    raise ValueError(
        f"face {face + 1} of {len(corners)} corners crosses itself or has no area; cut the faces into triangles when "
        "you export it"
    )


# --- Formats --------------------------------------------------------------------------------------------


def _lines(data: bytes) -> list[bytes]:
    """Of a text, whatever the encoding of names in it; without comments and white space around."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        data = data.decode("utf-16").encode()
    data = data.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    return [line.partition(b"#")[0].strip() for line in data.replace(b"\\\n", b" ").split(b"\n")]


def _numbers(rows: Sequence[Sequence[bytes]], what: str) -> np.ndarray:
    """(k, 3)."""
    if any(len(row) < 3 for row in rows):
        raise ValueError(f"{what} has less than three numbers")
    try:
        return np.array([row[:3] for row in rows], dtype=float).reshape(-1, 3)
    except ValueError:
        wrong = next(word for row in rows for word in row[:3] if not _is_number(word))
        raise ValueError(f"{what} holds {wrong[:40].decode('latin-1')!r}, which is no number") from None


def _is_number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _polygons(points: np.ndarray, faces: Sequence[Sequence[int]]) -> Polygons:
    sizes = np.fromiter(map(len, faces), dtype=np.int64, count=len(faces))
    corners = np.fromiter(chain.from_iterable(faces), dtype=np.int64, count=int(sizes.sum()))
    return Polygons(points, corners, sizes)


def _soup(corners: np.ndarray) -> Polygons:
    count = len(corners)
    return Polygons(corners, np.arange(count), np.full(count // 3, 3))


def _stl(data: bytes) -> Polygons:
    said = int.from_bytes(data[80:84], "little")
    there = max(0, len(data) - 84) // _STL_TRIANGLE.itemsize
    text = data.removeprefix(b"\xef\xbb\xbf").lstrip()[:5].lower() == b"solid" or data[:2] == b"\xff\xfe"
    # A text file may be told by its length only: binary ones may begin with "solid", too.
    if len(data) == 84 + said * _STL_TRIANGLE.itemsize or (not text and 0 < said <= there):
        if said > MOST_TRIANGLES:
            raise ValueError(f"it has {said} triangles; {_FEWER}")
        return _soup(np.frombuffer(data, _STL_TRIANGLE, said, 84)["corners"].reshape(-1, 3).astype(float))
    if not text:
        raise ValueError(
            f"it says that it has {said} triangles, but there are {there}; it may be cut short: export it again"
        )
    rows = [words[1:4] for line in _lines(data) if (words := line.split()) and words[0].lower() == b"vertex"]
    if len(rows) % 3 or b"endsolid" not in data[-1000:].lower().replace(b"\0", b""):
        raise ValueError("a triangle or the line endsolid is missing; it may be cut short: export it again")
    return _soup(_numbers(rows, "a vertex"))


def _obj(data: bytes) -> Polygons:
    rows: list[list[bytes]] = []
    faces: list[list[int]] = []
    for line in _lines(data):
        words = line.split()
        if words[:1] == [b"v"]:
            rows.append(words[1:4])
        elif words[:1] == [b"f"]:
            numbers = [int(word.partition(b"/")[0]) for word in words[1:]]
            # Indices count from 1, negative ones back from the last vertex so far.
            faces.append([n - 1 if n > 0 else len(rows) + n for n in numbers])
    return _polygons(_numbers(rows, "a vertex"), faces)


def _off(data: bytes) -> Polygons:
    rows = [line.split() for line in _lines(data) if line]
    if not rows or rows[0][0] not in (b"OFF", b"COFF", b"NOFF", b"CNOFF") or b"BINARY" in rows[0]:
        raise ValueError("it does not begin with OFF, or is a binary one; export it as STL")
    rows[0] = rows[0][1:]
    rows = rows if rows[0] else rows[1:]
    vertices, faces = (int(word) for word in rows[0][:2])
    if not (0 <= vertices and 0 <= faces and len(rows) > vertices + faces):
        raise ValueError("it has fewer lines than it says; it may be cut short: export it again")
    last = 1 + vertices + faces
    found = [[int(word) for word in row[1 : 1 + int(row[0])]] for row in rows[1 + vertices : last]]
    return _polygons(_numbers(rows[1 : 1 + vertices], "a vertex"), found)


_PLY_TYPES = {
    name: kind
    for names, kind in (
        ("char int8", "i1"),
        ("uchar uint8", "u1"),
        ("short int16", "i2"),
        ("ushort uint16", "u2"),
        ("int int32", "i4"),
        ("uint uint32", "u4"),
        ("float float32", "f4"),
        ("double float64", "f8"),
    )
    for name in names.split()
}


def _ply(data: bytes) -> Polygons:
    head, _, body = data.removeprefix(b"\xef\xbb\xbf").partition(b"end_header")
    body = body[2:] if body[:2] == b"\r\n" else body[1:]
    lines = [line.split() for line in head.decode("latin-1").splitlines() if line.strip()]
    if not lines or lines[0] != ["ply"]:
        raise ValueError("it does not begin with ply")
    form = ""
    elements: list[tuple[str, int, list[tuple[str, list[str]]]]] = []
    for words in lines[1:]:
        if words[0] == "format":
            form = words[1]
        elif words[0] == "element":
            elements.append((words[1], int(words[2]), []))
        elif words[0] == "property":
            kinds = [word for word in words[1:-1] if word != "list"]
            if odd := [word for word in kinds if word not in _PLY_TYPES]:
                raise ValueError(f"it has a property of the type {odd[0][:40]!r}, which PLY does not know")
            kinds = kinds if form == "ascii" else [_PLY_TYPES[word] for word in kinds]
            elements[-1][2].append((words[-1], kinds))
    if form == "ascii":
        source: Any = iter([line.split() for line in _lines(body) if line])
        read: Callable[..., Any] = _ply_text
    else:
        orders = {"binary_little_endian": "<", "binary_big_endian": ">"}
        if form not in orders:
            raise ValueError(f"its format is {form[:40]!r}; allowed: ascii, {', '.join(orders)}")
        order = orders[form]
        source, read = (io.BytesIO(body), order), _ply_binary
    found = {}
    for name, count, properties in elements:
        if not 0 <= count <= 4 * MOST_TRIANGLES:
            raise ValueError(f"it says that it has {count} times {name}; {_FEWER}")
        found[name] = read(source, count, properties)
    if not set("xyz") <= set(found.get("vertex", {})):
        raise ValueError("it has no element vertex with x, y and z")
    points = np.stack([np.asarray(found["vertex"][axis], dtype=float) for axis in "xyz"], axis=-1)
    faces = found.get("face", {})
    named = [faces[key] for key in ("vertex_indices", "vertex_index") if key in faces]
    if named and not all(np.ndim(face) == 1 for face in named[0]):
        raise ValueError("its faces are no lists of vertices")
    return _polygons(points, named[0] if named else [])


def _ply_text(rows: Any, count: int, properties: list[tuple[str, list[str]]]) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = {name: [] for name, _ in properties}
    for _ in range(count):
        row = next(rows, None)
        if row is None:
            raise ValueError("it has fewer lines than it says; it may be cut short: export it again")
        place = 0
        for name, kinds in properties:
            if len(kinds) == 1:
                found[name].append(float(row[place]))
                place += 1
            else:
                end = place + 1 + int(row[place])
                found[name].append([int(float(word)) for word in row[place + 1 : end]])
                place = end
        if place > len(row):
            raise ValueError("a line has fewer numbers than it says")
    return found


def _ply_binary(source: Any, count: int, properties: list[tuple[str, list[str]]]) -> dict[str, Any]:
    file, order = source
    if all(len(kinds) == 1 for _, kinds in properties):
        row = np.dtype([(name, order + kinds[0]) for name, kinds in properties])
        table = np.frombuffer(file.read(count * row.itemsize), row, count)
        return {name: table[name] for name, _ in properties}
    codes = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f", "f8": "d"}
    found: dict[str, list[Any]] = {name: [] for name, _ in properties}

    def take(number: int, kind: str) -> tuple[Any, ...]:
        return struct.unpack(f"{order}{number}{codes[kind]}", file.read(number * int(kind[1])))

    for _ in range(count):
        for name, kinds in properties:
            (first,) = take(1, kinds[0])
            found[name].append(first if len(kinds) == 1 else take(int(first), kinds[1]))
    return found


def _glb(data: bytes) -> Polygons:
    if len(data) < 20 or data[:4] != b"glTF":
        raise ValueError("it does not begin with glTF")
    head = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    counts = [accessor.get("count", 0) for accessor in head.get("accessors", [])]
    if sum(counts) > 12 * MOST_TRIANGLES:
        raise ValueError(f"it has {sum(counts)} numbers; {_FEWER}")
    x, y, z = (found := _by_library(data, "glb")).points.T
    return found._replace(points=np.stack([x, -z, y], axis=-1), unit=1.0)  # its y is upwards, in metres


def _3mf(data: bytes) -> Polygons:
    try:
        archive = zipfile.ZipFile(io.BytesIO(data))
        if sum(part.file_size for part in archive.infolist()) > _MOST_OF_MESH:
            raise ValueError(f"it unfolds to more than {_MOST_OF_MESH / 1e6:.0f} MB; {_FEWER}")
        models = [archive.read(name) for name in archive.namelist() if name.lower().endswith(".model")]
    except zipfile.BadZipFile as error:
        raise ValueError(str(error)) from None
    if sum(model.count(b"<component ") for model in models) > _MOST_COMPONENTS:
        raise ValueError(f"it has more than {_MOST_COMPONENTS} components; join them, or export it as STL")
    said = re.search(rb"<model[^>]*\bunit=\"(\w+)\"", models[0]) if models else None
    return _by_library(data, "3mf")._replace(unit=_UNITS.get(said[1].decode() if said else "millimeter"))


def _by_library(data: bytes, kind: str) -> Polygons:
    import trimesh

    if kind == "3mf":
        import lxml  # noqa: F401  (trimesh says only that it does not know the format)
        import networkx  # noqa: F401
    try:
        mesh = trimesh.load_scene(io.BytesIO(data), file_type=kind).to_mesh()
        corners = np.asarray(mesh.faces, dtype=np.int64)
    except Exception as error:  # of any kind, from a file that it does not understand
        raise ValueError(" ".join(f"{type(error).__name__} {error}".split())[:200]) from None
    return Polygons(np.asarray(mesh.vertices, dtype=float), corners.ravel(), np.full(len(corners), 3))


_READERS: dict[str, Callable[[bytes], Polygons]] = {
    ".stl": _stl,
    ".obj": _obj,
    ".ply": _ply,
    ".off": _off,
    ".glb": _glb,
    ".3mf": _3mf,
}
