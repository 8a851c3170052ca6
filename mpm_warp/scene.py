"""What is to be simulated: plain data, checked, without physics."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property
from typing import Any

import numpy as np

from .arrangement import ARRANGEMENTS, arrange
from .bodies import Plate
from .errors import SceneError
from .material import Material
from .motion import MOTIONS, curved, ramp, sampled_poses
from .rotation import about_y, rotate

__all__ = ["Bed", "Excavation", "Scene"]

INITIAL_STRESSES = ("geostatic", "none")


@dataclass(frozen=True)
class Bed:
    """The soil bin and how it is filled. z = 0 is the undisturbed surface."""

    size: tuple[float, float, float] = (0.80, 0.60, 0.15)
    """Lx, Ly, Lz [m]."""
    spacing: float = 0.8 / 60
    """Grid spacing dx [m]."""
    particles_per_cell: float = 1.0
    """Particles per grid cell of a full bed."""
    arrangement: str = "lattice"
    """lattice | jittered | poisson (arrangement.py)."""
    seed: int = 0
    """Of the random arrangements."""
    initial_stress: str = "geostatic"
    """geostatic: isotropic pressure rho g depth; none: stress-free, settles in the first frames."""
    headroom: float = 0.25
    """Height above the surface up to which soil may be thrown or piled [m]."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "size", tuple(float(s) for s in self.size))
        if len(self.size) != 3 or not all(math.isfinite(s) and s > 0 for s in self.size):
            raise SceneError(f"bed.size is {self.size}; it needs three lengths above 0 m")
        if not (math.isfinite(self.spacing) and 0 < self.spacing <= min(self.size) / 2):
            raise SceneError(
                f"bed.spacing is {self.spacing} m; allowed: above 0, at most half the bin's smallest side"
            )
        if not 0 < self.particles_per_cell <= 64:
            raise SceneError(
                f"bed.particles_per_cell is {self.particles_per_cell}; allowed: above 0, at most 64"
            )
        cells = np.prod(self.size) / self.spacing**3
        if cells * self.particles_per_cell > 2e7:
            raise SceneError(
                f"the bed would hold {cells * self.particles_per_cell:.2g} particles; at most 2e7 are allowed: "
                "use a larger bed.spacing"
            )
        if self.arrangement not in ARRANGEMENTS:
            raise SceneError(f"bed.arrangement is {self.arrangement!r}; allowed: {', '.join(ARRANGEMENTS)}")
        if self.initial_stress not in INITIAL_STRESSES:
            raise SceneError(
                f"bed.initial_stress is {self.initial_stress!r}; allowed: {', '.join(INITIAL_STRESSES)}"
            )
        if not self.headroom > 0:
            raise SceneError(f"bed.headroom is {self.headroom} m; it must be above 0")

    @cached_property
    def filled(self) -> tuple[np.ndarray, float]:
        """Particle positions (n, 3) [m] and the volume of one [m^3]."""
        return arrange(
            self.arrangement, self.size, self.spacing / self.particles_per_cell ** (1.0 / 3.0), self.seed
        )

    @property
    def arrangement_hash(self) -> str:
        """Same for every run whose particles start at the same places in the same order."""
        key = [self.size, self.spacing, self.particles_per_cell, self.arrangement]
        if self.arrangement != "lattice":
            key.append(self.seed)
        return hashlib.blake2b(json.dumps(key).encode(), digest_size=8).hexdigest()


@dataclass(frozen=True)
class Scene:
    """A soil bed, gravity, and for how long; subclasses add the body and its motion."""

    name: str = "bed"
    kind: str = "bed"
    bed: Bed = field(default_factory=Bed)
    material: Material = field(default_factory=Material)
    gravity: float = 9.81
    """[m/s^2], downwards."""
    duration: float = 16.0 / 3.0
    """[s]."""
    frame_rate: float = 60.0
    """Recorded frames per second [Hz]."""
    contact_margin: float = -0.5
    """Distance from the body's surface at which it begins to act on particles [grid spacings]; see contact.py."""
    courant: float = 0.6
    """Time step as a share of spacing / wave speed."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.gravity) and self.gravity >= 0):
            raise SceneError(f"scene.gravity is {self.gravity} m/s^2; it must be 0 or more")
        if not (math.isfinite(self.frame_rate) and self.frame_rate > 0):
            raise SceneError(f"scene.frame_rate is {self.frame_rate} Hz; it must be above 0")
        if not (math.isfinite(self.duration) and self.duration * self.frame_rate >= 1.0):
            raise SceneError(f"scene.duration is {self.duration} s; it must last at least one frame")
        if not -1.0 <= self.contact_margin <= 1.0:
            raise SceneError(f"scene.contact_margin is {self.contact_margin} grid spacings; allowed: -1 to 1")
        if not 0.0 < self.courant <= 1.0:
            raise SceneError(f"scene.courant is {self.courant}; allowed: above 0, at most 1")

    # --- what a solver or a rollout asks of a scene -------------------------------------------------------

    @property
    def plate(self) -> Plate | None:
        """The body that moves through the soil, if any."""
        return None

    @property
    def frame_count(self) -> int:
        """T, with the initial state as frame 0."""
        return round(self.duration * self.frame_rate) + 1

    def times(self) -> np.ndarray:
        """Times of the frames [s], shape (T,)."""
        return np.arange(self.frame_count) / self.frame_rate

    def poses_at(self, time: np.ndarray) -> np.ndarray:
        """Pose of the body at any times [s]: centre of mass [m] and quaternion x, y, z, w; shape (T, 7)."""
        return np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (len(np.atleast_1d(time)), 1))

    def body_poses(self) -> np.ndarray:
        """Poses at the frames, shape (T, 7)."""
        return self.poses_at(self.times())

    def body_points(self) -> np.ndarray:
        """Body nodes in the body frame [m], shape (M, 3)."""
        return np.zeros((0, 3))

    def initial_positions(self) -> np.ndarray:
        """Soil at time 0 [m], shape (n, 3), float64."""
        return self.bed.filled[0]

    @property
    def arrangement_hash(self) -> str:
        """See `Bed.arrangement_hash`."""
        return self.bed.arrangement_hash

    def warnings(self) -> list[str]:
        """What a user should know about this scene before it runs."""
        return self.material.warnings()

    def to_dict(self) -> dict[str, Any]:
        """Everything that defines the scene, as plain nested data."""
        return json.loads(json.dumps(asdict(self)))

    @staticmethod
    def from_dict(data: dict[str, Any]) -> Scene:
        """The scene described by plain nested data, checked."""
        kinds = {"bed": Scene, "excavation": Excavation}
        kind = data.get("kind", "bed")
        if kind not in kinds:
            raise SceneError(f"scene.kind is {kind!r}; allowed: {', '.join(kinds)}")
        return _build(kinds[kind], data, "scene")


@dataclass(frozen=True)
class Excavation(Scene):
    """A plate cuts through the bed along x."""

    name: str = "excavation"
    kind: str = "excavation"
    blade: Plate = field(default_factory=Plate)
    depth: float = 0.05
    """Depth the motion law reaches below the tip's starting height [m]."""
    speed: float = 0.10
    """Forward speed of the cut [m/s]."""
    rake: float = 10.0
    """Angle of the plate from vertical, tip leading [degrees]."""
    motion: str = "curved"
    """curved | ramp | rest | path."""
    start: float = 0.10
    """Where the tip starts, as a share of the bin's length."""
    clearance: float = 0.00665
    """Height of the tip above the surface at the start [m]; the cut is this much shallower than `depth`."""
    path: tuple[tuple[float, ...], ...] | None = None
    """For motion=path: rows t [s], x, y, z [m], qx, qy, qz, qw of the plate's centre of mass."""
    body_grid: tuple[int, int] = (3, 5)
    """Rows and columns of body nodes on the front face."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.motion not in MOTIONS:
            raise SceneError(f"scene.motion is {self.motion!r}; allowed: {', '.join(MOTIONS)}")
        if self.motion == "path":
            if self.path is None:
                raise SceneError(
                    "scene.motion=path needs scene.path, a CSV file with columns t,x,y,z,qx,qy,qz,qw"
                )
            object.__setattr__(self, "path", tuple(tuple(float(v) for v in row) for row in self.path))
        elif self.path is not None:
            raise SceneError(
                f"scene.path is given but scene.motion is {self.motion!r}; use scene.motion=path"
            )
        if not (math.isfinite(self.depth) and self.depth >= 0):
            raise SceneError(f"scene.depth is {self.depth} m; it must be 0 or more")
        if not (math.isfinite(self.speed) and self.speed > 0):
            raise SceneError(f"scene.speed is {self.speed} m/s; it must be above 0")
        if not -60.0 <= self.rake <= 60.0:
            raise SceneError(f"scene.rake is {self.rake} degrees; allowed: -60 to 60")
        if not 0.0 <= self.start <= 1.0:
            raise SceneError(f"scene.start is {self.start}; allowed: 0 to 1, a share of the bin's length")
        core = self.blade.half_size.min() + self.contact_margin * self.bed.spacing
        if core < 0.1 * self.bed.spacing:
            raise SceneError(
                f"blade.thickness of {self.blade.thickness} m is too thin for a grid of {self.bed.spacing:g} m: "
                "soil would pass through; use a smaller bed.spacing (at most half the thickness is good)"
            )
        object.__setattr__(self, "body_grid", tuple(int(c) for c in self.body_grid))
        if len(self.body_grid) != 2 or not all(1 <= c <= 100 for c in self.body_grid):
            raise SceneError(f"scene.body_grid is {self.body_grid}; it needs two counts from 1 to 100")
        self._check_inside()

    @property
    def plate(self) -> Plate:
        return self.blade

    def poses_at(self, time: np.ndarray) -> np.ndarray:
        time = np.atleast_1d(np.asarray(time, dtype=float))
        if self.motion == "path":
            return sampled_poses(np.asarray(self.path), time)
        rotation = about_y(-math.radians(self.rake))
        lx, ly, _ = self.bed.size
        start = np.array([self.start * lx, 0.5 * ly, self.clearance]) - rotate(rotation, self.blade.tip)
        law = {"curved": curved, "ramp": ramp, "rest": lambda t, *_: np.zeros((len(t), 2))}[self.motion]
        moved = law(time, self.depth, self.speed)
        poses = np.empty((len(time), 7))
        poses[:, :3] = start
        poses[:, [0, 2]] += moved
        poses[:, 3:] = rotation
        return poses

    def body_points(self) -> np.ndarray:
        return self.blade.points(*self.body_grid)

    def warnings(self) -> list[str]:
        found = super().warnings()
        if self.blade.thickness < 2.0 * self.bed.spacing:
            found.append(
                f"the plate is {self.blade.thickness / self.bed.spacing:.1f} grid spacings thick; below 2 the soil "
                "behind it feels the soil in front of it"
            )
        return found

    def _check_inside(self) -> None:
        """The part of the plate that is below the surface must stay within the bin."""
        time = self.times()
        poses = self.poses_at(time)
        points = rotate(poses[:, None, 3:], _edge_samples(self.blade)[None]) + poses[:, None, :3]
        lx, ly, lz = self.bed.size
        below = points[..., 2] < 0.0
        for axis, low, high, name in ((0, 0.0, lx, "x"), (1, 0.0, ly, "y"), (2, -lz, math.inf, "z")):
            outside = below & ((points[..., axis] < low) | (points[..., axis] > high))
            if outside.any():
                frame, point = np.argwhere(outside)[0]
                limits = f"{low:g} to {high:g} m" if math.isfinite(high) else f"at least {low:g} m"
                raise SceneError(
                    f"the plate leaves the bin at {time[frame]:.3f} s: {name} = {points[frame, point, axis]:.4f} m, "
                    f"allowed {limits} below the surface; change scene.depth, speed, start, duration or the path"
                )


def _edge_samples(plate: Plate, count: int = 9) -> np.ndarray:
    """Points along the plate's four long edges and corners, body frame [m]: where it can touch a wall."""
    hx, hy, hz = plate.half_size
    return np.array(
        [[sx * hx, sy * hy, z] for sx in (-1, 1) for sy in (-1, 1) for z in np.linspace(-hz, hz, count)]
    )


def _build(cls: type, data: dict[str, Any], where: str) -> Any:
    """A dataclass from nested plain data, refusing keys it does not have."""
    if not isinstance(data, dict):
        raise SceneError(f"{where} is {data!r}; it must be a group of keys")
    nested = {"bed": Bed, "material": Material, "blade": Plate}
    allowed = {f.name: f for f in fields(cls)}
    unknown = sorted(set(data) - set(allowed))
    if unknown:
        raise SceneError(f"{where} has no key {unknown[0]!r}; allowed: {', '.join(sorted(allowed))}")
    values = {}
    for key, value in data.items():
        if key in nested:
            value = _build(nested[key], value, f"{where}.{key}")
        elif allowed[key].type == "float" or (allowed[key].type == "float | None" and value is not None):
            value = _number(value, f"{where}.{key}", float)
        elif allowed[key].type == "int":
            value = _number(value, f"{where}.{key}", int)
        elif isinstance(value, list):
            value = tuple(tuple(v) if isinstance(v, list) else v for v in value)
        values[key] = value
    return cls(**values)


def _number(value: Any, where: str, kind: type) -> Any:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise SceneError(f"{where} is {value!r}; it must be a finite number")
    if kind is int and value != int(value):
        raise SceneError(f"{where} is {value!r}; it must be a whole number")
    return kind(value)
