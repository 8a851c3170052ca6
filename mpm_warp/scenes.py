"""The kinds of scenes: a cut, any tool along a path, a wheel, a column, a slope."""

from __future__ import annotations

import math
from dataclasses import field, fields, replace
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np

from .bed import Bed, Walls, digest
from .bodies import Axle, Box, Cylinder, MeshBody, Plate, Tool
from .kernels.signed_distance import thin_walls
from .material import Material
from .motions import Passes, along_and_across, as_loads, curved, ramp, sinkage, tip_poses
from .poses import about_y, about_z_y
from .scene import Scene
from .settings import odd_size, same, setting, settings
from .state import SceneError

_PATH = "rows t [s], x, y, z [m], qx, qy, qz, qw of the body's centre of mass, or of tool.origin"
_SHARE = ", a share of the bin's length"


_COARSE = 1.4
"""Thickness of a plate that a coarse grid may have without a warning, as by default [grid spacings]."""


@settings
class Excavation(Scene):
    """A plate cuts through the bed along x."""

    name: str = "excavation"
    kind: str = "excavation"
    bed: Bed = field(default_factory=lambda: Bed(spacing=0.02, particles_per_cell=4.0))
    contact_margin: float = -0.375
    blade: Plate = setting(Plate, "the plate")
    depth: float = setting(
        0.05, "the motion reaches this far below the tip's starting height", "m", ge=0, le=1e3
    )
    speed: float = setting(0.10, "forward speed", "m/s", gt=0, le=1e4)
    rake: float = setting(
        10.0, "angle of the plate from vertical, tip leading", "degrees", ge=-60, le=60, radians_below=1.0
    )
    motion: Literal["curved", "ramp", "rest", "path", "passes"] = setting("curved", "of the tip")
    passes: Passes = setting(Passes, "for motion=passes: how many, how long and where")
    start: float = setting(0.10, "where the tip starts" + _SHARE, ge=0, le=1, note=_SHARE)
    clearance: float = setting(
        0.00665, "height of the tip above the surface at the start", "m", ge=-1e3, le=1e3
    )
    path: tuple[Any, ...] | None = setting(None, "for motion=path: " + _PATH)
    contact: Literal["particles", "nodes"] = setting(  # type: ignore[misc]  # a kind of scene makes it a setting
        "particles",
        "what of the soil the plate stops; nodes: as in the paper's solver, only to compare with it",
    )
    body_grid: tuple[int, int] = setting(
        (3, 5),
        "rows and columns of body nodes on the front face",
        ge=1,
        le=100,
        words="; it needs two counts from 1 to 100",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.motion == "path":
            if self.path is None:
                raise SceneError(
                    "scene.motion=path needs scene.path, a CSV file with columns t,x,y,z,qx,qy,qz,qw"
                )
        elif self.path is not None:
            raise SceneError(
                f"scene.path is given but scene.motion is {self.motion!r}; use scene.motion=path"
            )
        if self.contact == "nodes" and self.blade.edge != "square":
            raise SceneError(
                f"scene.contact is 'nodes' and blade.edge {self.blade.edge!r}; it is for a square end: set "
                "scene.blade.edge=square"
            )
        self._check_thickness(self.body, "blade.thickness")
        remedy = "change scene.depth, speed, start, duration, path or passes"
        if self.depth > max(self.bed.size):
            remedy = f"scene.depth is {self.depth:g} m; lengths are in metres"
        self._check_inside(self.body, "the plate", remedy)

    @cached_property
    def body(self) -> Plate:
        rotation = about_y(-math.radians(self.rake)) if self.path is None else np.array(self.path[0][4:])
        return self.blade.level_at(rotation)

    def poses_at(self, time: np.ndarray) -> np.ndarray:
        if self.motion == "path":
            return super().poses_at(time)
        time = np.atleast_1d(np.asarray(time, dtype=float))
        lx, ly, _ = self.bed.size
        moved = np.zeros((len(time), 2))
        if self.motion != "rest":
            laws = {"curved": curved, "ramp": ramp, "passes": self.passes.displacement}
            moved = laws[self.motion](time, self.depth, self.speed)
        return tip_poses(self.body.tip, (self.start * lx, 0.5 * ly, self.clearance), self.rake, moved)

    def path_times(self) -> np.ndarray:
        return self.passes.turns(self.depth, self.speed) if self.motion == "passes" else super().path_times()

    def body_points(self) -> np.ndarray:
        return self.body.points(*self.body_grid)

    def warnings(self) -> list[str]:
        found = super().warnings() + _unused_passes(self)
        if self.blade.thickness < _COARSE * self.bed.spacing:
            found.append(self._thickness())
        return found

    def remarks(self) -> list[str]:
        coarse = _COARSE <= self.blade.thickness / self.bed.spacing < 2.0
        return ([f"a coarse grid: {self._thickness()}"] if coarse else []) + super().remarks()

    def _thickness(self) -> str:
        return (
            f"the plate is {self.blade.thickness / self.bed.spacing:.1f} grid spacings thick; below 2 the soil behind "
            "it feels the soil in front of it"
        )

    def results(self, force: np.ndarray, torque: np.ndarray, poses: np.ndarray) -> dict[str, float]:
        return {
            "mean_draft_N": -float(np.mean(force[1:, 0])),
            "mean_vertical_force_N": float(np.mean(force[1:, 2])),
        }

    def summary(self, force: np.ndarray, torque: np.ndarray, poses: np.ndarray) -> str:
        draft, vertical = self.results(force, torque, poses).values()
        return f"mean draft {draft:.1f} N, vertical force {vertical:.1f} N" + _each_pass(self, force)


def _unused_passes(scene: Excavation | Body) -> list[str]:
    if scene.motion == "passes" or scene.passes == Passes():
        return []
    return [
        f"scene.passes is not used: scene.motion is {scene.motion!r}; scene.motion=passes makes several cuts"
    ]


def _each_pass(scene: Excavation | Body, force: np.ndarray) -> str:
    """The mean draft of each pass, or how far they got, from the soil's force on the tool [N], shape (T, 3)."""
    if scene.motion != "passes":
        return ""
    times = scene.times()[: len(force)]
    cut = scene.passes.cutting(times, scene.depth, scene.speed)
    unfinished = scene.passes.cutting(times[-1:] + 1.0 / scene.frame_rate, scene.depth, scene.speed)[0]
    each = []
    for one in range(scene.passes.number):
        now = cut == one
        if not force[now].any():
            each.append("not reached")
        else:
            each.append(f"{-force[now, 0].mean():.1f} N" + (" (cut short)" if one == unfinished else ""))
    return "; mean draft of each pass: " + ", ".join(each)


@settings
class Body(Scene):
    """A box, a cylinder or a mesh moves through the bed along a path of its centre of mass, or of its `origin`."""

    name: str = "body"
    kind: str = "body"
    duration: float = 2.0
    tool: Box | Cylinder | MeshBody = setting(Box, "the body")
    motion: Literal["path", "passes"] = setting("path", "of the body; passes: of its tip")
    path: tuple[Any, ...] | None = setting(None, _PATH)
    passes: Passes = setting(Passes, "for motion=passes, with the five keys that follow")
    depth: float = same(Excavation, "depth")
    speed: float = same(Excavation, "speed")
    rake: float = same(Excavation, "rake", default=0.0)
    start: float = same(Excavation, "start")
    clearance: float = same(Excavation, "clearance")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.motion == "path" and self.path is None:
            raise SceneError(
                "scene.path is missing; give scene.path=..., a CSV file with columns t,x,y,z,qx,qy,qz,qw"
            )
        if self.motion == "passes" and self.path is not None:
            raise SceneError("scene.path is given but scene.motion is 'passes'; use scene.motion=path")
        if not isinstance(self.tool, MeshBody):  # whose thin walls are made to hold
            self._check_thickness(self.tool, "a body")
        remedy = "change scene.path or scene.duration"
        if self.motion == "passes":
            remedy = "change scene.start, depth, passes or duration"
        self._check_inside(self.tool, "the body", remedy)

    @property
    def body(self) -> Tool:
        return self.tool

    def poses_at(self, time: np.ndarray) -> np.ndarray:
        if self.motion == "path":
            return super().poses_at(time)
        moved = self.passes.displacement(np.atleast_1d(time), self.depth, self.speed)
        lx, ly, _ = self.bed.size
        return tip_poses(self.tool.tip, (self.start * lx, 0.5 * ly, self.clearance), self.rake, moved)

    def path_times(self) -> np.ndarray:
        return self.passes.turns(self.depth, self.speed) if self.motion == "passes" else super().path_times()

    def warnings(self) -> list[str]:
        found = super().warnings() + _unused_passes(self)
        if odd_size(self.tool, self.bed.size, self.open_sides):
            return found  # which is another matter
        return found + thin_walls(self.tool, self.contact_distance, self.bed.spacing)

    def results(self, force: np.ndarray, torque: np.ndarray, poses: np.ndarray) -> dict[str, float]:
        names = (f"mean_force_{axis}_N" for axis in "xyz")
        return dict(zip(names, force[1:].mean(axis=0).tolist(), strict=True))

    def summary(self, force: np.ndarray, torque: np.ndarray, poses: np.ndarray) -> str:
        x, y, z = self.results(force, torque, poses).values()
        return f"mean force ({x:.1f}, {y:.1f}, {z:.1f}) N" + _each_pass(self, force)


LEAST_MASS, MOST_MASS = 1.0e-9, 1.0e9
"""Of a body whose height is free [kg]."""


@settings
class Wheel(Scene):
    """A wheel settles under its load, then travels along x and rolls, skids, or is pushed sideways.

    Travel and rotation are prescribed: both are zero during the first `settle` seconds and constant afterwards. The
    height is free. The mass is load / gravity, so that the weight is the load; of a load over time, its largest.
    """

    _notes: ClassVar[tuple[str, ...]] = ()  # of settings that others go before
    name: str = "wheel"
    kind: str = "wheel"
    bed: Bed = field(
        default_factory=lambda: Bed(
            size=(0.40, 0.19, 0.06), spacing=0.01, particles_per_cell=4.0, headroom=0.10
        )
    )
    contact_margin: float = 0.0
    duration: float = 6.3333333333
    load: float | tuple[Any, ...] = setting(
        100.0,
        "weight that the wheel carries, its own included; or rows of a time [s] and the load then",
        "N",
        gt=0,
        words=" N; a wheel needs more than 0, or rows of a time [s] and the load then [N]",
    )
    diameter: float = same(Cylinder, "diameter")
    width: float = same(Cylinder, "width")
    friction: float = same(Cylinder, "friction", default=0.5)
    grousers: int = same(Cylinder, "grousers")
    grouser_height: float = same(Cylinder, "grouser_height")
    grouser_thickness: float = same(Cylinder, "grouser_thickness")
    slip: float = setting(
        0.2,
        "1 - travel / rim speed, if travel_speed is not given; then it follows: 1 - travel / rim where the rim is "
        "faster, rim / travel - 1 where it is slower",
        ge=-1,
        le=1,
        note=" (0: rolls freely, 1: turns on the spot)",
    )
    rim_speed: float = setting(
        0.0195, "angular speed times half the diameter; 0, a locked wheel, needs travel_speed", "m/s", ge=0
    )
    travel_speed: float | None = setting(None, "along x; None: rim_speed (1 - slip)", "m/s", ge=0)
    slip_angle: float = setting(
        0.0,
        "the wheel's plane is turned by it about z, out of the direction of travel; 90: pushed sideways",
        "degrees",
        ge=-90,
        le=90,
    )
    friction_angle: float | None = setting(
        37.0, "of the soil; None: material.friction_angle", "degrees", radians_below=1.6
    )
    settle: float = setting(1.0, "time at rest under the load before driving; recorded like the rest", "s")
    damping: float = setting(5.0, "force against the vertical velocity per mass of the wheel", "1/s", ge=0)
    bilateral: bool = setting(  # type: ignore[misc]  # a kind of scene makes it a setting
        False, "soil in contact may not leave the wheel along its normal"
    )
    start: float = setting(0.30, "where the axle starts" + _SHARE, ge=0, le=1, note=_SHARE)
    clearance: float = setting(
        0.0, "of the wheel's lowest point above the surface at the start", "m", ge=-1e3, le=1e3
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.gravity > 0:
            raise SceneError(f"scene.gravity is {self.gravity} m/s^2; a wheel needs more than 0")
        if isinstance(self.load, tuple):
            object.__setattr__(self, "load", as_loads(self.load))
        notes: list[str] = []
        mass = self.axle.mass
        if not LEAST_MASS <= mass <= MOST_MASS:
            raise SceneError(
                f"scene.load is {mass * self.gravity:g} N at scene.gravity {self.gravity} m/s^2: a wheel of "
                f"{mass:.3g} kg; allowed: {LEAST_MASS:g} to {MOST_MASS:g} kg"
            )
        if self.travel_speed is not None:
            slow, fast = sorted((self.rim_speed, self.travel_speed))
            slip = 1.0 - slow / fast if fast > 0.0 else 0.0
            slip = -slip if self.travel_speed > self.rim_speed else slip
            if self.slip not in (type(self).slip, slip):
                wanted = self.travel_speed / (1.0 - self.slip) if 0.0 <= self.slip < 1.0 else None
                wanted = self.travel_speed * (1.0 + self.slip) if self.slip < 0.0 else wanted
                notes.append(
                    f"scene.slip {self.slip:g} is not used: travel_speed and rim_speed make it {slip:.3g}"
                    + (f"; scene.rim_speed={wanted:.4g} makes it {self.slip:g}" if wanted else "")
                )
            object.__setattr__(self, "slip", slip)
        elif self.rim_speed == 0.0:
            raise SceneError(
                "scene.rim_speed is 0.0 m/s; a wheel needs more than 0, or scene.travel_speed if it is locked"
            )
        if not 0.0 <= self.settle < self.duration:
            raise SceneError(
                f"scene.settle is {self.settle} s; allowed: 0 up to, not including, scene.duration ({self.duration} s)"
            )
        try:
            _ = self.body
        except SceneError as error:
            raise SceneError(str(error).replace("tool.", "scene.")) from None
        if self.friction_angle is not None:
            other, static = self.material.friction_angle, self.material.static_friction
            if other not in (None, self.friction_angle):
                static = Material.static_friction  # what is there follows from the other angle
                notes.append(
                    f"material.friction_angle {other:g} is not used: scene.friction_angle {self.friction_angle:g} goes "
                    "before it; set scene.friction_angle=null to use it"
                )
            material = replace(self.material, friction_angle=self.friction_angle, static_friction=static)
            object.__setattr__(self, "material", material)
        object.__setattr__(self, "_notes", tuple(notes))
        self._check_thickness(self.body, "a wheel's width")
        self._check_fits()

    @cached_property
    def body(self) -> Cylinder:
        """The wheel; its axis is y and its centre of mass the middle of the axle."""
        return Cylinder(
            **{f.name: getattr(self, f.name) for f in fields(Cylinder) if f.name not in ("shape", "origin")}
        )

    @property
    def axle(self) -> Axle:
        if isinstance(self.load, tuple):
            return Axle(max(load for _, load in self.load) / self.gravity, self.damping, self.load)
        return Axle(self.load / self.gravity, self.damping)

    @property
    def speed(self) -> float:
        """Along x while driving [m/s]."""
        return self.rim_speed * (1.0 - self.slip) if self.travel_speed is None else self.travel_speed

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
        heading = math.radians(self.slip_angle)
        poses[:, 3:] = np.array([about_z_y(heading, angle) for angle in self.angular_speed * driven])
        return poses

    def displacement(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # From the speeds: poses do not show a whole turn.
        driven = np.diff(np.maximum(time - self.settle, 0.0))
        return abs(self.speed) * driven, self.angular_speed * driven

    def sinkage(self, poses: np.ndarray) -> np.ndarray:
        """See `sinkage`."""
        return sinkage(vars(self), poses)

    def mean_sinkage(self, poses: np.ndarray) -> float:
        """While driving [m], of poses (T, 7); of a wheel that never does, at the end."""
        driving = self._driving(len(poses))
        return float(self.sinkage(poses)[driving if driving.any() else -1].mean())

    def _driving(self, count: int) -> np.ndarray:
        return self.times()[:count] > self.settle + 0.5 / self.frame_rate

    def warnings(self) -> list[str]:
        found = [*super().warnings(), *self._notes]
        if self.friction_angle is not None:
            found = [
                one.replace("material.friction_angle=null", "scene.friction_angle=null") for one in found
            ]
            found = [one.replace("because material.friction", "because scene.friction") for one in found]
        if self.grousers and self.grouser_thickness < self.bed.spacing:
            found.append(
                f"the grousers are {self.grouser_thickness / self.bed.spacing:.2f} grid spacings thick; below 1 the "
                "grid does not resolve them"
            )
        return found

    def results(self, force: np.ndarray, torque: np.ndarray, poses: np.ndarray) -> dict[str, float]:
        driving = self._driving(len(force))
        if not driving.any():  # it was only to settle
            return {}
        pull, lateral, vertical = along_and_across(vars(self), force[driving].mean(axis=0))
        return {
            "mean_pull_N": float(pull),
            "mean_lateral_force_N": float(lateral),
            "mean_vertical_force_N": float(vertical),
            "mean_sinkage_mm": 1000.0 * self.mean_sinkage(poses),
            "mean_torque_Nm": float(along_and_across(vars(self), torque[driving].mean(axis=0))[1]),
        }

    def summary(self, force: np.ndarray, torque: np.ndarray, poses: np.ndarray) -> str:
        found = self.results(force, torque, poses)
        if not found:
            return ""
        pull, lateral, vertical, sinkage, axle_torque = found.values()
        sideways = f"lateral force {lateral:.2f} N, " if self.slip_angle else ""
        return (
            f"while driving: mean drawbar pull {pull:.2f} N, {sideways}vertical force {vertical:.2f} N, "
            f"sinkage {sinkage:.1f} mm, torque {axle_torque:.3f} N m"
        )

    def _check_fits(self) -> None:
        """The axle stays over the bin and the rims between its side walls, whatever the height."""
        lx, ly, _ = self.bed.size
        if self.width >= ly:
            raise SceneError(f"scene.width is {self.width} m; the bin is only {ly:g} m wide")
        angle = math.radians(abs(self.slip_angle))
        across = self.width * math.cos(angle) + 2.0 * self.body.tip_radius * math.sin(angle)
        if across >= ly:
            raise SceneError(
                f"scene.slip_angle is {self.slip_angle:g} degrees: the wheel is {across:.3g} m wide across its "
                f"travel, but the bin is only {ly:g} m wide; enlarge scene.bed.size"
            )
        first, last = self.poses_at(self.times()[[0, -1]])[:, 0]
        if min(first, last) < 0.0 or max(first, last) > lx:
            raise SceneError(
                f"the axle moves from x = {first:.3f} to {last:.3f} m; allowed: 0 to {lx:g} m; change scene.start, "
                "slip, rim_speed, travel_speed or duration"
            )
        if not -self.bed.size[2] < self.clearance < self.bed.headroom:
            raise SceneError(
                f"scene.clearance is {self.clearance} m; allowed: above the floor ({-self.bed.size[2]:g} m) and below "
                f"bed.headroom ({self.bed.headroom:g} m)"
            )


@settings
class Column(Scene):
    """Soil stands in the middle of the floor and is let go at time 0; the bed's Lz is its height."""

    own_start: ClassVar[bool] = True
    name: str = "column"
    kind: str = "column"
    bed: Bed = setting(
        lambda: Bed(size=(0.60, 0.60, 0.08), spacing=0.01, particles_per_cell=8.0, headroom=0.05),
        "the floor around the column; Lz is the column's height",
    )
    duration: float = 1.0
    shape: Literal["cylinder", "slab"] = setting("cylinder", "slab: as wide as the bin, for a channel")
    radius: float = setting(0.08, "of the cylinder, or half the slab's length along x", "m")

    def __post_init__(self) -> None:
        super().__post_init__()
        room = 0.5 * min(self.bed.size[: 2 if self.shape == "cylinder" else 1])
        if not 2.0 * self.bed.spacing <= self.radius <= room:
            raise SceneError(
                f"scene.radius is {self.radius} m; allowed: two grid spacings ({2.0 * self.bed.spacing:g} m) up to "
                f"half the bin ({room:g} m)"
            )

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
        found = digest([self.bed.arrangement_hash, self.shape, self.radius])
        return digest([found, "without", self.displaced.tolist()]) if len(self.displaced) else found


def bagnold_speed(scene: Scene, inertial_number: float, height: np.ndarray) -> np.ndarray:
    """Speed [m/s] of a tilted bed that flows steadily, at heights above its base [m] (Bagnold's profile)."""
    soil, thickness = scene.material, scene.bed.size[2]
    fall = scene.gravity * math.cos(math.radians(scene.tilt))
    scale = 2.0 * inertial_number / (3.0 * soil.grain_diameter) * math.sqrt(soil.packing * fall)
    return scale * (thickness**1.5 - np.clip(thickness - height, 0.0, thickness) ** 1.5)


@settings
class Incline(Scene):
    """A layer as thick as the bed, tilted; meant for a bed that is periodic in x."""

    own_start: ClassVar[bool] = True
    name: str = "incline"
    kind: str = "incline"
    bed: Bed = setting(
        lambda: Bed(
            size=(0.006, 0.006, 0.030),
            spacing=0.0015,
            particles_per_cell=8.0,
            headroom=0.006,
            walls=Walls("periodic", "periodic"),
        ),
        "the layer, periodic in x and y",
    )
    material: Material = setting(
        lambda: Material(
            youngs_modulus=1.0e5,
            grain_density=2450.0,
            packing=0.60,
            grain_diameter=0.003,
            static_friction=0.3819,
            limit_friction=0.6435,
        ),
        "the soil: glass beads of 3 mm",
    )
    tilt: float = 26.0
    duration: float = 2.0
    flowing: bool = setting(
        True, "start in the steady flow of mu(I) down the slope (Bagnold's profile); off: start at rest"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self._flowing_angles
        if self.flowing and not low < self.tilt < high:
            raise SceneError(
                f"scene.tilt is {self.tilt} degrees; this soil flows steadily between {low:.2f} and {high:.2f} "
                "degrees: choose such a tilt or start at rest with scene.flowing=false"
            )

    @property
    def rests(self) -> bool:
        return not self.tilt

    @property
    def _flowing_angles(self) -> tuple[float, float]:
        """Slopes between which the soil flows without stopping or accelerating for ever [degrees]."""
        soil = self.material
        return math.degrees(math.atan(soil.static_friction)), math.degrees(math.atan(soil.limit_friction))

    @property
    def inertial_number(self) -> float:
        """I of the steady flow, the same at every depth [-]."""
        low, high = self._flowing_angles
        if not low < self.tilt < high:
            return 0.0
        return self.material.inertial_number(math.tan(math.radians(self.tilt)))

    def steady_velocity(self, height: np.ndarray) -> np.ndarray:
        """Speed down the slope of the steady flow at heights above the base [m], in [m/s]."""
        return bagnold_speed(self, self.inertial_number, height)

    def initial_velocities(self) -> np.ndarray:
        velocities = super().initial_velocities()
        if self.flowing:
            velocities[:, 0] = self.steady_velocity(self.initial_positions()[:, 2] + self.bed.size[2])
        return velocities
