"""Mesh files for the tests, written here."""

from pathlib import Path

import numpy as np

BOX_FACES = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]


def box_corners(size: tuple[float, float, float], corner=(0.0, 0.0, 0.0)) -> np.ndarray:
    """(8, 3): the box's lowest corner is `corner`."""
    return np.array([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)]) * np.array(size) + corner


def box_triangles() -> np.ndarray:
    """(12, 3), facing outwards."""
    return np.array([[f[0], f[k], f[k + 1]] for f in BOX_FACES for k in (1, 2)])


def write_obj(file: Path, vertices: np.ndarray, faces) -> Path:
    lines = [f"v {x} {y} {z}" for x, y, z in vertices]
    lines += ["f " + " ".join(f"{i + 1}//1" for i in face) for face in faces]
    file.write_text("\n".join(["# a mesh", *lines]) + "\n")
    return file


def write_stl(file: Path, vertices: np.ndarray, triangles: np.ndarray) -> Path:
    record = np.zeros(
        len(triangles), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("extra", "<u2")]
    )
    record["corners"] = vertices[triangles]
    header = b"solid by chance".ljust(80)
    file.write_bytes(header + np.uint32(len(triangles)).tobytes() + record.tobytes())
    return file


def write_text_stl(file: Path, vertices: np.ndarray, triangles: np.ndarray) -> Path:
    lines = ["solid box"]
    for triangle in triangles:
        lines += ["facet normal 0 0 0", "outer loop"]
        lines += [f"  vertex {x} {y} {z}" for x, y, z in vertices[triangle]]
        lines += ["endloop", "endfacet"]
    file.write_text("\n".join([*lines, "endsolid box"]) + "\n")
    return file
