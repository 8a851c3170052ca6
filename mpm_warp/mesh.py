"""Closed triangle meshes from STL and OBJ files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .inputs import read_bytes
from .state import SceneError

_FARTHEST = 1e6  # vertex of a body [m]
_STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("extra", "<u2")])


def read_mesh(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (k, 3), in the file's unit, and triangles (t, 3) of an STL (text or binary) or OBJ file.

    Corners at the same place become one vertex. Polygons of an OBJ are cut into triangles from their first corner.
    """
    readers = {".stl": _stl, ".obj": _obj}
    reader = readers.get(file.suffix.lower())
    if reader is None:
        raise SceneError(f"tool.file is {file}; allowed: {', '.join(f'*{s}' for s in readers)}")
    try:
        vertices, triangles = reader(read_bytes(file))
    except OSError as error:
        raise SceneError(f"tool.file: cannot read {file}: {error.strerror}") from None
    except (ValueError, IndexError, OverflowError) as error:
        raise SceneError(f"tool.file: {file} is not a good {file.suffix[1:].upper()} file: {error}") from None
    if len(triangles) == 0:
        raise SceneError(f"tool.file: {file} holds no triangles")
    if not np.isfinite(vertices).all():
        raise SceneError(f"tool.file: {file} holds a coordinate that is not finite")
    vertices, place = np.unique(vertices, axis=0, return_inverse=True)
    triangles = place.reshape(-1)[triangles]
    a, b, c = triangles.T
    return vertices, triangles[(a != b) & (b != c) & (c != a)]


def closed_mesh(
    vertices: np.ndarray, triangles: np.ndarray, name: str
) -> tuple[np.ndarray, np.ndarray, bool]:
    """A mesh that bounds a volume, about its centre of mass.

    Returns:
        Vertices (k, 3) about the centre of mass of the volume, triangles (t, 3) that face outwards, and whether they
        had to be turned round for that.

    Raises:
        SceneError: the mesh is open, or its triangles do not all face the same way.
    """
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    uses = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)[1]
    if np.any(uses != 2):
        raise SceneError(
            f"tool.file: the mesh in {name} is not closed: {np.sum(uses != 2)} of {len(uses)} edges do not belong to "
            "exactly two triangles; close it (for example with a mesh editor's repair) and try again"
        )
    if len(np.unique(edges, axis=0)) < len(edges):
        raise SceneError(
            f"tool.file: the triangles of {name} do not all face the same way; make its normals consistent "
            "and try again"
        )
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    parts = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0  # volumes of the tetrahedra with the origin
    volume = float(parts.sum())
    if abs(volume) < 1e-9 * float(np.prod(np.ptp(vertices, axis=0))) or volume == 0.0:
        raise SceneError(f"tool.file: the mesh in {name} encloses no volume")
    centre = (parts[:, None] * (a + b + c)).sum(axis=0) / (4.0 * volume)
    return vertices - centre, triangles if volume > 0.0 else triangles[:, ::-1], volume < 0.0


def checked_mesh(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A mesh that `closed_mesh` made before and that was kept since, its vertices (k, 3) [m] to the bit.

    Raises:
        SceneError: it is none: not closed, not about its centre of mass, facing inwards, not finite, or with corners
            that are not there.
    """
    vertices, triangles = np.asarray(vertices, dtype=np.float64), np.asarray(triangles)
    if vertices.ndim != 2 or triangles.ndim != 2 or vertices.shape[1] != 3 or triangles.shape[1] != 3:
        raise SceneError(f"the mesh has vertices {vertices.shape} and triangles {triangles.shape}")
    if triangles.dtype.kind not in "iu" or len(triangles) == 0:
        raise SceneError("the mesh has no triangles of whole numbers")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise SceneError("the mesh has a triangle with a vertex that is not there")
    if not np.isfinite(vertices).all() or np.abs(vertices).max() > _FARTHEST:
        raise SceneError(f"the mesh has a vertex that is not finite or beyond {_FARTHEST:g} m")
    triangles = triangles.astype(np.int64)
    again, _, turned = closed_mesh(vertices, triangles, "the scene")
    if turned or np.abs(again - vertices).max() > 1e-6 * np.abs(vertices).max():
        raise SceneError("the mesh faces inwards or is not about its centre of mass")
    return vertices, triangles


def _stl(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    count = int.from_bytes(data[80:84], "little")
    # A text file may be told by its length only: binary ones may begin with "solid", too.
    if len(data) >= 84 and len(data) == 84 + count * _STL_TRIANGLE.itemsize:
        corners = np.frombuffer(data, _STL_TRIANGLE, count, 84)["corners"].reshape(-1, 3).astype(float)
    elif data.lstrip()[:5].lower() == b"solid":
        words = [line.split() for line in data.decode("utf-8").splitlines()]
        corners = np.array([w[1:4] for w in words if w and w[0].lower() == "vertex"], dtype=float)
        if len(corners) % 3:
            raise ValueError("a triangle is cut short")
    else:
        raise ValueError("neither text nor as long as it says; it may be cut short")
    return corners.reshape(-1, 3), np.arange(len(corners)).reshape(-1, 3)


def _obj(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    vertices: list[list[str]] = []
    triangles: list[list[int]] = []
    for line in data.decode("utf-8").splitlines():
        words = line.split()
        if words[:1] == ["v"]:
            vertices.append(words[1:4])
        elif words[:1] == ["f"]:
            numbers = [int(word.split("/")[0]) for word in words[1:]]
            # Indices count from 1, negative ones back from the last vertex so far.
            corner = [n - 1 if n > 0 else len(vertices) + n for n in numbers]
            triangles += [[corner[0], corner[k], corner[k + 1]] for k in range(1, len(corner) - 1)]
    points = np.array(vertices, dtype=float).reshape(-1, 3)
    index = np.array(triangles, dtype=int).reshape(-1, 3)
    if index.size and not (0 <= index.min() and index.max() < len(points)):
        raise ValueError("a face names a vertex that is not there")
    return points, index
