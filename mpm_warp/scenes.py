"""The kinds of scenes: a cut, any tool along a path, a wheel, a column, a slope."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from .bodies import Axle, Body, Box, Cylinder, MeshBody, Plate
from .poses import about_y, rotate, sampled_poses
from .ranges import BODY_MASS
from .scene import Scene
from .state import SceneError

# --- Prescribed paths of a blade's tip and of a body given by samples -----------------------------------

MOTIONS = ("curved", "ramp", "rest", "path")
CUT_LENGTH = 0.4
"""Horizontal travel of the published cuts [m]."""
RAMP_SPEED = 0.025
"""Speed of both components while the published ramp motion goes down and comes up [m/s]."""
_CURVE_END = 0.95  # the published curved motion stops at this share of its period


def cut_time(speed: float) -> float:
    """Time of a cut of 0.4 m [s]; the published scripts round 0.4 / 0.15 to 2.6 s."""
    return 2.6 if abs(speed - 0.15) < 1e-9 else CUT_LENGTH / speed


def curved(time: np.ndarray, depth: float, speed: float) -> np.ndarray:
    """Displacement (dx, dz) of the tip on the published curved motion, shape (T, 2) [m].

    z falls along half an ellipse of depth `depth` [m] while x advances at `speed` [m/s]; both stop at 95 %
    of the period. The slope at the start is infinite.
    """
    period = cut_time(speed)
    t = np.clip(time, 0.0, _CURVE_END * period)
    return np.stack([speed * t, -(2.0 * depth / period) * np.sqrt(t * (period - t))], axis=-1)


def ramp(time: np.ndarray, depth: float, speed: float) -> np.ndarray:
    """Displacement (dx, dz) of the tip on the published ramp-horizontal-ramp motion, shape (T, 2) [m].

    Down at 45 degrees (2.5 cm/s each way) to `depth` [m], along x at `speed` [m/s], up at 45 degrees to the
    starting height, then rest.
    """
    down = depth / RAMP_SPEED
    across = cut_time(speed)
    first = np.clip(time, 0.0, down)
    second = np.clip(time - down, 0.0, across)
    third = np.clip(time - down - across, 0.0, down)
    return np.stack([RAMP_SPEED * (first + third) + speed * second, RAMP_SPEED * (third - first)], axis=-1)


# --- A plate cuts through a bed -------------------------------------------------------------------------


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
        self._check_thickness("blade.thickness")
        object.__setattr__(self, "body_grid", tuple(int(c) for c in self.body_grid))
        if len(self.body_grid) != 2 or not all(1 <= c <= 100 for c in self.body_grid):
            raise SceneError(f"scene.body_grid is {self.body_grid}; it needs two counts from 1 to 100")
        self._check_inside("the plate", "change scene.depth, speed, start, duration or the path")

    @property
    def body(self) -> Plate:
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

    def path_times(self) -> np.ndarray:
        return np.array([row[0] for row in self.path or ()])

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

    def summary(self, force: np.ndarray, torque: np.ndarray, poses: np.ndarray) -> str:
        return f"mean draft {-np.mean(force[1:, 0]):.1f} N, vertical force {np.mean(force[1:, 2]):.1f} N"


# --- Any body along a path ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Push(Scene):
    """A box, a cylinder or a mesh moves through the bed along a path of its centre of mass."""

    name: str = "body"
    kind: str = "body"
    tool: Box | Cylinder | MeshBody = field(default_factory=Box)
    path: tuple[tuple[float, ...], ...] | None = None
    """Rows t [s], x, y, z [m], qx, qy, qz, qw of the body's centre of mass."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.path is None:
            raise SceneError("scene.path is missing: a CSV file with columns t,x,y,z,qx,qy,qz,qw")
        object.__setattr__(self, "path", tuple(tuple(float(v) for v in row) for row in self.path))
        self._check_thickness("a body")
        self._check_inside("the body", "change scene.path or scene.duration")

    @property
    def body(self) -> Body:
        return self.tool

    def poses_at(self, time: np.ndarray) -> np.ndarray:
        return sampled_poses(np.asarray(self.path), np.atleast_1d(np.asarray(time, dtype=float)))

    def path_times(self) -> np.ndarray:
        return np.array([row[0] for row in self.path])

    def body_points(self) -> np.ndarray:
        return self.tool.points()

    def summary(self, force: np.ndarray, torque: np.ndarray, poses: np.ndarray) -> str:
        x, y, z = force[1:].mean(axis=0)
        return f"mean force ({x:.1f}, {y:.1f}, {z:.1f}) N"


# --- A wheel drives over a bed under a load -------------------------------------------------------------


@dataclass(frozen=True)
class Wheel(Scene):
    """A wheel settles under its load, then drives along x with a given slip.

    Forward motion and rotation are prescribed: both are zero during the first `settle` seconds and constant
    afterwards. The height is free. The mass is load / gravity, so that the weight is the load.
    """

    name: str = "wheel"
    kind: str = "wheel"
    contact_margin: float = 0.0
    duration: float = 1.0 + 16.0 / 3.0
    """Settling and driving [s]."""
    load: float = 100.0
    """Weight that the wheel carries, its own included [N]."""
    diameter: float = 0.15
    """Of the rim, without grousers [m]."""
    width: float = 0.083
    """[m]."""
    friction: float = 0.5
    """Coulomb friction between soil and wheel [-]."""
    grousers: int = 0
    """How many bars along the rim."""
    grouser_height: float = 0.0
    """Above the rim [m]."""
    grouser_thickness: float = 0.0
    """Along the rim [m]."""
    slip: float = 0.2
    """1 - forward speed / rim speed [-]."""
    rim_speed: float = 0.0195
    """Angular speed times half the diameter [m/s]."""
    friction_angle: float | None = None
    """In place of material.friction_angle [degrees]; None: the material's own."""
    settle: float = 1.0
    """Time at rest under the load before driving [s]; recorded like the rest."""
    damping: float = 0.0
    """Force against the vertical velocity per mass of the wheel [1/s]."""
    bilateral: bool = False
    """Whether soil in contact may not leave the wheel along its normal (bilateral contact)."""
    start: float = 0.30
    """Where the axle starts, as a share of the bin's length."""
    clearance: float = 0.0
    """Height of the wheel's lowest point above the undisturbed surface at the start [m]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, unit in (("load", "N"), ("rim_speed", "m/s"), ("gravity", "m/s^2")):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise SceneError(f"scene.{name} is {value} {unit}; a wheel needs more than 0")
        if not BODY_MASS[0] <= self.load / self.gravity <= BODY_MASS[1]:
            raise SceneError(
                f"scene.load is {self.load} N at scene.gravity {self.gravity} m/s^2: a wheel of "
                f"{self.load / self.gravity:.3g} kg; allowed: {BODY_MASS[0]:g} to {BODY_MASS[1]:g} kg"
            )
        if not -1.0 <= self.slip <= 1.0:
            raise SceneError(
                f"scene.slip is {self.slip}; allowed: -1 to 1 (0: rolls freely, 1: turns on the spot)"
            )
        if not 0.0 <= self.settle < self.duration:
            raise SceneError(
                f"scene.settle is {self.settle} s; allowed: 0 up to, not including, scene.duration ({self.duration} s)"
            )
        if not (math.isfinite(self.damping) and self.damping >= 0):
            raise SceneError(f"scene.damping is {self.damping} 1/s; it must be 0 or more")
        if not 0.0 <= self.start <= 1.0:
            raise SceneError(f"scene.start is {self.start}; allowed: 0 to 1, a share of the bin's length")
        try:
            _ = self.body
        except SceneError as error:
            raise SceneError(str(error).replace("tool.", "scene.")) from None
        if self.friction_angle is not None:
            material = replace(self.material, friction_angle=self.friction_angle)
            object.__setattr__(self, "material", material)
        self._check_thickness("a wheel's width")
        self._check_fits()

    @cached_property
    def body(self) -> Cylinder:
        """The wheel; its axis is y and its centre of mass the middle of the axle."""
        return Cylinder(
            diameter=self.diameter,
            width=self.width,
            friction=self.friction,
            grousers=self.grousers,
            grouser_height=self.grouser_height,
            grouser_thickness=self.grouser_thickness,
        )

    @property
    def axle(self) -> Axle:
        return Axle(self.load / self.gravity, self.damping)

    @property
    def speed(self) -> float:
        """Forward speed while driving [m/s]."""
        return self.rim_speed * (1.0 - self.slip)

    @property
    def angular_speed(self) -> float:
        """While driving, about +y: the rim's lowest point moves backwards past the axle [rad/s]."""
        return 2.0 * self.rim_speed / self.diameter

    def poses_at(self, time: np.ndarray) -> np.ndarray:
        driven = np.maximum(np.atleast_1d(np.asarray(time, dtype=float)) - self.settle, 0.0)
        poses = np.empty((len(driven), 7))
        poses[:, 0] = self.start * self.bed.size[0] + self.speed * driven
        poses[:, 1] = 0.5 * self.bed.size[1]
        poses[:, 2] = self.body.tip_radius + self.clearance
        poses[:, 3:] = np.array([about_y(angle) for angle in self.angular_speed * driven])
        return poses

    def travel(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # From the speeds: poses do not show a whole turn.
        driven = np.diff(np.maximum(time - self.settle, 0.0))
        return abs(self.speed) * driven, self.angular_speed * driven

    def sinkage(self, poses: np.ndarray) -> np.ndarray:
        """Depth of the wheel's lowest point below the undisturbed surface [m], shape (T,) for poses (T, 7)."""
        return self.body.tip_radius - poses[:, 2]

    def body_points(self) -> np.ndarray:
        return self.body.points()

    def warnings(self) -> list[str]:
        found = super().warnings()
        if self.grousers and self.grouser_thickness < self.bed.spacing:
            found.append(
                f"the grousers are {self.grouser_thickness / self.bed.spacing:.2f} grid spacings thick; below 1 the "
                "grid does not resolve them"
            )
        return found

    def summary(self, force: np.ndarray, torque: np.ndarray, poses: np.ndarray) -> str:
        driving = self.times()[: len(force)] > self.settle + 0.5 / self.frame_rate
        pull, _, vertical = force[driving].mean(axis=0)
        return (
            f"while driving: mean drawbar pull {pull:.2f} N, vertical force {vertical:.2f} N, "
            f"sinkage {1000.0 * self.sinkage(poses)[driving].mean():.1f} mm, "
            f"torque {torque[driving, 1].mean():.3f} N m"
        )

    def _check_fits(self) -> None:
        """The axle stays over the bin and the rims between its side walls, whatever the height."""
        lx, ly, _ = self.bed.size
        if self.width >= ly:
            raise SceneError(f"scene.width is {self.width} m; the bin is only {ly:g} m wide")
        first, last = self.poses_at(self.times()[[0, -1]])[:, 0]
        if min(first, last) < 0.0 or max(first, last) > lx:
            raise SceneError(
                f"the axle moves from x = {first:.3f} to {last:.3f} m; allowed: 0 to {lx:g} m; change scene.start, "
                "slip, rim_speed or duration"
            )
        if not -self.bed.size[2] < self.clearance < self.bed.headroom:
            raise SceneError(
                f"scene.clearance is {self.clearance} m; allowed: above the floor ({-self.bed.size[2]:g} m) and below "
                f"bed.headroom ({self.bed.headroom:g} m)"
            )


# --- A column of soil that is let go and collapses under its own weight ---------------------------------

SHAPES = ("cylinder", "slab")


@dataclass(frozen=True)
class Column(Scene):
    """Soil stands in the middle of the floor and is let go at time 0; the bed's Lz is its height."""

    name: str = "column"
    kind: str = "column"
    shape: str = "cylinder"
    """cylinder, or slab: all of the bin's width, for a channel."""
    radius: float = 0.05
    """Of the cylinder, or half the slab's length along x [m]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.shape not in SHAPES:
            raise SceneError(f"scene.shape is {self.shape!r}; allowed: {', '.join(SHAPES)}")
        room = 0.5 * min(self.bed.size[: 2 if self.shape == "cylinder" else 1])
        if not 2.0 * self.bed.spacing <= self.radius <= room:
            raise SceneError(
                f"scene.radius is {self.radius} m; allowed: two grid spacings ({2.0 * self.bed.spacing:g} m) up to "
                f"half the bin ({room:g} m)"
            )

    @property
    def aspect_ratio(self) -> float:
        """Height over radius [-]."""
        return self.bed.size[2] / self.radius

    @cached_property
    def filled(self) -> tuple[np.ndarray, float]:
        positions, volume = self.bed.filled
        off = positions[:, :2] - 0.5 * np.asarray(self.bed.size[:2])
        distance = np.abs(off[:, 0]) if self.shape == "slab" else np.hypot(off[:, 0], off[:, 1])
        return positions[distance <= self.radius], volume

    @property
    def soil_volume(self) -> float:
        _, width, height = self.bed.size
        across = math.pi * self.radius**2 if self.shape == "cylinder" else 2.0 * self.radius * width
        return across * height

    @property
    def arrangement_hash(self) -> str:
        key = [self.bed.arrangement_hash, self.shape, self.radius]
        return hashlib.blake2b(json.dumps(key).encode(), digest_size=8).hexdigest()


# --- A layer of soil on an endless rough slope ----------------------------------------------------------


@dataclass(frozen=True)
class Incline(Scene):
    """A layer as thick as the bed, tilted; meant for a bed that is periodic in x."""

    name: str = "incline"
    kind: str = "incline"
    flowing: bool = True
    """Start in the steady flow of mu(I) down the slope (Bagnold's profile); off: start at rest."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.flowing, bool):
            raise SceneError(f"scene.flowing is {self.flowing!r}; allowed: true, false")
        if self.flowing and not self._flows:
            low, high = self._flowing_angles
            raise SceneError(
                f"scene.tilt is {self.tilt} degrees; this soil flows steadily between {low:.2f} and {high:.2f} "
                "degrees: choose such a tilt or start at rest with scene.flowing=false"
            )

    @property
    def _flowing_angles(self) -> tuple[float, float]:
        """Slopes at which the soil flows without stopping or accelerating for ever [degrees]."""
        friction = (self.material.static_friction, self.material.limit_friction)
        return tuple(math.degrees(math.atan(mu)) for mu in friction)

    @property
    def _flows(self) -> bool:
        low, high = self._flowing_angles
        return low < self.tilt < high

    @property
    def inertial_number(self) -> float:
        """I of the steady flow, the same at every depth [-]."""
        if not self._flows:
            return 0.0
        soil, slope = self.material, math.tan(math.radians(self.tilt))
        return soil.reference_inertial_number * (slope - soil.static_friction) / (soil.limit_friction - slope)

    def steady_velocity(self, height: np.ndarray) -> np.ndarray:
        """Speed down the slope of the steady flow at heights above the base [m], in [m/s] (Bagnold's profile)."""
        soil, thickness = self.material, self.bed.size[2]
        fall = self.gravity * math.cos(math.radians(self.tilt))
        scale = 2.0 * self.inertial_number / (3.0 * soil.grain_diameter) * math.sqrt(soil.packing * fall)
        return scale * (thickness**1.5 - np.clip(thickness - height, 0.0, thickness) ** 1.5)

    def initial_velocities(self) -> np.ndarray:
        velocities = super().initial_velocities()
        if self.flowing:
            velocities[:, 0] = self.steady_velocity(self.filled[0][:, 2] + self.bed.size[2])
        return velocities
