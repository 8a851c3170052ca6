"""What is known of a scene before it is computed: where its tool is, what it touches, and what looks wrong."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from .poses import rotation_matrices
from .scene import Scene
from .tool_geometry import place_unit, size_warning, time_warning


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
    lines: tuple[str, ...] = ()
    """What the tool does, in words."""

    @staticmethod
    def of(scene: Scene) -> Preview:
        """Of a scene; takes milliseconds."""
        body, warnings = scene.body, scene.warnings()
        if body is None:
            return Preview(warnings=tuple(warnings))
        times = scene.passing_times()
        poses, outline = scene.poses_at(times), body.outline()
        low = scene.lowest_points(poses)
        deepest = int(np.argmin(low))
        around = np.abs(rotation_matrices(poses[:, 3:]))[:, :2] @ body.half_size
        over = np.all((poses[:, :2] + around > 0.0) & (poses[:, :2] - around < scene.bed.size[:2]), axis=1)
        touching = np.flatnonzero((low < 0.0) & over)
        touch = float(times[touching[0]]) if len(touching) else None
        reach = np.stack([outline.min(axis=0), outline.max(axis=0)]) - body.path_point
        odd_size = size_warning(outline, scene.bed.size, scene.open_sides)
        warnings += ([odd_size] if odd_size else []) + _of_path(scene, low, touch)
        if len(scene.displaced):
            warnings.append(
                f"the tool is in the soil at the start, {_words(-low[0])} deep: {len(scene.displaced)} particles "
                "that would lie inside it are left out; soil closes in on it in the first 0.2 s: let it rest so long"
            )
        lines = [] if scene.axle is not None else _way(scene, low, times, touch)
        given = scene.path_times()
        if len(given) > 1 and given[-1] < scene.duration - 1.0 / scene.frame_rate:
            lines.append(
                f"the path ends at {given[-1]:.4g} s; the tool rests there until {scene.duration:g} s"
            )
        if given.size:
            sides = ", ".join(
                f"{1e3 * a:.0f} to {1e3 * b:.0f} mm along {axis}"
                for axis, a, b in zip("xyz", *reach, strict=True)
            )
            named = {
                "com": "centre of mass",
                "file": "origin in the file",
                "tip": "tip (middle of its lowest face)",
            }
            used = getattr(body, "origin", "com")
            others = "".join(
                f"; the {named[name]} is at ({', '.join(f'{1e3 * x:.0f}' for x in place)}) mm from the centre of mass"
                for name, place in body.origins.items()
                if name != "com" and np.abs(place).max() >= 5e-4
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
            displaced=len(scene.displaced),
            warnings=tuple(warnings),
            lines=tuple(lines),
        )


def _words(length: float) -> str:
    return f"{1e3 * length:.3g} mm" if length < 1.0 else f"{length:.3g} m"


def _way(scene: Scene, low: np.ndarray, times: np.ndarray, touch: float | None) -> list[str]:
    deepest = int(np.argmin(low))
    if touch is None:
        return []
    return [
        f"its lowest point gets {_words(-low[deepest])} deep (at {times[deepest]:.2f} s); "
        + ("it is in the soil from the start" if touch == 0.0 else f"it first touches soil at {touch:.2f} s")
    ]


def _of_path(scene: Scene, low: np.ndarray, touch: float | None) -> list[str]:
    """One line at most on what is odd: a wrong unit explains the rest; and one where path and run end apart."""
    times = scene.path_times()
    if len(times) and (odd := time_warning(times, scene.duration)):
        return [odd]
    ends = []
    if len(times) > 1 and times[-1] > scene.duration + 1.0 / scene.frame_rate:
        ends = [
            f"the run ends at {scene.duration:g} s and the path goes on to {times[-1]:.4g} s: the rest is left out; "
            f"scene.duration={times[-1]:.4g} takes it all"
        ]
    return ends + _of_poses(scene, times, low, touch)


def _of_poses(scene: Scene, times: np.ndarray, low: np.ndarray, touch: float | None) -> list[str]:
    if len(times) > 1 and not scene.largest_displacement(scene.times()).any():
        return ["the tool does not move: the path's rows in the time of the run hold the same pose"]
    if touch is not None or scene.axle is not None:
        return []
    unit = place_unit(scene.poses_at(times)[:, :3], scene.bed.size) if len(times) else ""
    likely = f"the positions look like {unit} and are taken as metres" if unit else ""
    if low.min() < 0.0:
        return [f"the tool never touches soil: it stays beside the bin; {likely or 'see scene.bed.size'}"]
    likely = likely or "z = 0 is the surface and depths are negative"
    return [
        f"the tool never touches soil: its lowest point stays {_words(low.min())} above the surface; {likely}"
    ]
