"""What is to be simulated: plain data, checked, without physics."""

from __future__ import annotations

import copy
import json
import math
from dataclasses import asdict, fields
from functools import cached_property, partial
from itertools import zip_longest
from typing import Any, ClassVar

import numpy as np

from .bed import Bed, digest
from .bodies import Axle, Cylinder, MeshBody, Tool
from .kernels.signed_distance import HOLDS, distances, thickening, thin_walls
from .material import Material
from .motions import Moved, Other, as_path
from .poses import (
    in_body_frame,
    rotation_matrices,
)
from .settings import Settings, build, odd_size, setting, settings, short
from .state import SceneError, Soil

MOST_FRAMES = 1_000_000
MOST_COURANT = 0.8
"""Largest `courant`. From 0.86 on a cut's forces come out too small, with nothing else to see
(experiments/stability/step.csv)."""

REMAP_TIME, VELOCITY_MEMORY = 4.0e-3, 0.1
"""`remap_time` and `velocity_memory` by default, in the default sand on Earth [s]; elsewhere they are the same shares
of sqrt(d / g), the time in which a grain falls its own size, so that similar scenes have similar answers."""

_FREE = ("headroom", "store_every", "initial_stress", "surface")
"""Keys of a bed that may be others than in the run to start from."""
_SAME_PLACE = 0.01
"""Two places no further from each other are the same [grid spacings]."""
AXLE_DAMPING = 5.0
"""Of a further body whose height is free, if it does not follow one that has its own [1/s]."""


@settings
class Scene(Settings, Moved):
    """A soil bed, gravity, and for how long; subclasses add the body and its motion.

    A subclass with a `kind` of its own is a kind of scene that `from_dict` knows.
    """

    classes: ClassVar[dict[str, type[Scene]]] = {}
    """Kind → class."""
    group: ClassVar[str] = "scene"
    own_start: ClassVar[bool] = False
    """Whether a kind of scene says itself where its soil is and how it moves at the start."""
    bilateral: ClassVar[bool] = False
    """Whether soil in contact with the body is held, too (contact.py); a kind of scene may make it a key."""
    contact: ClassVar[str] = "particles"
    """What of the soil the body stops, `particles` or `nodes` (contact.py); likewise."""

    name: str = setting("bed", "what reports call the scene")
    kind: str = setting("bed", "of scene: what moves, or how the soil starts")
    bed: Bed = setting(Bed, "the soil bin and how it is filled")
    material: Material = setting(Material, "the soil")
    gravity: float = setting(9.81, "downwards", "m/s^2", ge=0, le=1e5)
    tilt: float = setting(0.0, "the bin's slope, falling towards +x", "degrees", gt=-90, lt=90)
    duration: float = setting(5.3333333333, "one frame or more", "s", le=1e6)
    frame_rate: float = setting(60.0, "recorded frames per second", "Hz", ge=1e-3, le=1e6)
    contact_margin: float = setting(
        -0.25, "where contact begins, from the body's surface outwards", "grid spacings", ge=-1, le=1
    )
    courant: float = setting(
        0.6,
        "time step as a share of spacing / wave speed",
        ge=1e-4,
        le=MOST_COURANT,
        note=": with longer steps elastic waves in the soil grow",
    )
    elastic_damping: float = setting(0.1, "damping ratio of the grid's shortest elastic waves", ge=0, le=1)
    volume_averaging: float = setting(1.0, "share of volume changes that a local mean replaces", ge=0, le=1)
    remap_time: float | None = setting(
        None,
        "longest time between two remaps of the velocities; None: 0.72 sqrt(d / g), at least 0.04 sqrt(h / g)",
        "s",
        ge=0,
        words=" s; it must be 0 (every step) or more, or null",
    )
    remap_distance: float = setting(0.1, "soil's way between two remaps", "grid spacings", gt=0, le=0.5)
    velocity_memory: float | None = setting(
        None,
        "time in which velocities below the grid fade to 37 %; None: 18 sqrt(d / g), at least 0.5 sqrt(h / g)",
        "s",
        gt=0,
    )
    others: tuple[Other, ...] = setting((), "further bodies: a list of groups of keys")

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if "kind" in cls.__dict__:
            Scene.classes[cls.kind] = cls

    def __post_init__(self) -> None:
        super().__post_init__()
        frames = self.duration * self.frame_rate
        if not frames >= 1.0:
            raise SceneError(f"scene.duration is {self.duration} s; it must last at least one frame")
        if not frames <= MOST_FRAMES:
            raise SceneError(
                f"scene.duration is {self.duration} s at scene.frame_rate {self.frame_rate} Hz: {frames:.2g} frames; "
                f"at most {MOST_FRAMES:g} are allowed: lower one of them"
            )
        if self.own_start and self.bed.surface is not None:
            raise SceneError(
                f"bed.surface is given, but a scene of the kind {self.kind} has a start of its own"
            )
        if self._path is not None:
            object.__setattr__(self, "path", as_path(self._path, self.path_name))
        for number, one in enumerate(self.others):
            if one.motion != "follow":  # what is followed is not known yet
                Companion(self, number)

    # --- what a solver or a rollout asks of a scene -------------------------------------------------------

    @property
    def remap_limit(self) -> float:
        """Longest time between two remaps [s]."""
        return self._like_grains(REMAP_TIME, 0.04) if self.remap_time is None else self.remap_time

    @property
    def memory_time(self) -> float:
        """In which velocities below the grid fade to 37 % [s]."""
        return (
            self._like_grains(VELOCITY_MEMORY, 0.5) if self.velocity_memory is None else self.velocity_memory
        )

    def _like_grains(self, time: float, least: float) -> float:
        """A time of the default sand on Earth, scaled as sqrt(d / g), and not below a share of sqrt(h / g): remaps in
        every step would be a viscosity. Without gravity with that of the Earth [s]."""
        size, gravity = self.material.grain_diameter / Material.grain_diameter, self.gravity or Scene.gravity
        scaled = time * math.sqrt(size * (Scene.gravity / gravity))
        return max(scaled, least * math.sqrt(self.bed.spacing / gravity))

    @property
    def contact_distance(self) -> float:
        """Distance of a particle's centre, or of a node, from the body's surface at which contact begins [m]: soil
        reaches half a particle spacing further than the centre."""
        half = 0.5 * self.bed.particle_spacing if self.contact == "particles" else 0.0
        return self.contact_margin * self.bed.spacing + half

    @property
    def gravity_vector(self) -> np.ndarray:
        """[m/s^2], shape (3,)."""
        angle = math.radians(self.tilt)
        return self.gravity * np.array([math.sin(angle), 0.0, -math.cos(angle)])

    @property
    def filled(self) -> tuple[np.ndarray, float]:
        """Particle positions (n, 3) of the bed without a tool [m] and the volume of one [m^3]."""
        return (
            self.bed.filled
            if self.soil is None
            else (self.soil.particles["position"], self.bed.particle_volume)
        )

    @property
    def soil(self) -> Soil | None:
        """What the soil starts as, if another run left it so; see `starting_from`."""
        return self.__dict__.get("_soil")

    def starting_from(self, soil: Soil) -> Scene:
        """The same scene whose soil starts as another run left it, with its velocities and stresses.

        A tool that was there and starts from the same place is taken over with its contacts; so is the height of a
        wheel. Any other tool displaces the particles where it is.

        Raises:
            SceneError: bed or soil are not those of that run, or this kind of scene has a start of its own.
        """
        if self.own_start:
            raise SceneError(
                f"a scene of the kind {self.kind} has a start of its own; soil of another run goes into the kinds "
                f"{', '.join(kind for kind, cls in Scene.classes.items() if not cls.own_start)}"
            )
        for group, here, there in (
            ("scene.bed", self.bed, soil.scene.bed),
            ("material", self.material, soil.scene.material),
        ):
            known = vars(there) | {name: getattr(here, name) for name in _FREE if group == "scene.bed"}
            for name, value in ((one.name, getattr(here, one.name)) for one in fields(here)):
                if value != known[name]:
                    raise SceneError(
                        f"{group}.{name} is {short(value)}, but {short(known[name])} in the run to start from; leave "
                        "it as it is there"
                    )
        position, size, margin = soil.particles["position"], np.array(self.bed.size), self.bed.spacing
        low, high = np.array([0.0, 0.0, -size[2]]), np.array([*size[:2], self.bed.headroom])
        outside = ((position < low - margin) | (position > high + margin)).any(axis=1)
        if outside.any():
            particle = int(np.argmax(outside))
            at = ", ".join(f"{x:.4g}" for x in position[particle])
            raise SceneError(
                f"particle {particle} of the soil to start from is outside the bin, at ({at}) m; if that is above it, "
                f"raise scene.bed.headroom ({self.bed.headroom:g} m)"
            )
        found = copy.copy(self)
        for name in [
            name for name in vars(found) if isinstance(getattr(type(self), name, None), cached_property)
        ]:
            del found.__dict__[name]
        found.__dict__["_soil"] = soil
        return found

    @cached_property
    def goes_on(self) -> bool:
        """Whether the body is there already in the soil to start from, in the same place, to a part of a grid
        spacing; the height of a free body is then that."""
        soil, body = self.soil, self.body
        if soil is None or body is None or body != soil.scene.body or "contact_stretch" not in soil.particles:
            return False
        if (self.axle is None) != (soil.scene.axle is None) or (
            self.axle and "axle" not in soil.state.arrays
        ):
            return False
        pose, near = self.poses_at(np.zeros(1))[0], _SAME_PLACE * self.bed.spacing
        axes = 2 if self.axle else 3
        turned = rotation_matrices(pose[3:]) - rotation_matrices(soil.pose[3:])
        if isinstance(body, Cylinder) and not body.grousers:
            turned = turned[:, 1]  # round its axis it may have any angle
        away = np.abs(pose[:axes] - soil.pose[:axes]).max()
        return bool(away <= near and np.abs(turned).max() * body.reach <= near)

    @cached_property
    def displaced(self) -> np.ndarray:
        """Indices of the particles of `filled` that are left out, because a body is where they would be at time 0,
        increasing; nearly always none.

        Particles in the midst of a body would be thrown out. So where the centre of one is inside it, and more than a
        tenth of a particle spacing beyond where contact begins, all go that contact would push.
        """
        every = [self.own_displaced, *(one.displaced for one in self.companions)]
        return np.unique(np.concatenate(every)) if len(every) > 1 else every[0]

    @property
    def own_displaced(self) -> np.ndarray:
        """By the scene's own body."""
        body, nobody = self.body, np.zeros(0, dtype=np.int64)
        if body is None or self.goes_on:
            return nobody
        pose, top = self.poses_at(np.zeros(1))[0], max(0.0, self.filled[0][:, 2].max())
        if pose[2] - np.abs(rotation_matrices(pose[3:])[2]) @ body.half_size > top - 1e-9:
            return nobody  # above the soil
        points = in_body_frame(pose, self.filled[0])
        thicker = thickening(body, self.contact_distance, self.bed.spacing)
        margin = max(0.0, self.contact_distance)
        most = margin + (0.0 if thicker is None else thicker.max())
        near = np.flatnonzero((np.abs(points) < body.half_size + most).all(axis=1))
        if len(near) == 0:
            return nobody
        overlap = self.contact_distance - distances(body, points[near], margin, thicker)
        deep = max(self.contact_distance, 0.1 * self.bed.particle_spacing)
        return near[overlap > 0.0] if (overlap > deep).any() else nobody

    @property
    def stored(self) -> np.ndarray:
        """Indices of the particles that are recorded, increasing: one of every `bed.store_every` in a row.

        Which one is drawn at random, always the same way: at fixed steps a lattice would be recorded in some of
        its layers only.
        """
        count, every = len(self.initial_positions()), self.bed.store_every
        first = np.arange(0, count, every)
        return first + np.random.default_rng(0).integers(np.minimum(every, count - first))

    @property
    def soil_volume(self) -> float:
        """Space that the soil takes up at the start [m^3]."""
        return self.bed.soil_volume

    def initial_velocities(self) -> np.ndarray:
        """Soil at time 0 [m/s], shape (n, 3), float64."""
        if self.soil is not None:
            return np.delete(self.soil.particles["velocity"], self.displaced, axis=0)
        return np.zeros_like(self.initial_positions())

    @property
    def mesh(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Vertices (k, 3) [m] about the centre of mass and triangles (t, 3) of a body that is a mesh."""
        return self.body.mesh if isinstance(self.body, MeshBody) else None

    @property
    def meshes(self) -> tuple[tuple[np.ndarray, np.ndarray] | None, ...]:
        """`mesh`, then that of each further body."""
        return self.mesh, *(one.mesh for one in self.companions)

    @property
    def axle(self) -> Axle | None:
        """The body's vertical motion if it is free; None: all of it is prescribed."""
        return None

    @cached_property
    def companions(self) -> list[Companion]:
        """The further bodies, each seen as a scene of its own."""
        return [Companion(self, number) for number in range(len(self.others))]

    def initial_positions(self) -> np.ndarray:
        """Soil at time 0 [m], shape (n, 3), float64."""
        positions = self.filled[0]
        return np.delete(positions, self.displaced, axis=0) if len(self.displaced) else positions

    @property
    def arrangement_hash(self) -> str:
        """See `Bed.arrangement_hash`; another one where particles are left out, or come from another run."""
        found = self.bed.arrangement_hash
        if self.soil is not None:
            found = digest([found, "from", self.soil.digest])
        return digest([found, "without", self.displaced.tolist()]) if len(self.displaced) else found

    @property
    def rests(self) -> bool:
        """Whether the soil is meant to be at rest where no body moves it."""
        return True

    def warnings(self) -> list[str]:
        """What a user should know about this scene before it runs."""
        found = self.material.warnings() + (self.material.warnings_at_rest() if self.rests else [])
        found += self.body.warnings() if self.body is not None else []
        if self.bed.surface is not None and self.soil is None:
            steepest = np.linalg.norm(self.bed.slope_at(*self.filled[0][:, :2].T), axis=0).max()
            slope, stands = (math.degrees(math.atan(x)) for x in (steepest, self.material.static_friction))
            if slope > stands:
                found.append(
                    f"bed.surface is up to {slope:.3g} degrees steep, more than the soil's friction "
                    f"({stands:.3g} degrees): it may flow at the start"
                )
        return found

    def remarks(self) -> list[str]:
        """What holds for this scene by choice, and needs no warning."""
        count = self.bed.particles_per_cell
        if self.body is None or count >= 2.0:
            return []
        particles = "one particle" if count == 1.0 else f"{count:g} particles"
        return [
            f"{particles} per cell: forces may be wrong by tens of per cent; scene.bed.particles_per_cell=4 takes "
            f"{4.0 / count:.2g} times as long"
        ]

    def results(self, force: np.ndarray, torque: np.ndarray, poses: np.ndarray) -> dict[str, float]:
        """What came out, names with their units, of the soil's force on the body [N] and its torque about the centre of
        mass [N m], shape (T, 3), and the body's poses (T, 7); empty without a body."""
        return {}

    def summary(self, force: np.ndarray, torque: np.ndarray, poses: np.ndarray) -> str:
        """The results in a few words."""
        return ""

    def to_dict(self) -> dict[str, Any]:
        """Everything that defines the scene, as plain nested data; of a mesh only its file and digest, see `mesh`."""
        return json.loads(json.dumps(asdict(self)))

    @staticmethod
    def from_dict(data: dict[str, Any], *meshes: tuple[np.ndarray, np.ndarray] | None) -> Scene:
        """The scene described by plain nested data, checked.

        Args:
            data: as from `to_dict`, or less. A `tool.file` without `tool.digest` is read: it is a person's wish. One
                with a digest was read before, and is not read again: `data` may come from any file.
            meshes: of such tools, see `meshes`.
        """
        kind = data.get("kind", "bed")
        if not isinstance(kind, str) or kind not in Scene.classes:
            raise SceneError(f"scene.kind is {kind!r}; allowed: {', '.join(Scene.classes)}")
        own, *more = meshes or (None,)
        data = _with_mesh(data, own, "scene")
        if isinstance(others := data.get("others"), (list, tuple)):
            known = zip_longest(others, more[: len(others)])
            every = [_with_mesh(one, mesh, f"scene.others[{i}]") for i, (one, mesh) in enumerate(known)]
            data = data | {"others": every}
        return build(Scene.classes[kind], data, "scene")

    def _check_thickness(self, body: Tool, what: str) -> None:
        """A body must be thick enough for soil to be inside before it is pushed out, or for a node to be inside."""
        holds = 0.5 if self.contact == "nodes" else HOLDS
        if body.half_thickness + self.contact_distance < holds * self.bed.spacing:
            odd = odd_size(body, self.bed.size, self.open_sides)
            remedy = odd.words if odd else "use a smaller bed.spacing (at most half the thickness is good)"
            raise SceneError(
                f"{what} of {2.0 * body.half_thickness:g} m is too thin for a grid of {self.bed.spacing:g} m: "
                f"soil would pass through; {remedy}"
            )


def _with_mesh(body: Any, mesh: tuple[np.ndarray, np.ndarray] | None, place: str) -> Any:
    """Plain data of a scene or of a further body; where its tool is a mesh that was read before, with that mesh."""
    tool = body.get("tool") if isinstance(body, dict) else None
    if not isinstance(tool, dict) or tool.get("shape") != "mesh":
        return body
    if mesh is not None:
        return body | {"tool": build(MeshBody, tool, f"{place}.tool", partial(MeshBody.of_mesh, *mesh))}
    if tool.get("digest"):
        raise SceneError(
            f"{place}.tool is a mesh, which these data do not hold (nor does a checkpoint); take it from a run: "
            "Scene.from_dict(run.scene, *run.meshes); or leave out tool.digest to read tool.file again"
        )
    return body


class Companion(Scene):
    """One of the further bodies of a scene, seen as if it were the only one in it.

    Raises:
        SceneError: the body is outside the bin, too thin for the grid, or has nothing to follow.
    """

    def __init__(self, scene: Scene, number: int) -> None:
        self.__dict__.update({one.name: getattr(scene, one.name) for one in fields(Scene)}, others=())
        self.scene, self.settings, self.place = scene, scene.others[number], f"scene.others[{number}]"
        self.path_name = f"{self.place}.path"
        self.path = None if self.settings.path is None else as_path(self.settings.path, self.path_name)
        if self.settings.motion == "follow" and scene.body is None:
            raise SceneError(f"{self.place} has nothing to follow: a scene of kind {scene.kind} has no body")
        if self.settings.load is not None and not self.gravity > 0:
            raise SceneError(f"{self.place}.load needs scene.gravity above 0 m/s^2")
        if not isinstance(self.body, MeshBody):  # whose thin walls are made to hold
            self._check_thickness(self.body, self.place)
        self._check_inside(self.body, self.place, "change its position or path")

    def __setattr__(self, name: str, value: Any) -> None:
        self.__dict__[name] = value

    @property
    def body(self) -> Tool:
        return self.settings.tool

    @property
    def free(self) -> bool:
        """Whether it has six degrees of freedom."""
        return self.settings.motion == "free"

    @property
    def mass(self) -> float:
        """Of a free body [kg]."""
        return self.settings.density * self.settings.tool.moments[0]

    @property
    def inertia(self) -> np.ndarray:
        """Of a free body, about its axes [kg m^2], shape (3, 3)."""
        return self.settings.density * self.settings.tool.moments[1]

    def warnings(self) -> list[str]:
        odd = odd_size(self.body, self.bed.size, self.open_sides)
        return self.body.warnings() + (
            [] if odd else thin_walls(self.body, self.contact_distance, self.bed.spacing)
        )

    @property
    def axle(self) -> Axle | None:
        main = self.scene.axle if self.settings.motion == "follow" else None
        if self.settings.load is None:
            return main
        return Axle(self.settings.load / self.gravity, AXLE_DAMPING if main is None else main.damping)

    @property
    def bilateral(self) -> bool:  # type: ignore[override]
        return self.settings.motion == "follow" and self.scene.bilateral

    @property
    def filled(self) -> tuple[np.ndarray, float]:
        return self.scene.filled

    @property
    def impact_speed(self) -> float:
        """With which a free body comes to a flat surface, or begins below it [m/s]."""
        one = self.settings
        fall = self.lowest_points(self.poses_at(np.zeros(1)))[0]
        spin = math.hypot(*one.spin) * self.body.reach
        return math.hypot(*one.velocity) + spin + math.sqrt(2.0 * self.gravity * max(fall, 0.0))

    @property
    def top_free_speed(self) -> float:
        """Of any point of a free body that falls to the floor [m/s]; 0 of others."""
        depth = self.bed.size[2] + abs(math.sin(math.radians(self.tilt))) * self.bed.size[0]
        return self.impact_speed + math.sqrt(2.0 * self.gravity * depth) if self.free else 0.0

    def poses_at(self, time: np.ndarray) -> np.ndarray:
        if self.settings.motion == "path":
            return super().poses_at(time)
        if self.settings.motion == "follow":
            poses = self.scene.poses_at(time)
            poses[:, :3] += self.settings.position
            return poses
        rotation = np.array(self.settings.rotation) / math.hypot(*self.settings.rotation)
        return np.tile([*self.settings.position, *rotation], (len(np.atleast_1d(time)), 1))

    def path_times(self) -> np.ndarray:
        return self.scene.path_times() if self.settings.motion == "follow" else super().path_times()

    def displacement(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self.settings.motion == "follow":
            return self.scene.displacement(time)
        return super().displacement(time)


Scene.classes["bed"] = Scene
