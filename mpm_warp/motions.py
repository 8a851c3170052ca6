"""How tools move: the published cuts, several passes, further bodies; how a wheel's load and forces are read."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar, Literal

import numpy as np

from .bed import Bed
from .bodies import Box, Cylinder, MeshBody, Sphere, Tool
from .poses import (
    about_y,
    in_world_frame,
    rotate,
    rotation_matrices,
    rotation_vectors,
    sampled_poses,
)
from .settings import Settings, odd_size, place_unit, setting, settings, short
from .state import SceneError

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


def tip_poses(
    tip: np.ndarray, start: tuple[float, float, float], rake: float, moved: np.ndarray
) -> np.ndarray:
    """Poses (T, 7) of a body whose `tip`, in the body frame [m], is at `start` [m] and has then `moved` (T, 2) along x
    and z [m]; its top leans back by `rake` [degrees]."""
    rotation = about_y(-math.radians(rake))
    poses = np.empty((len(moved), 7))
    poses[:, :3] = np.array(start) - rotate(rotation, tip)
    poses[:, [0, 2]] += moved
    poses[:, 3:] = rotation
    return poses


# --- Several passes -------------------------------------------------------------------------------------


@settings
class Passes(Settings):
    """Several cuts one after the other, of motion=passes.

    Each goes down at 45 degrees, along x, and up at 45 degrees at the scene's `speed`. Then the tool is lifted and goes
    back and down to where the next one begins, at `return_speed`.
    """

    group: ClassVar[str] = "scene.passes"

    number: int = setting(2, "of cuts", ge=1, le=100)
    length: float = setting(0.20, "of a cut along x at its full depth", "m", ge=0, le=1e3)
    advance: float = setting(0.0, "each cut begins so much further along x", "m", ge=-1e3, le=1e3)
    deepening: float = setting(0.02, "each cut goes so much deeper", "m", ge=-1e3, le=1e3)
    lift: float = setting(0.08, "of the tip above its starting height, on the way back", "m", ge=0, le=1e3)
    return_speed: float = setting(0.20, "above the starting height", "m/s", gt=0, le=1e4)
    easing: float = setting(
        0.10, "time in which the velocity changes at a corner; it rounds the corner", "s", ge=1e-3, le=10
    )

    def corners(self, depth: float, speed: float) -> tuple[np.ndarray, np.ndarray]:
        """Times (k,) [s] and displacements (k, 2) of the tip along x and z [m] between which it would move straight
        without easing."""
        points, rates = [(0.0, 0.0)], []
        for cut in range(self.number):
            begin, deep = cut * self.advance, depth + cut * self.deepening
            if not deep > 0.0:
                raise SceneError(
                    f"scene.depth is {depth:g} m and scene.passes.deepening {self.deepening:g} m: cut {cut + 1} would "
                    f"be {deep:g} m deep; it must be above 0 m"
                )
            end = begin + deep + self.length
            if cut:
                points += [(begin, self.lift), (begin, 0.0)]
                rates += [self.return_speed] * 2
            points += [(begin + deep, -deep), (end, -deep), (end + deep, 0.0), (end + deep, self.lift)]
            rates += [speed] * 3 + [self.return_speed]
        places = np.array(points)
        ways = np.linalg.norm(np.diff(places, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(ways / np.array(rates))]), places

    def displacement(self, time: np.ndarray, depth: float, speed: float) -> np.ndarray:
        """Displacement (dx, dz) of the tip, shape (T, 2) [m]: the mean of the straight way over the last `easing`
        seconds, so that the acceleration is at most 2 speed / easing."""
        corners, places = self.corners(depth, speed)
        lasting = np.diff(corners)
        moving = lasting > 0.0
        velocity = np.diff(places, axis=0)[moving] / lasting[moving, None]
        corners, places = (
            np.append(corners[:-1][moving], corners[-1]),
            np.append(places[:-1][moving], places[-1:], 0),
        )
        velocity = np.append(velocity, [[0.0, 0.0]], axis=0)  # rests afterwards
        way = (places[:-1] + 0.5 * velocity[:-1] * np.diff(corners)[:, None]) * np.diff(corners)[:, None]
        integral = np.concatenate([[[0.0, 0.0]], np.cumsum(way, axis=0)])

        def until(t: np.ndarray) -> np.ndarray:
            """Integral of the straight way over time; before its start it is at rest where it begins."""
            part = np.searchsorted(corners, t, side="right") - 1
            since = (np.maximum(t, 0.0) - corners[np.maximum(part, 0)])[:, None]
            part = np.maximum(part, 0)
            return integral[part] + (places[part] + 0.5 * velocity[part] * since) * since

        time = np.asarray(time, dtype=float)
        return (until(time) - until(time - self.easing)) / self.easing

    def turns(self, depth: float, speed: float) -> np.ndarray:
        """Times at which the tip begins and ends to change its velocity [s], increasing, shape (k,)."""
        corners = self.corners(depth, speed)[0]
        return np.unique(np.concatenate([corners, corners + self.easing]))

    def cutting(self, time: np.ndarray, depth: float, speed: float) -> np.ndarray:
        """Which cut, from 0, is under way at some times [s], shape (T,); -1: none."""
        corners, shift = self.corners(depth, speed)[0], 0.5 * self.easing
        found = np.full(len(time), -1)
        for cut in range(self.number):
            begin, end = corners[6 * cut] + shift, corners[6 * cut + 3] + shift
            found[(time > begin) & (time <= end)] = cut
        return found


# --- Wheels ---------------------------------------------------------------------------------------------


def sinkage(scene: Mapping[str, Any], poses: np.ndarray) -> np.ndarray:
    """Depth of a wheel's lowest point below the undisturbed surface [m], shape (T,) for its poses (T, 7).

    Its `scene` is plain data, such as a run file's; published ones say nothing of grousers.
    """
    return 0.5 * scene["diameter"] + scene.get("grouser_height", 0.0) - poses[:, 2]


def along_and_across(scene: Mapping[str, Any], vectors: np.ndarray) -> np.ndarray:
    """Parts of a wheel's forces or torques, world frame, shape (..., 3): along its heading, along its axle, and up.

    Its `scene` is plain data, as for `sinkage`.
    """
    angle = math.radians(scene.get("slip_angle", 0.0))
    c, s = math.cos(angle), math.sin(angle)
    return vectors @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def as_loads(rows: Any) -> tuple[tuple[float, float], ...]:
    """The rows of a load over time, checked."""
    for number, row in enumerate(rows, 1):
        numbers = isinstance(row, (list, tuple, np.ndarray)) and len(row) == 2
        if not numbers or not all(
            isinstance(v, (int, float, np.number)) and not isinstance(v, bool) and math.isfinite(v)
            for v in row
        ):
            raise SceneError(
                f"row {number} of scene.load is {short(row)}; it needs a time [s] and a load [N]"
            )
        if not row[1] > 0:
            raise SceneError(f"row {number} of scene.load is {short(row)}; a wheel needs more than 0 N")
        if number > 1 and not row[0] > rows[number - 2][0]:
            raise SceneError(
                f"row {number} of scene.load does not come after the row before it; times increase"
            )
    if len(rows) == 0:
        raise SceneError(
            "scene.load is empty; it must be a number above 0 N, or rows of a time [s] and a load [N]"
        )
    return tuple((float(time), float(load)) for time, load in rows)


# --- Where a body goes in its bin -------------------------------------------------------------------------

_FARTHEST = 1e13
"""Number in a path, which may hold epoch seconds in milliseconds [s or m]."""
_ROUNDING = 1e-9
"""Lengths that differ by less are the same [m]."""
_MOST_POSES, _MOST_POINTS = 100_000, 1_000_000
"""That are looked at for walls in a way, and at a time."""


def as_path(rows: Any, name: str) -> tuple[tuple[float, ...], ...]:
    """The rows of a path as numbers; whether they are poses is looked at where they are used."""
    for number, row in enumerate(rows, 1):
        if not isinstance(row, (list, tuple, np.ndarray)) or len(row) != 8:
            raise SceneError(
                f"row {number} of {name} is {short(row)}; it needs 8 numbers: t, x, y, z, qx, qy, qz, qw"
            )
        for value in row:
            if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
                raise SceneError(f"row {number} of {name} holds {short(value)}; allowed: numbers")
            if _FARTHEST < abs(float(value)) < math.inf:
                raise SceneError(
                    f"row {number} of {name} holds {value:.3g}; allowed: {-_FARTHEST:g} to {_FARTHEST:g}"
                )
    return tuple(tuple(float(v) for v in row) for row in rows)


class Moved:
    """A scene's body along its way: where it is, how far it goes, and whether it stays in the bin."""

    path_name = "the path"
    """As errors name it."""
    bed: Bed
    duration: float
    frame_rate: float

    @property
    def body(self) -> Tool | None:
        """The rigid body that touches the soil, if any."""
        return None

    @property
    def open_sides(self) -> bool:
        """Whether nothing is in the way of a body at the sides: walls of a channel stand for more of the same soil."""
        return self.bed.walls.conditions[1] in ("slip", "periodic")

    @property
    def frame_count(self) -> int:
        """T, with the initial state as frame 0."""
        return round(self.duration * self.frame_rate) + 1

    def times(self) -> np.ndarray:
        """Times of the frames [s], shape (T,)."""
        return np.arange(self.frame_count) / self.frame_rate

    @property
    def _path(self) -> tuple[tuple[float, ...], ...] | None:
        """The setting `path` of the kinds of scenes that have it."""
        return getattr(self, "path", None)

    def poses_at(self, time: np.ndarray) -> np.ndarray:
        """Pose of the body at any times [s]: centre of mass [m] and quaternion x, y, z, w; shape (T, 7).

        Of a body with a free height the z of the start, which the solver replaces.
        """
        if self._path is not None:
            poses = sampled_poses(
                np.asarray(self._path), np.atleast_1d(np.asarray(time, dtype=float)), self.path_name
            )
            if self.body is not None and (point := self.body.path_point).any():
                poses[:, :3] -= rotate(poses[:, 3:], point)
            return poses
        return np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (len(np.atleast_1d(time)), 1))

    def body_poses(self) -> np.ndarray:
        """Poses at the frames, shape (T, 7)."""
        return self.poses_at(self.times())

    def path_times(self) -> np.ndarray:
        """Times at which a prescribed path may turn [s], increasing, shape (k,); none for a smooth motion."""
        return np.array([row[0] for row in self._path or ()])

    def _with_turns(self, time: np.ndarray) -> np.ndarray:
        """Increasing times [s] with those between the first and the last at which a path may turn."""
        rows = self.path_times()
        return np.union1d(time, rows[(rows > time[0]) & (rows < time[-1])])

    def displacement(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What the body's centre travels [m] and by what angle the body turns [rad] from each of the increasing times
        (T,) [s] to the next, both of shape (T - 1,).

        A path counts row by row, whatever it comes back to; between rows, and without any, a body turns the shortest
        way.
        """
        every = self._with_turns(time)
        poses = self.poses_at(every)
        way = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1)
        angle = np.linalg.norm(rotation_vectors(poses[:-1, 3:], poses[1:, 3:]), axis=1)
        first = np.searchsorted(every, time[:-1])
        return np.add.reduceat(way, first), np.add.reduceat(angle, first)

    def largest_displacement(self, time: np.ndarray) -> np.ndarray:
        """The most that any point of the body travels from each of the increasing times (T,) [s] to the next [m],
        shape (T - 1,)."""
        way, angle = self.displacement(time)
        return way + angle * (self.body.reach if self.body is not None else 0.0)

    def passing_times(self) -> np.ndarray:
        """Times of the frames and between them [s], so close that no point of the body moves more than a grid spacing
        from one to the next; of a very long way less close."""
        times = self._with_turns(self.times())
        way = self.largest_displacement(times)
        steps = np.maximum(1.0, np.ceil(way / max(self.bed.spacing, way.sum() / _MOST_POSES)))
        ends = np.concatenate([[0.0], np.cumsum(steps)])
        return np.interp(np.arange(ends[-1] + 1.0), ends, times)

    def lowest_points(self, poses: np.ndarray) -> np.ndarray:
        """z of the body's lowest point at poses (T, 7) [m], shape (T,)."""
        assert self.body is not None
        outline, up = self.body.outline(), rotation_matrices(poses[:, 3:])[:, 2]
        parts = np.array_split(up, 1 + len(up) * len(outline) // _MOST_POINTS)
        return poses[:, 2] + np.concatenate([(part @ outline.T).min(axis=1) for part in parts])

    def body_points(self) -> np.ndarray:
        """Body nodes in the body frame [m], shape (M, 3)."""
        return self.body.points() if self.body is not None else np.zeros((0, 3))

    def _check_inside(self, body: Tool, what: str, remedy: str) -> None:
        """The part of the body that is below the surface must stay within the bin."""
        lx, ly, lz = self.bed.size
        side = math.inf if self.open_sides else 0.0
        low, high = np.array([0.0, -side, -lz]) - _ROUNDING, np.array([lx, ly + side, math.inf]) + _ROUNDING
        times = self.passing_times()
        poses, outline = self.poses_at(times), body.outline()
        place, around = poses[:, :3], np.abs(rotation_matrices(poses[:, 3:])) @ body.half_size
        leaving = ((place - around < low) | (place + around > high)).any(axis=1)
        maybe = np.flatnonzero(leaving & (place[:, 2] < around[:, 2]))
        for some in np.array_split(maybe, 1 + len(maybe) * len(outline) // _MOST_POINTS):
            points = in_world_frame(poses[some], outline)
            outside = ((points < low) | (points > high)) & (points[:, :, 2:] < 0.0)
            if outside.any():
                pose = int(np.argmax(outside.any(axis=(1, 2))))
                axis = int(np.argmax(outside[pose].any(axis=0)))
                at = points[pose, np.argmax(outside[pose, :, axis]), axis]
                allowed = (f"0 to {lx:g} m", f"0 to {ly:g} m", f"at least {-lz:g} m")[axis]
                if self._path and (unit := place_unit(np.array(self._path)[:, 1:4], self.bed.size)):
                    remedy = f"the path's positions look like {unit} and are taken as metres"
                elif odd := odd_size(body, self.bed.size, self.open_sides):
                    remedy = odd.words
                raise SceneError(
                    f"{what} leaves the bin at {times[some[pose]]:.3f} s: {'xyz'[axis]} = {at:.4f} m, "
                    f"allowed {allowed} below the surface; {remedy}"
                )


# --- Further bodies -------------------------------------------------------------------------------------

_USED = {
    "free": ("position", "rotation", "velocity", "spin", "density"),
    "path": ("path", "load"),
    "follow": ("position", "load"),
}


def _three(default: tuple[float, float, float], words: str, unit: str) -> Any:
    return setting(default, words, unit, ge=-1e6, le=1e6, words="; it needs three numbers from -1e6 to 1e6")


@settings
class Other(Settings):
    """A further body in the soil, beside the one that a kind of scene has. Bodies do not touch each other."""

    group: ClassVar[str] = "scene.others"

    tool: Sphere | Box | Cylinder | MeshBody = setting(Sphere, "the body")
    motion: Literal["free", "path", "follow"] = setting(
        "free",
        "free: it falls, turns and is pushed; path: prescribed; follow: as the scene's own body, beside it",
    )
    position: tuple[float, float, float] = _three(
        (0.0, 0.0, 0.0), "of the centre of mass at the start; with follow, from the scene's own body on", "m"
    )
    rotation: tuple[float, float, float, float] = setting(
        (0.0, 0.0, 0.0, 1.0),
        "at the start, of a free body: unit quaternion x, y, z, w",
        words="; it needs a unit quaternion x, y, z, w",
    )
    velocity: tuple[float, float, float] = _three((0.0, 0.0, 0.0), "at the start, of a free body", "m/s")
    spin: tuple[float, float, float] = _three((0.0, 0.0, 0.0), "likewise, about x, y, z", "rad/s")
    density: float = setting(
        2650.0, "of a free body: its mass by its volume, grousers left out", "kg/m^3", gt=0, le=1e6
    )
    path: tuple[Any, ...] | None = setting(None, "for path: a CSV file, or rows, as of scene.path")
    load: float | None = setting(
        None,
        "with path or follow: the height is free, and this is the weight; None: as of the body it follows",
        "N",
        gt=0,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if abs(math.hypot(*self.rotation) - 1.0) > 1e-3:
            raise SceneError(f"scene.others.rotation is {self.rotation}; it must be of length 1")
        for name in sorted(set(sum(_USED.values(), ())) - set(_USED[self.motion])):
            if getattr(self, name) != getattr(type(self), name):
                raise SceneError(
                    f"scene.others.{name} is {short(getattr(self, name))}, but motion={self.motion} does not use it; "
                    f"allowed: {', '.join(_USED[self.motion])}"
                )
        if self.motion == "path" and self.path is None:
            raise SceneError("scene.others.path is missing: rows t, x, y, z, qx, qy, qz, qw for motion=path")
        if self.path is not None:  # as rows of plain data are
            rows = tuple(tuple(row) if isinstance(row, list) else row for row in self.path)
            object.__setattr__(self, "path", rows)
