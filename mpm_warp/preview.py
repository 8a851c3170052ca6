"""What is known of a scene before it is computed: where its tool is, what it touches, and what looks wrong."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field, replace
from itertools import chain

import numpy as np

from .bed import PADDING
from .limits import wave_step
from .poses import rotation_matrices, rotation_vectors
from .rigid_body import longest_step
from .scene import Companion, Scene
from .scenes import Wheel
from .settings import Odd, likely_radians, odd_size, odd_times, place_unit

_NOTICED = 0.25
"""Depth of a tool's lowest point at the start that is told of [grid spacings]."""
_MOST_LOOKED_AT = 500
"""Poses near a wall."""
_MANY = 2.0
"""Times as many steps as the soil takes, from which on a light body is told of."""


@dataclass(frozen=True)
class Preview:
    """What is known of a scene before it is computed.

        for line in Preview.of(scene).lines:
            print(line)

    What a free body's height will be is not known: its numbers are those of the start.
    """

    lowest: float | None = None
    """z of the tool's lowest point on its way [m], negative below the surface; None without a tool."""
    lowest_at: float = 0.0
    """When it is there first [s]."""
    first_touch: float | None = None
    """When the tool comes to where soil lies undisturbed [s]; None: never."""
    reach: np.ndarray | None = field(default=None, repr=False)
    """Lowest and highest x, y, z of the tool in its own axes, from the point whose path is prescribed [m], (2, 3)."""
    displaced: int = 0
    """Particles left out because the tool is where they would be at the start."""
    warnings: tuple[str, ...] = ()
    """What a user should know."""
    not_meant: tuple[str, ...] = ()
    """Those of the warnings after which the run would come to nothing: numbers in another unit. Commands refuse it."""
    lines: tuple[str, ...] = ()
    """What the tool does, in words."""

    @staticmethod
    def of(scene: Scene) -> Preview:
        """Of a scene; takes milliseconds."""
        warnings = [*_radians(scene), *scene.warnings()]
        own = Preview(lines=tuple(_bin(scene))) if scene.body is None else _of_tool(scene)
        every = [own, *map(_of_further, scene.companions)]
        return replace(
            own,
            displaced=len(scene.displaced),
            warnings=(*warnings, *chain.from_iterable(one.warnings for one in every)),
            not_meant=tuple(chain.from_iterable(one.not_meant for one in every)),
            lines=tuple(chain.from_iterable(one.lines for one in every)),
        )


def _of_tool(scene: Scene) -> Preview:
    """Of the body of a scene, or of a further one that is not free, as if there were no other."""
    body, warnings, given = scene.body, [], _path_times(scene)
    assert body is not None
    times = scene.passing_times()
    poses, outline = scene.poses_at(times), body.outline()
    low = scene.lowest_points(poses)
    deepest = int(np.argmin(low))
    around = np.abs(rotation_matrices(poses[:, 3:]))[:, :2] @ body.half_size
    over = np.all((poses[:, :2] + around > 0.0) & (poses[:, :2] - around < scene.bed.size[:2]), axis=1)
    touching = np.flatnonzero((low < scene.bed.surface_at(*poses[:, :2].T)) & over)
    touch = float(times[touching[0]]) if len(touching) else None
    reach = np.stack([outline.min(axis=0), outline.max(axis=0)]) - body.path_point
    found = [odd_size(body, scene.bed.size, scene.open_sides), *_of_path(scene, low, touch)]
    odd = [one for one in found if one]
    warnings += [one.words for one in odd] or _throws(scene, times, touching)
    above = _to_begin_above(scene, -float(low[0]))
    if len(scene.own_displaced):
        deep = f", {_words(-low[0])} deep" if low[0] < 0.0 else ""
        warnings.append(
            f"the tool is in the soil at the start{deep}: {len(scene.own_displaced)} particles "
            "that would lie inside it are left out; soil closes in on it in the first 0.2 s: let it rest so long"
            + above
        )
    elif touch == 0.0 and above and -low[0] > _NOTICED * scene.bed.spacing:
        warnings.append(
            f"the tool is in the soil at the start, its lowest point {_words(-low[0])} deep{above}"
        )
    if touch is not None:
        warnings += near_floor(scene, float(low[deepest]))
    warnings += near_wall(scene, times, poses) + beside_wall(scene, poses)
    lines = [] if isinstance(scene, Companion) else _bin(scene) + scene.remarks()
    lines += [] if scene.axle is not None else _way(scene, low, times, touch)
    if len(given) > 1 and given[-1] < scene.duration - 1.0 / scene.frame_rate:
        lines.append(f"the path ends at {given[-1]:.4g} s; the tool rests there until {scene.duration:g} s")
    if getattr(scene, "motion", "path") == "path" and given.size:
        sides = _sides(reach)
        named = {
            "com": "centre of mass",
            "file": "origin in the file",
            "tip": "tip (middle of its lowest face)",
        }
        used = getattr(body, "origin", "com")
        places = {name: [round(1e3 * x) for x in place] for name, place in body.origins.items()}
        others = "".join(
            f"; the {named[name]} is at ({', '.join(map(str, place))}) mm from the centre of mass"
            for name, place in places.items()
            if name != "com" and any(place)
        )
        turned = rotation_vectors(np.array([0.0, 0.0, 0.0, 1.0]), poses[0, 3:])
        angle = float(np.linalg.norm(turned))
        if angle > 0.01:
            there = (outline - body.path_point) @ rotation_matrices(poses[0, 3:]).T
            about = ", ".join(f"{x:.2g}" for x in turned / angle + 0.0)
            others += (
                f"; at the start it is turned by {math.degrees(angle):.0f} degrees about ({about}) and then "
                f"reaches from {_sides(np.stack([there.min(axis=0), there.max(axis=0)]))}"
            )
        lines.insert(
            0,
            f"the path is that of the tool's {named[used]}; around it the tool reaches from {sides}{others}",
        )
    return Preview(
        lowest=float(low[deepest]),
        lowest_at=float(times[deepest]),
        first_touch=touch,
        reach=reach,
        warnings=tuple(warnings),
        not_meant=tuple(one.words for one in odd if one.sure),
        lines=tuple(lines),
    )


def _path_times(scene: Scene) -> np.ndarray:
    """Times of the rows of a body's own path [s]."""
    follows = isinstance(scene, Companion) and scene.settings.motion == "follow"
    return np.zeros(0) if follows else scene.path_times()


def _of_further(scene: Companion) -> Preview:
    """Of a further body, by its name."""
    warnings = scene.warnings()
    found = _of_free(scene) if scene.free else _of_tool(scene)
    if (more := wave_step(scene.scene) / longest_step(scene)) > _MANY:
        key = "density, or make it larger" if scene.free else "load"
        warnings.append(
            f"the tool is so light that the run takes {more:.2g} times as many steps as the soil needs: raise its {key}"
        )

    def named(words: str) -> str:
        words = re.sub(r"scene\.(path|tool)", rf"{scene.place}.\1", words)
        return words.replace("the tool", scene.place) if "the tool" in words else f"{scene.place}: {words}"

    return Preview(
        warnings=tuple(map(named, (*warnings, *found.warnings))),
        not_meant=tuple(map(named, found.not_meant)),
        lines=tuple(map(named, found.lines)),
    )


def _of_free(scene: Companion) -> Preview:
    """Of a body of six degrees of freedom, whose way is not known."""
    low = float(scene.lowest_points(scene.poses_at(np.zeros(1)))[0])
    begins = f"its lowest point begins {_words(abs(low))} {'above' if low >= 0.0 else 'below'} the surface"
    odd, warnings = odd_size(scene.body, scene.bed.size, scene.open_sides), []
    if len(scene.own_displaced):
        warnings.append(
            f"the tool is in the soil at the start: {len(scene.own_displaced)} particles that would lie inside it are "
            "left out"
        )
    return Preview(
        warnings=tuple(([odd.words] if odd else []) + warnings),
        not_meant=(odd.words,) if odd and odd.sure else (),
        lines=(f"the tool is free and has {scene.mass:.3g} kg; {begins}",),
    )


def near_floor(scene: Scene, lowest: float) -> list[str]:
    """A line if a tool whose lowest point gets to this z [m] is too near to the floor."""
    above = scene.bed.size[2] + lowest
    if above >= scene.bed.spacing:
        return []
    return [
        f"the tool's lowest point comes to {_words(above)} above the floor, less than one grid spacing: soil jams "
        "there and forces get too large; use a deeper scene.bed.size"
    ]


def afterwards(scene: Scene, poses: np.ndarray) -> list[str]:
    """What a user should know of a run of a wheel with these poses (T, 7), whose height was not known before."""
    found, h = near_floor(scene, float(scene.lowest_points(poses).min())), scene.bed.spacing
    if isinstance(scene, Wheel) and (sinkage := scene.mean_sinkage(poses)) < h / 3.0:
        found.append(
            f"the wheel's mean sinkage is {_words(sinkage)}, less than a third of a grid spacing ({_words(h)}): the "
            "grid does not resolve it, and sinkage and forces may be wrong; use a finer scene.bed.spacing"
        )
    return found


def _throws(scene: Scene, times: np.ndarray, touching: np.ndarray) -> list[str]:
    """A line if a tool is so fast at one of the times (T,) [s], those with numbers `touching` in the soil, that soil
    as fast as it flies higher than the grid."""
    inside = touching[touching > 0]
    if scene.axle is not None or scene.gravity == 0.0 or not len(inside):
        return []
    speeds = scene.largest_displacement(times) / np.maximum(np.diff(times), 1e-12)
    fastest = inside[np.argmax(speeds[inside - 1])]
    speed, room = float(speeds[fastest - 1]), scene.bed.headroom
    height = 0.5 * speed**2 / scene.gravity
    if height <= room:
        return []
    given = getattr(scene, "path", None) is not None
    likely = "are the times of the path in seconds?" if given else "scene.speed is in m/s."
    return [
        f"the tool moves at up to {speed:.3g} m/s in the soil (at {times[fastest]:.3g} s): soil as fast as that flies "
        f"{_words(height)} high, out of the grid (scene.bed.headroom={room:g} m); {likely} "
        "If it is meant, raise scene.bed.headroom"
    ]


def _to_begin_above(scene: Scene, depth: float) -> str:
    """What lets a blade, whose lowest point is this deep at the start [m], begin above the soil."""
    clearance = getattr(scene, "clearance", None)
    if (
        scene.axle is not None
        or clearance is None
        or getattr(scene, "motion", "") == "path"
        or not depth > 0.0
    ):
        return ""
    return f"; scene.clearance={math.ceil(1e3 * (clearance + depth)) / 1e3:g} lets it begin above"


def near_wall(scene: Scene, times: np.ndarray, poses: np.ndarray) -> list[str]:
    """A line if a tool pushes soil against a wall ahead of it at some of its poses (T, 7), shape of times (T,) [s].

    The wedge of soil that gives way ahead of it reaches depth tan(45 degrees + half the friction angle) further. Of a
    wheel, whose depth is not known, a quarter of the radius is taken for it.
    """
    body, bed = scene.body, scene.bed
    assert body is not None
    outline = body.outline()
    friction = math.atan(scene.material.static_friction)
    slope = math.tan(0.25 * math.pi + 0.5 * friction)
    moved = np.diff(poses[:, :2], axis=0, prepend=poses[:1, :2])
    ahead = np.abs(moved) > 0.5 * np.linalg.norm(moved, axis=1, keepdims=True)
    places = poses[:, :3].copy()
    if scene.axle is not None:
        places[:, 2] = 0.75 * body.half_size[2]
    around = np.abs(rotation_matrices(poses[:, 3:])) @ body.half_size
    for axis in (axis for axis in (0, 1) if bed.walls.conditions[axis] != "periodic"):
        sign = np.sign(moved[:, axis])
        left = np.where(sign > 0.0, bed.size[axis] - places[:, axis], places[:, axis])
        most = np.maximum(2.0 * bed.spacing, slope * np.maximum(0.0, around[:, 2] - places[:, 2]))
        maybe = np.flatnonzero(
            ahead[:, axis] & (left - around[:, axis] < most) & (places[:, 2] < around[:, 2])
        )
        for pose in maybe[:: 1 + len(maybe) // _MOST_LOOKED_AT]:
            points = outline @ rotation_matrices(poses[pose, 3:]).T
            depth = -(points[:, 2] + places[pose, 2])
            below = depth > 0.0
            if not below.any():
                continue
            room = max(2.0 * bed.spacing, slope * float(depth.max()))
            gap = left[pose] - float((sign[pose] * points[below, axis]).max())
            if gap < room - 1e-9:
                wall = f"{'xy'[axis]} = {bed.size[axis] if sign[pose] > 0.0 else 0.0:g} m"
                return [
                    f"from {times[pose]:.3g} s on the tool pushes soil against the wall at {wall}, which makes forces "
                    f"too large: it needs {_words(room)} of soil ahead and has {_words(max(0.0, gap))}; "
                    f"scene.duration={max(0.0, times[pose - 1]):.3g} ends before that, or use a longer scene.bed.size"
                ]
    return []


def beside_wall(scene: Scene, poses: np.ndarray) -> list[str]:
    """A line if a tool moves along a wall with less than a grid spacing of soil between them, at some of its poses
    (T, 7). A wheel counts as in `near_wall`, and walls on which soil slips stand for more of the same soil."""
    body, bed = scene.body, scene.bed
    assert body is not None
    outline, moved = body.outline(), np.diff(poses, axis=0, prepend=poses[:1])
    places = poses[:, :3].copy()
    if scene.axle is not None:
        places[:, 2] = 0.75 * body.half_size[2]
    around = np.abs(rotation_matrices(poses[:, 3:])) @ body.half_size
    nearest, wall = bed.spacing - 1e-9, ""
    for axis in (axis for axis in (0, 1) if bed.walls.conditions[axis] in ("no_slip", "friction")):
        beside = np.abs(moved[:, axis]) <= 0.5 * np.linalg.norm(moved[:, :2], axis=1)
        room = np.minimum(places[:, axis], bed.size[axis] - places[:, axis]) - around[:, axis]
        maybe = np.flatnonzero(
            moved.any(axis=1) & beside & (room < bed.spacing) & (places[:, 2] < around[:, 2])
        )
        for pose in maybe[:: 1 + len(maybe) // _MOST_LOOKED_AT]:
            points = outline @ rotation_matrices(poses[pose, 3:]).T + places[pose]
            across = points[points[:, 2] < 0.0, axis]
            for at, gaps in ((0.0, across), (bed.size[axis], bed.size[axis] - across)):
                if gaps.min(initial=nearest) < nearest:
                    nearest, wall = float(gaps.min()), f"{'xy'[axis]} = {at:g} m"
    if not wall:
        return []
    remedy = "use a wider scene.bed.size"
    if getattr(scene, "path", None) is not None:
        remedy = "lay scene.path further from it, in a wider scene.bed.size if need be"
    return [
        f"the tool comes to {_words(max(0.0, nearest))} from the wall at {wall}, less than one grid spacing: soil jams "
        f"there and forces get too large; {remedy}"
    ]


def _sides(reach: np.ndarray) -> str:
    return ", ".join(
        f"{round(1e3 * a)} to {round(1e3 * b)} mm along {axis}"
        for axis, a, b in zip("xyz", *reach, strict=True)
    )


def _words(length: float) -> str:
    return f"{1e3 * length:.3g} mm" if length < 1.0 else f"{length:.3g} m"


def _radians(scene: Scene) -> list[str]:
    """A line for each angle that looks like one in radians."""
    found = {f"scene.{name}": value for name, value in likely_radians(scene).items()}
    for name, value in likely_radians(scene.material).items():
        if getattr(scene, name, None) is None:  # else the scene's own goes before it
            found[f"material.{name}"] = value
    return [
        f"{key} is {value:g} degrees, which looks like radians; angles are in degrees: {key}={math.degrees(value):.3g}"
        for key, value in found.items()
    ]


def _bin(scene: Scene) -> list[str]:
    """Where the walls are if the grid does not fit the bin."""
    bed, h = scene.bed, scene.bed.spacing
    wide = [h * (count - 1 - 2 * PADDING) for count in bed.node_counts[:2]]
    if np.allclose(wide, bed.size[:2], rtol=1e-5):
        return []
    soil, walls = (f"{x:.4g} x {y:.4g} m" for x, y in (bed.size[:2], wide))
    return [
        f"the bin of {soil} is no whole number of grid spacings ({h:.4g} m): the soil fills {soil}, the walls stand "
        f"{walls} apart"
    ]


def _way(scene: Scene, low: np.ndarray, times: np.ndarray, touch: float | None) -> list[str]:
    deepest = int(np.argmin(low))
    if touch is None:
        return []
    return [
        f"its lowest point gets {_words(-low[deepest])} deep (at {times[deepest]:.2f} s); "
        + ("it is in the soil from the start" if touch == 0.0 else f"it first touches soil at {touch:.2f} s")
    ]


def _of_path(scene: Scene, low: np.ndarray, touch: float | None) -> list[Odd]:
    """One line at most on what is odd: a wrong unit explains the rest; and one where path and run end apart."""
    times = _path_times(scene)
    if len(times) and (odd := odd_times(times, scene.duration)):
        return [odd]
    ends = []
    if len(times) > 1 and times[-1] > scene.duration + 1.0 / scene.frame_rate:
        words = (
            f"the run ends at {scene.duration:g} s and the path goes on to {times[-1]:.4g} s: the rest is left out; "
            f"scene.duration={times[-1]:.4g} takes it all"
        )
        ends = [Odd(words)]
    return ends + _of_poses(scene, times, low, touch)


def _of_poses(scene: Scene, times: np.ndarray, low: np.ndarray, touch: float | None) -> list[Odd]:
    if len(times) > 1 and not scene.largest_displacement(scene.times()).any():
        return [Odd("the tool does not move: the path's rows in the time of the run hold the same pose")]
    if touch is not None or scene.axle is not None:
        return []
    unit = place_unit(scene.poses_at(times)[:, :3], scene.bed.size) if len(times) else ""
    likely = f"the positions look like {unit} and are taken as metres" if unit else ""
    if low.min() < 0.0:
        place, remedy = "it stays beside the bin", "see scene.bed.size"
    else:
        place = f"its lowest point stays {_words(low.min())} above the surface"
        remedy = "z = 0 is the surface and below it the z of a path is negative"
        if not len(times):
            remedy = "scene.depth, which is positive, counts from scene.clearance above the surface"
            if isinstance(scene, Companion):
                remedy = "its position counts from the body that it follows"
            if low.min() > max(scene.bed.size):
                remedy = "lengths are in metres"
    return [Odd(f"the tool never touches soil: {place}; {likely or remedy}", bool(likely))]
