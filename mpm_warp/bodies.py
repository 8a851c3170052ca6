"""The rigid bodies that touch the soil: their size, friction and nodes, and the mesh files that some are read from."""

from __future__ import annotations

import hashlib
import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from .inputs import read_bytes
from .settings import Settings, lengths, same, setting, settings
from .state import SceneError


@dataclass(frozen=True)
class Axle:
    """The vertical motion of a body whose other motions are prescribed: it carries a load and rests on the soil."""

    mass: float
    """[kg]; gravity acts on it."""
    damping: float = 0.0
    """Force against the vertical velocity per mass [1/s]."""


class Tool(ABC):
    """What a solver asks of any rigid body. The body frame's origin is its centre of mass."""

    surface: ClassVar[str]
    """Which signed distance it has: box | cylinder | mesh (kernels/signed_distance.py)."""
    friction: float

    @property
    @abstractmethod
    def half_size(self) -> np.ndarray:
        """Half the sides of the box around it, aligned with the body's axes and its origin [m], shape (3,)."""

    @property
    def half_thickness(self) -> float:
        """Half its smallest extent [m]: how deep soil can be inside."""
        return float(self.half_size.min())

    @property
    def reach(self) -> float:
        """Radius of a sphere around the origin that holds it [m]."""
        return float(np.linalg.norm(self.half_size))

    @abstractmethod
    def points(self) -> np.ndarray:
        """Body nodes in the body frame [m], shape (M, 3)."""

    @abstractmethod
    def outline(self) -> np.ndarray:
        """Points of the surface, body frame [m], shape (k, 3): where it can touch a wall first."""

    def warnings(self) -> list[str]:
        """What a user should know about it."""
        return []


# --- Boxes and cylinders --------------------------------------------------------------------------------


def _length(default: float, words: str) -> Any:
    return setting(default, words, "m", gt=0, le=1e3, words="; it must be above 0 m and at most 1000 m")


def _upright_edges(half_size: np.ndarray, count: int) -> np.ndarray:
    """`count` points on each of a box's four edges along z, shape (4 count, 3)."""
    hx, hy, hz = half_size
    return np.array(
        [[sx * hx, sy * hy, z] for sx in (-1, 1) for sy in (-1, 1) for z in np.linspace(-hz, hz, count)]
    )


@settings
class Plate(Settings, Tool):
    """A blade: a box centred on its centre of mass.

    Body frame: x through the thickness (front face at +x), y along the width, z along the length (tip at -z).
    """

    group: ClassVar[str] = "blade"
    surface: ClassVar[str] = "box"

    length: float = _length(0.305, "along the blade, tip to top")
    width: float = _length(0.457, "across the direction of travel")
    thickness: float = _length(0.028, "2 to 3 grid spacings keep the soil on its two sides apart")
    friction: float = setting(0.3, "Coulomb friction between soil and body", ge=0)

    @property
    def half_size(self) -> np.ndarray:
        return 0.5 * np.array([self.thickness, self.width, self.length])

    @property
    def tip(self) -> np.ndarray:
        """Middle of the bottom face in the body frame [m], shape (3,)."""
        return np.array([0.0, 0.0, -0.5 * self.length])

    def points(self, rows: int = 3, columns: int = 5) -> np.ndarray:
        """Body nodes: rows x columns points on the front face in the body frame [m], shape (M, 3)."""
        hx, hy, hz = self.half_size
        z, y = np.meshgrid(np.linspace(-hz, hz, rows), np.linspace(-hy, hy, columns), indexing="ij")
        return np.stack([np.full(rows * columns, hx), y.ravel(), z.ravel()], axis=-1)

    def outline(self) -> np.ndarray:
        return _upright_edges(self.half_size, 9)


@settings
class Box(Settings, Tool):
    """A box centred on its centre of mass; its nodes are its corners."""

    group: ClassVar[str] = "tool"
    surface: ClassVar[str] = "box"

    shape: Literal["box"] = setting("box", "of the body")
    size: tuple[float, float, float] = lengths((0.08, 0.20, 0.10), "sides along the body's x, y, z")
    friction: float = same(Plate, "friction")

    @property
    def half_size(self) -> np.ndarray:
        return 0.5 * np.array(self.size)

    def points(self) -> np.ndarray:
        return _upright_edges(self.half_size, 2)

    def outline(self) -> np.ndarray:
        return _upright_edges(self.half_size, 9)


@settings
class Cylinder(Settings, Tool):
    """A cylinder along the body's y axis, with or without grousers: straight bars along the rim."""

    group: ClassVar[str] = "tool"
    surface: ClassVar[str] = "cylinder"

    shape: Literal["cylinder"] = setting("cylinder", "of the body")
    diameter: float = _length(0.15, "of the rim, without grousers")
    width: float = _length(0.083, "along the axis")
    friction: float = same(Plate, "friction")
    grousers: int = setting(
        0, "bars along the rim, evenly spaced; the first is at the body's +x", ge=0, le=360
    )
    grouser_height: float = setting(0.0, "above the rim", "m")
    grouser_thickness: float = setting(0.0, "along the rim", "m")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.grousers:
            for name in ("grouser_height", "grouser_thickness"):
                if not getattr(self, name) > 0:
                    raise SceneError(f"tool.{name} is {getattr(self, name)}; it must be above 0 m")
            gap = math.pi * self.diameter / self.grousers
            if self.grouser_thickness >= gap:
                raise SceneError(
                    f"tool.grouser_thickness is {self.grouser_thickness} m, but grousers begin every {gap:.4g} m of "
                    "the rim; make them thinner or fewer"
                )
        elif self.grouser_height or self.grouser_thickness:
            raise SceneError("tool.grouser_height and grouser_thickness need tool.grousers above 0")

    @property
    def tip_radius(self) -> float:
        """From the axis to the grousers' tips, or to the rim if there are none [m]."""
        return 0.5 * self.diameter + (self.grouser_height if self.grousers else 0.0)

    @property
    def half_size(self) -> np.ndarray:
        return np.array([self.tip_radius, 0.5 * self.width, self.tip_radius])

    @property
    def reach(self) -> float:
        return math.hypot(self.tip_radius, 0.5 * self.width)

    def points(self, count: int = 8) -> np.ndarray:
        """Body nodes: `count` on each of the two rims, shape (2 count, 3)."""
        return self._rims(0.5 * self.diameter, count)

    def outline(self) -> np.ndarray:
        return self._rims(self.tip_radius, 64)

    def _rims(self, radius: float, count: int) -> np.ndarray:
        angle = 2.0 * np.pi * np.arange(count) / count
        x, z, half = radius * np.cos(angle), -radius * np.sin(angle), 0.5 * self.width
        return np.concatenate([np.stack([x, np.full(count, y), z], axis=-1) for y in (-half, half)])


# --- Closed triangle meshes from STL and OBJ files ------------------------------------------------------

_FARTHEST = 1e6  # vertex of a body [m]
_STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("extra", "<u2")])


@settings
class MeshBody(Settings, Tool):
    """A closed triangle mesh from an STL or OBJ file. Its axes are the file's; its origin becomes the centre
    of mass of a body of uniform density.

    The file is read here; a body that is described together with its mesh is made by `of_mesh` and reads none.
    """

    group: ClassVar[str] = "tool"
    surface: ClassVar[str] = "mesh"
    node_count: ClassVar[int] = 16

    shape: Literal["mesh"] = setting("mesh", "of the body")
    file: str = setting("", "STL (text or binary) or OBJ")
    scale: float = setting(1.0, "metres per unit of the file, 0.001 for millimetres", gt=0)
    friction: float = same(Plate, "friction")
    digest: str = setting(
        "", "names the file's content; filled in when it is read, and checked if it is given"
    )

    @classmethod
    def of_mesh(cls, vertices: np.ndarray, triangles: np.ndarray, **values: Any) -> MeshBody:
        """A body whose mesh is known, as from `mesh`; no file is opened.

        Of the `values` of the fields, `file`, `scale` and `digest` only say where the mesh came from.

        Raises:
            SceneError: it is no such mesh.
        """
        body = cls.__new__(cls)
        body.__dict__["mesh"] = (*checked_mesh(vertices, triangles), False)
        cls.__init__(body, **values)
        return body

    def __post_init__(self) -> None:
        super().__post_init__()
        if "mesh" in self.__dict__:  # from `of_mesh`
            return
        if not self.file:
            raise SceneError("tool.file is missing; a mesh needs an STL or OBJ file")
        try:
            digest = hashlib.blake2b(read_bytes(Path(self.file)), digest_size=8).hexdigest()
        except (OSError, ValueError) as error:
            raise SceneError(f"tool.file: cannot read {self.file}: {error}") from None
        if self.digest not in ("", digest):
            raise SceneError(
                f"tool.file: {self.file} is not the file this scene was made with ({self.digest}, now {digest}); "
                "bring the old file back, or leave out tool.digest"
            )
        object.__setattr__(self, "digest", digest)
        _ = self.mesh  # a bad file is refused here

    @cached_property
    def mesh(self) -> tuple[np.ndarray, np.ndarray, bool]:
        """Vertices about the centre of mass [m] (k, 3), triangles (t, 3), and whether they had to be turned."""
        vertices, triangles = read_mesh(Path(self.file))
        return closed_mesh(vertices * self.scale, triangles, self.file)

    @property
    def half_size(self) -> np.ndarray:
        return np.abs(self.mesh[0]).max(axis=0)

    @property
    def half_thickness(self) -> float:
        return 0.5 * float(np.ptp(self.mesh[0], axis=0).min())

    @property
    def reach(self) -> float:
        return float(np.linalg.norm(self.mesh[0], axis=1).max())

    def points(self) -> np.ndarray:
        """Body nodes: up to 16 vertices, each the farthest from those before it."""
        vertices = self.mesh[0]
        chosen = [int(np.argmax(np.linalg.norm(vertices, axis=1)))]
        distance = np.full(len(vertices), np.inf)
        for _ in range(min(self.node_count, len(vertices)) - 1):
            distance = np.minimum(distance, np.linalg.norm(vertices - vertices[chosen[-1]], axis=1))
            chosen.append(int(np.argmax(distance)))
        return vertices[chosen]

    def outline(self) -> np.ndarray:
        return self.mesh[0]

    def warnings(self) -> list[str]:
        if self.mesh[2]:
            return [f"{self.file}: the triangles faced inwards; they were turned round"]
        return []


def read_mesh(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (k, 3), in the file's unit, and triangles (t, 3) of an STL (text or binary) or OBJ file.

    Corners at the same place become one vertex. Polygons of an OBJ are cut into triangles from their first corner.

    Raises:
        SceneError: the file cannot be read, or is no such mesh.
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
    """Vertices (k, 3) about the centre of mass of the volume that a mesh bounds, triangles (t, 3) that face outwards,
    and whether they had to be turned round for that.

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
        SceneError: it is none.
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
