"""What is to be simulated: plain data, checked, without physics."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from types import UnionType
from typing import Any, ClassVar, get_args, get_origin, get_type_hints

import numpy as np

from .bed import Bed
from .bodies import Axle, Body, MeshBody
from .material import Material
from .poses import rotate, rotation_vectors
from .ranges import (
    FRAME_RATE,
    LEAST_COURANT,
    MOST_DURATION,
    MOST_FRAMES,
    MOST_GRAVITY,
)
from .state import SceneError

MOST_COURANT = 0.8
"""Largest `courant`. From 0.86 on a cut's forces come out too small, with nothing else to see
(experiments/stability/step.csv)."""


@dataclass(frozen=True)
class Scene:
    """A soil bed, gravity, and for how long; subclasses add the body and its motion.

    A subclass with a `kind` of its own is a kind of scene that `from_dict` knows.
    """

    kinds: ClassVar[dict[str, type[Scene]]] = {}
    """Kind → class."""
    bilateral: ClassVar[bool] = False
    """Whether soil in contact with the body is held, too (contact.py); a kind of scene may make it a key."""

    name: str = "bed"
    kind: str = "bed"
    bed: Bed = field(default_factory=Bed)
    material: Material = field(default_factory=Material)
    gravity: float = 9.81
    """[m/s^2], downwards."""
    tilt: float = 0.0
    """The bin's slope, falling towards +x [degrees]: gravity is turned by it about y."""
    duration: float = 16.0 / 3.0
    """[s]."""
    frame_rate: float = 60.0
    """Recorded frames per second [Hz]."""
    contact_margin: float = -0.25
    """Distance from the body's surface at which it begins to act on soil, negative inside [grid spacings]; see
    contact.py."""
    courant: float = 0.6
    """Time step as a share of spacing / wave speed."""
    elastic_damping: float = 0.1
    """Damping ratio of elastic waves as short as the grid can carry; longer ones are damped less [-]."""
    volume_averaging: float = 1.0
    """Share of a particle's own volume change that the mean around it replaces [-]."""
    remap_time: float = 4.0e-3
    """Longest time between two remaps of the velocities [s]; see solver.py."""
    remap_distance: float = 0.1
    """Longest way of soil between two remaps [grid spacings]."""
    velocity_memory: float = 0.1
    """Time after which 63 % of the velocities that the grid does not resolve are gone [s]."""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if "kind" in cls.__dict__:
            Scene.kinds[cls.kind] = cls

    def __post_init__(self) -> None:
        if not 0.0 <= self.gravity <= MOST_GRAVITY:
            raise SceneError(f"scene.gravity is {self.gravity} m/s^2; allowed: 0 to {MOST_GRAVITY:g}")
        if not -90.0 < self.tilt < 90.0:
            raise SceneError(f"scene.tilt is {self.tilt} degrees; allowed: above -90, below 90")
        if not FRAME_RATE[0] <= self.frame_rate <= FRAME_RATE[1]:
            raise SceneError(
                f"scene.frame_rate is {self.frame_rate} Hz; allowed: {FRAME_RATE[0]:g} to {FRAME_RATE[1]:g}"
            )
        if not self.duration * self.frame_rate >= 1.0:
            raise SceneError(f"scene.duration is {self.duration} s; it must last at least one frame")
        if not self.duration <= MOST_DURATION:
            raise SceneError(f"scene.duration is {self.duration} s; allowed: at most {MOST_DURATION:g}")
        if not self.duration * self.frame_rate <= MOST_FRAMES:
            raise SceneError(
                f"scene.duration is {self.duration} s at scene.frame_rate {self.frame_rate} Hz: "
                f"{self.duration * self.frame_rate:.2g} frames; at most {MOST_FRAMES:g} are allowed: lower one of them"
            )
        if not -1.0 <= self.contact_margin <= 1.0:
            raise SceneError(f"scene.contact_margin is {self.contact_margin} grid spacings; allowed: -1 to 1")
        if not LEAST_COURANT <= self.courant <= MOST_COURANT:
            raise SceneError(
                f"scene.courant is {self.courant}; allowed: {LEAST_COURANT:g} to {MOST_COURANT}: with longer steps "
                "elastic waves in the soil grow"
            )
        for name in ("elastic_damping", "volume_averaging"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise SceneError(f"scene.{name} is {getattr(self, name)}; allowed: 0 to 1")
        if not 0.0 <= self.remap_time < math.inf:
            raise SceneError(f"scene.remap_time is {self.remap_time} s; it must be 0 (every step) or more")
        if not 0.0 < self.remap_distance <= 0.5:
            raise SceneError(
                f"scene.remap_distance is {self.remap_distance} grid spacings; allowed: above 0, at most 0.5"
            )
        if not 0.0 < self.velocity_memory < math.inf:
            raise SceneError(f"scene.velocity_memory is {self.velocity_memory} s; it must be above 0")

    # --- what a solver or a rollout asks of a scene -------------------------------------------------------

    @property
    def contact_distance(self) -> float:
        """Distance of a particle's centre from the body's surface at which contact begins [m]: soil reaches half a
        particle spacing further than the centre."""
        return self.contact_margin * self.bed.spacing + 0.5 * self.bed.particle_spacing

    @property
    def gravity_vector(self) -> np.ndarray:
        """[m/s^2], shape (3,)."""
        angle = math.radians(self.tilt)
        return self.gravity * np.array([math.sin(angle), 0.0, -math.cos(angle)])

    @property
    def filled(self) -> tuple[np.ndarray, float]:
        """Particle positions (n, 3) [m] and the volume of one [m^3]."""
        return self.bed.filled

    @property
    def stored(self) -> np.ndarray:
        """Indices of the particles that are recorded; see `Bed.stored_of`."""
        return self.bed.stored_of(len(self.filled[0]))

    @property
    def soil_volume(self) -> float:
        """Space that the soil takes up at the start [m^3]."""
        return float(np.prod(self.bed.size))

    def initial_velocities(self) -> np.ndarray:
        """Soil at time 0 [m/s], shape (n, 3), float64."""
        return np.zeros_like(self.filled[0])

    @property
    def body(self) -> Body | None:
        """The rigid body that touches the soil, if any."""
        return None

    @property
    def mesh(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Vertices (k, 3) [m] about the centre of mass and triangles (t, 3) of a body that is a mesh."""
        return self.body.mesh[:2] if isinstance(self.body, MeshBody) else None

    @property
    def axle(self) -> Axle | None:
        """The body's vertical motion if it is free; None: all of it is prescribed."""
        return None

    @property
    def frame_count(self) -> int:
        """T, with the initial state as frame 0."""
        return round(self.duration * self.frame_rate) + 1

    def times(self) -> np.ndarray:
        """Times of the frames [s], shape (T,)."""
        return np.arange(self.frame_count) / self.frame_rate

    def poses_at(self, time: np.ndarray) -> np.ndarray:
        """Pose of the body at any times [s]: centre of mass [m] and quaternion x, y, z, w; shape (T, 7).

        Of a body with a free height the z of the start, which the solver replaces.
        """
        return np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (len(np.atleast_1d(time)), 1))

    def body_poses(self) -> np.ndarray:
        """Poses at the frames, shape (T, 7)."""
        return self.poses_at(self.times())

    def path_times(self) -> np.ndarray:
        """Times at which a prescribed path may turn [s], increasing, shape (k,); none for a smooth motion."""
        return np.zeros(0)

    def travel(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What the body's centre travels [m] and by what angle the body turns [rad] from each of the increasing times
        (T,) [s] to the next, both of shape (T - 1,).

        A path counts row by row, whatever it comes back to; between rows, and without any, a body turns the shortest
        way.
        """
        rows = self.path_times()
        every = np.union1d(time, rows[(rows > time[0]) & (rows < time[-1])])
        poses = self.poses_at(every)
        way = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1)
        angle = np.linalg.norm(rotation_vectors(poses[:-1, 3:], poses[1:, 3:]), axis=1)
        first = np.searchsorted(every, time[:-1])
        return np.add.reduceat(way, first), np.add.reduceat(angle, first)

    def ways(self, time: np.ndarray) -> np.ndarray:
        """The most that any point of the body travels from each of the increasing times (T,) [s] to the next [m],
        shape (T - 1,)."""
        way, angle = self.travel(time)
        return way + self.body.reach * angle

    def body_points(self) -> np.ndarray:
        """Body nodes in the body frame [m], shape (M, 3)."""
        return np.zeros((0, 3))

    def initial_positions(self) -> np.ndarray:
        """Soil at time 0 [m], shape (n, 3), float64."""
        return self.filled[0]

    @property
    def arrangement_hash(self) -> str:
        """See `Bed.arrangement_hash`."""
        return self.bed.arrangement_hash

    def warnings(self) -> list[str]:
        """What a user should know about this scene before it runs."""
        return self.material.warnings() + (self.body.warnings() if self.body is not None else [])

    def summary(self, force: np.ndarray, torque: np.ndarray, poses: np.ndarray) -> str:
        """What came out, in a few words; empty without a body.

        Args:
            force: by the soil on the body at the frames [N], shape (T, 3).
            torque: about its centre of mass [N m], shape (T, 3).
            poses: of the body, shape (T, 7).
        """
        return ""

    def to_dict(self) -> dict[str, Any]:
        """Everything that defines the scene, as plain nested data; of a mesh only its file and digest, see `mesh`."""
        return json.loads(json.dumps(asdict(self)))

    @staticmethod
    def from_dict(data: dict[str, Any], mesh: tuple[np.ndarray, np.ndarray] | None = None) -> Scene:
        """The scene described by plain nested data, checked.

        Args:
            data: as from `to_dict`, or less. A `tool.file` without `tool.digest` is read: it is a person's wish. One
                with a digest has been read before, and `data` may come from any file, which must not make another
                be read.
            mesh: of such a tool, see `mesh`.
        """
        kind = data.get("kind", "bed")
        if not isinstance(kind, str) or kind not in Scene.kinds:
            raise SceneError(f"scene.kind is {kind!r}; allowed: {', '.join(Scene.kinds)}")
        tool = data.get("tool")
        if mesh is None and isinstance(tool, dict) and tool.get("shape") == "mesh" and tool.get("digest"):
            raise SceneError(
                "scene.tool is a mesh that was read before and does not come with these data; give it, as in "
                "Scene.from_dict(scene.to_dict(), scene.mesh), or leave out tool.digest to read tool.file again"
            )
        return _build(Scene.kinds[kind], data, "scene", mesh)

    # --- checks for scenes with a body --------------------------------------------------------------------

    def _check_thickness(self, what: str) -> None:
        """A body must be thick enough for soil to be inside before it is pushed out."""
        core = self.body.half_thickness + self.contact_distance
        if core < 0.1 * self.bed.spacing:
            raise SceneError(
                f"{what} of {2.0 * self.body.half_thickness:g} m is too thin for a grid of {self.bed.spacing:g} m: "
                "soil would pass through; use a smaller bed.spacing (at most half the thickness is good)"
            )

    def _check_inside(self, what: str, remedy: str) -> None:
        """The part of the body that is below the surface must stay within the bin."""
        lx, ly, lz = self.bed.size
        # Nothing is in the way of a body at the sides of a channel, whose walls stand for more of the same soil.
        side = math.inf if self.bed.walls.kinds[1] in ("slip", "periodic") else 0.0
        outline = self.body.outline()
        rows, times = self.path_times(), self.times()
        times = np.union1d(times, rows[(rows > 0.0) & (rows < times[-1])])
        for time, pose in zip(times, self.poses_at(times), strict=True):
            points = rotate(pose[3:], outline) + pose[:3]
            below = points[:, 2] < 0.0
            for axis, low, high, name in (
                (0, 0.0, lx, "x"),
                (1, -side, ly + side, "y"),
                (2, -lz, math.inf, "z"),
            ):
                outside = below & ((points[:, axis] < low) | (points[:, axis] > high))
                if outside.any():
                    limits = f"{low:g} to {high:g} m" if math.isfinite(high) else f"at least {low:g} m"
                    raise SceneError(
                        f"{what} leaves the bin at {time:.3f} s: {name} = {points[outside, axis][0]:.4f} m, "
                        f"allowed {limits} below the surface; {remedy}"
                    )


Scene.kinds["bed"] = Scene


def _build(
    cls: type, data: dict[str, Any], where: str, mesh: tuple[np.ndarray, np.ndarray] | None = None
) -> Any:
    """A dataclass from nested plain data, refusing keys it does not have; `mesh` goes to a body that is one."""
    if not isinstance(data, dict):
        raise SceneError(f"{where} is {data!r}; it must be a group of keys")
    hints = get_type_hints(cls)
    allowed = {f.name: f for f in fields(cls)}
    unknown = sorted(set(data) - set(allowed))
    if unknown:
        raise SceneError(f"{where} has no key {unknown[0]!r}; allowed: {', '.join(sorted(allowed))}")
    values = {}
    for key, value in data.items():
        if is_dataclass(hints[key]):
            value = _build(hints[key], value, f"{where}.{key}")
        elif shapes := {c.shape: c for c in get_args(hints[key]) if is_dataclass(c)}:
            value = _build(_chosen(shapes, value, f"{where}.{key}"), value, f"{where}.{key}", mesh)
        elif hints[key] is float or (hints[key] == float | None and value is not None):
            value = _number(value, f"{where}.{key}", float)
        elif hints[key] is bool and not isinstance(value, bool):
            raise SceneError(f"{where}.{key} is {value!r}; allowed: true, false")
        elif hints[key] is int:
            value = _number(value, f"{where}.{key}", int)
        else:
            value = _plain(value, hints[key], f"{where}.{key}")
        values[key] = value
    return cls(**values) if mesh is None or cls is not MeshBody else MeshBody.of_mesh(*mesh, **values)


def _chosen(shapes: dict[str, type], value: Any, where: str) -> type:
    """The class of a body given as nested data with the key `shape`."""
    shape = value.get("shape") if isinstance(value, dict) else None
    if not isinstance(shape, str) or shape not in shapes:
        raise SceneError(f"{where}.shape is {shape!r}; allowed: {', '.join(shapes)}")
    return shapes[shape]


def _plain(value: Any, hint: Any, where: str) -> Any:
    """A value of a type made of texts, numbers, tuples and None; other types are not looked into."""
    parts = get_args(hint)
    if get_origin(hint) is UnionType:
        kinds = [part for part in parts if part is not type(None)]
        if value is None and len(kinds) < len(parts):
            return None
        if str in kinds and float in kinds:  # words, or the number that one of them stands for
            return value if isinstance(value, str) else _number(value, where, float)
        return _plain(value, kinds[0], where)
    if hint is str and not isinstance(value, str):
        raise SceneError(f"{where} is {value!r}; it must be text")
    if hint in (int, float):
        return _number(value, where, hint)
    if get_origin(hint) is tuple:
        count = None if parts[-1] is ... else len(parts)
        if not isinstance(value, (list, tuple)) or count not in (None, len(value)):
            raise SceneError(f"{where} is {value!r}; it must be a list of {count or 'some'} values")
        if get_origin(parts[0]) is tuple:  # the rows of a path; what reads them says which one is wrong
            return tuple(tuple(one) if isinstance(one, list) else one for one in value)
        return tuple(_plain(one, parts[0], f"{where}[{i}]") for i, one in enumerate(value))
    return value


def _number(value: Any, where: str, kind: type) -> Any:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise SceneError(f"{where} is {value!r}; it must be a finite number")
    if kind is int and value != int(value):
        raise SceneError(f"{where} is {value!r}; it must be a whole number")
    return kind(value)
