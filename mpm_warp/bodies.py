"""A body whose height is free: it carries a load and rests on the soil.

One thread on the device moves it once per substep with the impulse the soil gave it, so nothing waits for the host and
the step can be part of a captured graph. Height and speed are kept in double precision whatever the solver's: in
single precision a height of 0.15 m moves in steps of 1.5e-8 m, and a wheel that sinks slower than one such step per
substep would hang in the air.
"""

from __future__ import annotations

import hashlib
import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from .inputs import read_bytes
from .mesh import checked_mesh, closed_mesh, read_mesh
from .state import SceneError

# --- A body whose height is free: it carries a load and rests on the soil -------------------------------
# One thread on the device moves it once per substep with the impulse the soil gave it, so nothing waits for
# the host and
# the step can be part of a captured graph. Height and speed are kept in double precision whatever the solver's: in
# single precision a height of 0.15 m moves in steps of 1.5e-8 m, and a wheel that sinks slower than one such step per
# substep would hang in the air.


@dataclass(frozen=True)
class Axle:
    """The vertical motion of a body whose other motions are prescribed."""

    mass: float
    """[kg]; gravity acts on it."""
    damping: float = 0.0
    """Force against the vertical velocity per mass [1/s]."""


# --- Rigid bodies that touch the soil: their size, friction and nodes, as plain data --------------------


class Body(ABC):
    """What a solver asks of any body. The body frame's origin is its centre of mass."""

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


def _require(body: Any, where: str, positive: tuple[str, ...], unit: str = "m") -> None:
    for name in positive:
        value = getattr(body, name)
        if not (math.isfinite(value) and value > 0):
            raise SceneError(f"{where}.{name} is {value}; it must be above 0 {unit}")
    if not (math.isfinite(body.friction) and body.friction >= 0):
        raise SceneError(f"{where}.friction is {body.friction}; it must be 0 or more")


def _corners(half_size: np.ndarray) -> np.ndarray:
    signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return signs * half_size


def _box_outline(half_size: np.ndarray, count: int = 9) -> np.ndarray:
    hx, hy, hz = half_size
    return np.array(
        [[sx * hx, sy * hy, z] for sx in (-1, 1) for sy in (-1, 1) for z in np.linspace(-hz, hz, count)]
    )


@dataclass(frozen=True)
class Plate(Body):
    """A blade: a box centred on its centre of mass.

    Body frame: x through the thickness (front face at +x), y along the width, z along the length (tip at -z).
    """

    surface: ClassVar[str] = "box"

    length: float = 0.305
    """Along the blade, tip to top [m]."""
    width: float = 0.457
    """Across the direction of travel [m]."""
    thickness: float = 0.028
    """[m]; about 2 to 3 grid spacings are needed to keep the soil on its two sides apart."""
    friction: float = 0.3
    """Coulomb friction between soil and blade [-]."""

    def __post_init__(self) -> None:
        _require(self, "blade", ("length", "width", "thickness"))

    @property
    def half_size(self) -> np.ndarray:
        """Half the thickness, width and length [m], shape (3,)."""
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
        return _box_outline(self.half_size)


@dataclass(frozen=True)
class Box(Body):
    """A box centred on its centre of mass; its nodes are its corners."""

    surface: ClassVar[str] = "box"

    shape: str = "box"
    size: tuple[float, float, float] = (0.05, 0.05, 0.05)
    """Sides along the body's x, y, z [m]."""
    friction: float = 0.3
    """Coulomb friction [-]."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "size", tuple(float(s) for s in self.size))
        if len(self.size) != 3 or not all(math.isfinite(s) and s > 0 for s in self.size):
            raise SceneError(f"tool.size is {self.size}; it needs three lengths above 0 m")
        _require(self, "tool", ())

    @property
    def half_size(self) -> np.ndarray:
        return 0.5 * np.array(self.size)

    def points(self) -> np.ndarray:
        return _corners(self.half_size)

    def outline(self) -> np.ndarray:
        return _box_outline(self.half_size)


@dataclass(frozen=True)
class Cylinder(Body):
    """A cylinder along the body's y axis, with or without grousers: straight bars along the rim."""

    surface: ClassVar[str] = "cylinder"

    shape: str = "cylinder"
    diameter: float = 0.15
    """Of the rim, without grousers [m]."""
    width: float = 0.083
    """Along the axis [m]."""
    friction: float = 0.3
    """Coulomb friction [-]."""
    grousers: int = 0
    """How many, evenly spaced; the first is at the body's +x."""
    grouser_height: float = 0.0
    """Above the rim [m]."""
    grouser_thickness: float = 0.0
    """Along the rim [m]."""

    def __post_init__(self) -> None:
        _require(self, "tool", ("diameter", "width"))
        if not 0 <= self.grousers <= 360:
            raise SceneError(f"tool.grousers is {self.grousers}; allowed: 0 to 360")
        if self.grousers:
            _require(self, "tool", ("grouser_height", "grouser_thickness"))
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


@dataclass(frozen=True)
class MeshBody(Body):
    """A closed triangle mesh from an STL or OBJ file. Its axes are the file's; its origin becomes the centre
    of mass of a body of uniform density.

    The file is read here; a body that is described together with its mesh is made by `of_mesh` and reads none.
    """

    surface: ClassVar[str] = "mesh"
    node_count: ClassVar[int] = 16

    shape: str = "mesh"
    file: str = ""
    """STL (text or binary) or OBJ."""
    scale: float = 1.0
    """Metres per unit of the file, 0.001 for millimetres."""
    friction: float = 0.3
    """Coulomb friction [-]."""
    digest: str = field(default="")
    """Names the file's content; filled in when it is read, and checked if it is given."""

    @classmethod
    def of_mesh(cls, vertices: np.ndarray, triangles: np.ndarray, **values: Any) -> MeshBody:
        """A body whose mesh is known; no file is opened.

        Args:
            vertices: about the centre of mass [m], shape (k, 3), as in `mesh`.
            triangles: shape (t, 3), as in `mesh`.
            values: of the fields; `file`, `scale` and `digest` only say where the mesh came from.

        Raises:
            SceneError: it is no such mesh.
        """
        body = cls.__new__(cls)
        body.__dict__["mesh"] = (*checked_mesh(vertices, triangles), False)
        body.__init__(**values)
        return body

    def __post_init__(self) -> None:
        _require(self, "tool", ("scale",), "")
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
