"""The rigid bodies that touch the soil: their size, friction and nodes."""

from __future__ import annotations

import hashlib
import math
from abc import ABC, abstractmethod
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from .mesh_files import mesh_content, read_mesh
from .settings import Settings, lengths, same, setting, settings
from .solids import Solid, checked_mesh, closed_mesh, solid_and_surface
from .state import SceneError


@dataclass(frozen=True)
class Axle:
    """The vertical motion of a body whose other motions are prescribed: it carries a load and rests on the soil."""

    mass: float
    """[kg]; gravity acts on it."""
    damping: float = 0.0
    """Force against the vertical velocity per mass [1/s]."""
    load: tuple[tuple[float, float], ...] = ()
    """Rows of a time [s] and what it carries then [N]; none: its weight."""

    def fall(self, times: np.ndarray, gravity: float) -> float:
        """Mean acceleration without soil [m/s^2], downwards, over some times [s]."""
        if not self.load:
            return gravity
        at, load = np.transpose(self.load)
        return float(np.interp(times, at, load).mean()) / self.mass


class Tool(ABC):
    """What a solver asks of any rigid body. The body frame's origin is its centre of mass."""

    surface: ClassVar[str]
    """Which signed distance it has: box | plate | cylinder | sphere | mesh (kernels/signed_distance.py)."""
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

    @property
    def tip(self) -> np.ndarray:
        """Middle of the lowest face or edge in the body frame [m], shape (3,)."""
        return np.array([0.0, 0.0, -self.half_size[2]])

    @property
    def origins(self) -> dict[str, np.ndarray]:
        """Points that a path may be the path of, in the body frame [m], by the name that `origin` has for them."""
        return {"com": np.zeros(3), "tip": self.tip}

    @property
    def path_point(self) -> np.ndarray:
        """The point that `scene.path` is the path of, in the body frame [m], shape (3,)."""
        return self.origins[getattr(self, "origin", "com")]

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


WEDGE = 30.0
"""Angle of a plate's edge that is ground from the back [degrees]."""


@settings
class Plate(Settings, Tool):
    """A blade: a box, or one whose lower end is cut.

    Body frame: x through the thickness (front face at +x), y along the width, z along the length (tip at -z). Its
    origin is the middle of the box, whatever the edge, so that a path means the same for all edges.
    """

    group: ClassVar[str] = "blade"
    level: ClassVar[float] = 0.0
    """Of an end that is cut level: its angle from a square one [degrees], see `level_at`."""

    length: float = _length(0.305, "along the blade, tip to top")
    width: float = _length(0.457, "across the direction of travel")
    thickness: float = _length(0.028, "2 to 3 grid spacings keep the soil on its two sides apart")
    friction: float = setting(0.3, "Coulomb friction between soil and body", ge=0)
    edge: Literal["square", "level", "bevel"] = setting(
        "bevel",
        f"of the lower end; level: cut level where the motion starts; bevel: ground from the back to {WEDGE:g} degrees",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.cut_angle and abs(self._cut) >= self.length:
            raise SceneError(
                f"blade.length is {self.length} m; an edge that is cut by {abs(self.cut_angle):.3g} degrees needs more "
                f"than {abs(self._cut):.3g} m: make the plate longer or thinner, or set blade.edge=square"
            )

    @property
    def surface(self) -> str:  # type: ignore[override]  # of other tools it is the same for all
        return "plate" if self.cut_angle else "box"

    @property
    def cut_angle(self) -> float:
        """Of the lower end from a square one, positive where its back is higher [degrees]."""
        return {"square": 0.0, "level": self.level, "bevel": 90.0 - WEDGE}[self.edge]

    @property
    def _cut(self) -> float:
        """By what the end's back is higher than its front [m]."""
        return self.thickness * math.tan(math.radians(self.cut_angle))

    def level_at(self, rotation: np.ndarray) -> Plate:
        """The same plate; a level end is horizontal with this rotation (4,)."""
        if self.edge != "level":
            return self
        x, y, z, w = rotation
        level = math.degrees(math.atan2(2.0 * (x * z - w * y), w * w + z * z - x * x - y * y))
        plate = copy(self)
        object.__setattr__(plate, "level", min(max(level, -89.9), 89.9))
        plate.__post_init__()
        return plate

    @property
    def section(self) -> np.ndarray:
        """Corners of the cut with the plane y = 0, x and z [m]: lower front, then up, back and down; shape (4, 2)."""
        x, _, z = self.half_size
        front, back = max(0.0, -self._cut), max(0.0, self._cut)
        return np.array([[x, front - z], [x, z], [-x, z], [-x, back - z]])

    @property
    def corners(self) -> np.ndarray:
        """In the body frame [m], shape (8, 3)."""
        y = 0.5 * self.width
        return np.array([[x, side, z] for side in (-y, y) for x, z in self.section])

    @property
    def tip(self) -> np.ndarray:
        """Middle of the lower end, or of its edge."""
        x, z = self.section[0] if self.edge == "bevel" else 0.5 * (self.section[0] + self.section[3])
        return np.array([x, 0.0, z])

    @property
    def half_size(self) -> np.ndarray:
        return 0.5 * np.array([self.thickness, self.width, self.length])

    def points(self, rows: int = 3, columns: int = 5) -> np.ndarray:
        """Body nodes: rows x columns points on the front face in the body frame [m], shape (M, 3)."""
        hx, hy, hz = self.half_size
        z, y = np.meshgrid(
            np.linspace(self.section[0, 1], hz, rows), np.linspace(-hy, hy, columns), indexing="ij"
        )
        return np.stack([np.full(rows * columns, hx), y.ravel(), z.ravel()], axis=-1)

    def outline(self) -> np.ndarray:
        if not self.cut_angle:
            return _upright_edges(self.half_size, 9)
        low, high = self.corners[[0, 3, 4, 7]], self.corners[[1, 2, 5, 6]]
        return np.concatenate([low + share * (high - low) for share in np.linspace(0.0, 1.0, 9)])


@settings
class Box(Settings, Tool):
    """A box centred on its centre of mass; its nodes are its corners."""

    group: ClassVar[str] = "tool"
    surface: ClassVar[str] = "box"

    shape: Literal["box"] = setting("box", "of the body")
    size: tuple[float, float, float] = lengths((0.08, 0.20, 0.10), "sides along the body's x, y, z")
    origin: Literal["com", "tip"] = setting(
        "com", "whose path scene.path is: centre of mass, or middle of the underside"
    )
    friction: float = same(Plate, "friction")

    @property
    def half_size(self) -> np.ndarray:
        return 0.5 * np.array(self.size)

    @property
    def moments(self) -> tuple[float, np.ndarray]:
        """Volume [m^3], and inertia about the body's axes per density [m^5], shape (3, 3)."""
        volume, squares = math.prod(self.size), np.square(self.size)
        return volume, np.diag(volume / 12.0 * (squares.sum() - squares))

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
    origin: Literal["com", "tip"] = same(Box, "origin")
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

    @property
    def moments(self) -> tuple[float, np.ndarray]:
        """As of a box, without grousers."""
        radius = 0.5 * self.diameter
        volume = math.pi * radius**2 * self.width
        across = volume * (3.0 * radius**2 + self.width**2) / 12.0
        return volume, np.diag([across, 0.5 * volume * radius**2, across])

    def points(self, count: int = 8) -> np.ndarray:
        """Body nodes: `count` on each of the two rims, shape (2 count, 3)."""
        return self._rims(0.5 * self.diameter, count)

    def outline(self) -> np.ndarray:
        return self._rims(self.tip_radius, 64)

    def _rims(self, radius: float, count: int) -> np.ndarray:
        angle = 2.0 * np.pi * np.arange(count) / count
        x, z, half = radius * np.cos(angle), -radius * np.sin(angle), 0.5 * self.width
        return np.concatenate([np.stack([x, np.full(count, y), z], axis=-1) for y in (-half, half)])


@settings
class Sphere(Settings, Tool):
    """A sphere, for a further body of a scene."""

    group: ClassVar[str] = "tool"
    surface: ClassVar[str] = "sphere"

    shape: Literal["sphere"] = setting("sphere", "of the body")
    diameter: float = _length(0.10, "of the sphere")
    friction: float = same(Plate, "friction")

    @property
    def half_size(self) -> np.ndarray:
        return np.full(3, 0.5 * self.diameter)

    @property
    def reach(self) -> float:
        return 0.5 * self.diameter

    @property
    def moments(self) -> tuple[float, np.ndarray]:
        """As of a box."""
        volume = math.pi / 6.0 * self.diameter**3
        return volume, np.diag(np.full(3, 0.1 * volume * self.diameter**2))

    def points(self) -> np.ndarray:
        """Body nodes: where the body's axes go through the surface, shape (6, 3)."""
        return 0.5 * self.diameter * np.vstack([np.eye(3), -np.eye(3)])

    def outline(self) -> np.ndarray:
        z = np.linspace(-1.0, 1.0, 401)
        turn, across = math.pi * (3.0 - math.sqrt(5.0)) * np.arange(401), np.sqrt(1.0 - z**2)
        return 0.5 * self.diameter * np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=-1)


# --- Closed triangle meshes from files ------------------------------------------------------------------

UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}
"""Name of a unit of length → how many metres it is."""


@settings
class MeshBody(Settings, Tool):
    """A closed triangle mesh from a file. Its axes are the file's; its mass is that of a body of uniform density.

    The file is read here; a body that is described together with its mesh is made by `of_mesh` and reads none.
    """

    group: ClassVar[str] = "tool"
    surface: ClassVar[str] = "mesh"
    node_count: ClassVar[int] = 16

    shape: Literal["mesh"] = setting("mesh", "of the body")
    file: str = setting("", "STL, OBJ, PLY or OFF; GLB or 3MF")
    unit: Literal["file", "mm", "cm", "m", "in"] = setting(
        "file", "of the file's lengths; file: as the file says, metres if it does not"
    )
    scale: float = setting(1.0, "multiplies the file's lengths", gt=0)
    origin: Literal["com", "file", "tip"] = setting(
        "com", "whose path scene.path is: centre of mass, the file's origin, or middle of the lowest corners"
    )
    friction: float = same(Plate, "friction")
    centre: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0),
        "of mass in the file, for origin=file; filled in when it is read",
        "m",
        ge=-1e6,
        le=1e6,
        words="; it needs three lengths",
    )
    digest: str = setting(
        "", "names the file's content; filled in when it is read, and checked if it is given"
    )

    @classmethod
    def of_mesh(cls, vertices: np.ndarray, triangles: np.ndarray, **values: Any) -> MeshBody:
        """A body whose mesh is known, as from `mesh`; no file is opened.

        Of the `values` of the fields, `file`, `unit`, `scale` and `digest` only say where the mesh came from.

        Raises:
            SceneError: it is no such mesh.
        """
        body = cls.__new__(cls)
        body.__dict__["mesh"] = checked_mesh(vertices, triangles)
        cls.__init__(body, **values)
        return body

    def __post_init__(self) -> None:
        super().__post_init__()
        if "mesh" in self.__dict__:  # from `of_mesh`
            return
        if not self.file:
            raise SceneError("tool.file is missing; a mesh needs a file: STL, OBJ, PLY, OFF, GLB or 3MF")
        try:
            digest = hashlib.blake2b(mesh_content(Path(self.file)), digest_size=8).hexdigest()
        except (OSError, ValueError) as error:
            words = getattr(error, "strerror", None) or error
            raise SceneError(f"tool.file: cannot read {self.file}: {words}") from None
        if self.digest not in ("", digest):
            raise SceneError(
                f"tool.file: {self.file} is not the file this scene was made with ({self.digest}, now {digest}); "
                "bring the old file back, or leave out tool.digest"
            )
        object.__setattr__(self, "digest", digest)
        solid = self._solid  # a bad file is refused here
        object.__setattr__(self, "centre", tuple(map(float, solid.centre * (self.origin == "file"))))

    @cached_property
    def _solid(self) -> Solid:
        vertices, triangles, said = read_mesh(Path(self.file))
        metres = UNITS.get(self.unit, said or 1.0)
        return closed_mesh(vertices * (self.scale * metres), triangles, self.file)

    @cached_property
    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices about the centre of mass [m] (k, 3), triangles (t, 3)."""
        return self._solid.vertices, self._solid.triangles

    @cached_property
    def _moments(self) -> list[tuple[float, np.ndarray]]:
        return solid_and_surface(*self.mesh)

    @property
    def moments(self) -> tuple[float, np.ndarray]:
        """As of a box."""
        return self._moments[0]

    @property
    def surface_moments(self) -> tuple[float, np.ndarray]:
        """Area [m^2], and inertia of a thin skin per mass and area [m^4], shape (3, 3)."""
        return self._moments[1]

    @property
    def tip(self) -> np.ndarray:
        """Middle of the lowest corners."""
        vertices = self.mesh[0]
        low = vertices[vertices[:, 2] < vertices[:, 2].min() + 1e-6 * self.reach]
        return 0.5 * (low.min(axis=0) + low.max(axis=0))

    @property
    def origins(self) -> dict[str, np.ndarray]:
        found = super().origins
        if self.origin == "file" or "_solid" in self.__dict__:
            found["file"] = -(np.array(self.centre) if self.origin == "file" else self._solid.centre)
        return found

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
        return [f"{self.file}: {note}" for note in self._solid.notes] if "_solid" in self.__dict__ else []
