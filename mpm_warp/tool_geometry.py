"""A tool's shape: distances from its surface, how thick the walls of a mesh are, and what is odd about its size."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import warp as wp

from .bodies import MeshBody, Tool
from .kernels.signed_distance import distance_kernel, shape_data, wall_kernel
from .launch import Launch, find_device

HOLDS = 0.1
"""How far a wall's middle has to be beyond where contact begins for it to hold soil [grid spacings]
(experiments/stability/thin_walls.csv)."""
_SAMPLES = [(1 / 3, 1 / 3), *((u / 8, v / 8) for u in (1, 3, 6) for v in (1, 3, 6) if u + v < 8)]
"""Places in a triangle, as the shares of its first two corners."""
_MANY_TRIANGLES = 20_000
"""So many are small: one ray from each is enough."""


def distances(
    body: Tool, points: np.ndarray, margin: float = 0.0, thickening: np.ndarray | None = None
) -> np.ndarray:
    """Distances of points (n, 3) from a tool's surface, negative inside, both in the body frame [m]; shape (n,).

    Args:
        margin: the largest distance that is of interest [m]; points beyond it may be said to be far away.
        thickening: of a mesh at its vertices, as the function of that name gives it [m].
    """
    device, real = find_device("cpu"), wp.float64
    shape, _lives_on = shape_data(body, real, margin, device, thickening)
    found = wp.zeros(len(points), dtype=real, device=device)
    given: wp.array = wp.array(points, dtype=wp.types.vector(3, real), device=device)
    Launch(distance_kernel(body.surface), len(points), [given, shape, found], device).launch()
    return found.numpy()


def mesh_asymmetry(body: MeshBody) -> float:
    """How far a mesh is from being its own mirror image about its plane y = 0 [m]: the farthest that the image of a
    corner, or of the middle of a triangle, is from its surface."""
    vertices, triangles = body.mesh
    points = np.concatenate([vertices, vertices[triangles].mean(axis=1)])
    return float(np.abs(distances(body, points * [1.0, -1.0, 1.0], margin=body.reach)).max())


# --- Walls of meshes: how thick they are, and what makes them hold soil ---------------------------------


def wall_thickness(body: MeshBody, most: float) -> np.ndarray:
    """How thick the mesh is below each of its triangles [m], shape (t,); infinite where there is no wall of at most
    `most` [m]: no other side that runs along with the triangle, as at edges that taper.

    A body keeps what was measured: several ask.
    """
    before, known = body.__dict__.get("_walls", (0.0, None))
    if most <= before:
        return np.where(known <= most, known, np.inf)
    device = find_device("cpu")

    def on_device(points: np.ndarray) -> wp.array:
        return wp.array(points, dtype=wp.vec3, device=device)

    vertices, triangles = body.mesh
    mesh = wp.Mesh(on_device(vertices), wp.array(triangles.ravel(), dtype=int, device=device))
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    thickness = np.full(len(triangles), np.inf)
    for u, v in _SAMPLES[: 1 if len(triangles) > _MANY_TRIANGLES else None]:
        begin = u * a + v * b + (1.0 - u - v) * c - 1e-6 * body.reach * normals
        found = wp.zeros(len(triangles), dtype=wp.float32, device=device)
        given = [on_device(begin), on_device(-normals), mesh.id, most, found]
        Launch(wall_kernel(), len(triangles), given, device).launch()
        thickness = np.minimum(thickness, found.numpy())
    body.__dict__["_walls"] = most, thickness
    return thickness


def thinnest(body: Tool, most: float) -> float:
    """How thick a tool is where it is thinnest [m]; of a mesh walls thinner than `most` [m] count."""
    whole = 2.0 * body.half_thickness
    return min(whole, float(wall_thickness(body, most).min())) if isinstance(body, MeshBody) else whole


def least_thickness(contact_distance: float, spacing: float) -> float:
    """Of a wall that holds soil with contact where it is, for a distance at which contact begins and a grid spacing
    [m]."""
    return max(0.0, 2.0 * (HOLDS * spacing - contact_distance))


def thickening(body: Tool, contact_distance: float, spacing: float) -> np.ndarray | None:
    """How far outside a mesh its surface has to be taken for thin walls to hold soil, at its vertices [m], shape (k,);
    None if nowhere.

    Soil is pushed back to the side that is nearer. So it goes through a wall as soon as it is pressed in to its middle.
    """
    if not isinstance(body, MeshBody):
        return None
    least = least_thickness(contact_distance, spacing)
    if least == 0.0:
        return None
    vertices, triangles = body.mesh
    missing = 0.5 * np.maximum(least - wall_thickness(body, least), 0.0)
    if not missing.any():
        return None
    found = np.zeros(len(vertices))
    np.maximum.at(found, triangles, missing[:, None])
    return found


def thin_walls(body: Tool, contact_distance: float, spacing: float) -> list[str]:
    """What a user should know of a tool's thin parts, with contact beginning at a distance on a grid [m]."""
    found, thickness = [], thinnest(body, 2.0 * spacing)
    if thickness < 1.999 * spacing:  # in single precision
        found.append(
            f"the tool's thinnest part is {1e3 * thickness:.3g} mm, {thickness / spacing:.2g} grid spacings; below 2 "
            "the soil on its two sides feels each other: use a smaller bed.spacing"
        )
    thicker = thickening(body, contact_distance, spacing)
    if thicker is not None:
        found.append(
            f"contact with the tool's thin walls begins up to {1e3 * thicker.max():.2g} mm further out, for soil not "
            f"to go through them; walls of {1e3 * least_thickness(contact_distance, spacing):.3g} mm need none"
        )
    return found


# --- Units: the one that a path or a tool was likely given in, where its numbers cannot be metres and seconds


_LENGTHS = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254}
_SHORT = {"millimetres": "mm", "centimetres": "cm", "inches": "in"}
_TIMES = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
_LONG = 50.0
"""What is so many times longer or shorter than what it belongs to, is odd."""
_CLOCK = 1e8
"""Seconds since 1970 in the year 1973."""


class Odd(NamedTuple):
    """What is odd about numbers, and whether nobody can mean it."""

    words: str
    sure: bool = False


def odd_size(body: Tool, size: tuple[float, float, float], open_sides: bool) -> Odd | None:
    """What is odd about a tool in a bin of `size` [m]; None if nothing is. With `open_sides` it may be wider than the
    bin. One up to ten times as long as the bin may have a long handle."""
    kept = [0, 2] if open_sides else [0, 1, 2]
    side, room = float(np.ptp(body.outline(), axis=0)[kept].max()), max(size[axis] for axis in kept)
    if room / _LONG <= side <= room:
        return None
    way = "longer than" if side > room else "less than 1/50 of"
    found = f"the tool is {side:.3g} m long, {way} the bin ({room:g} m)"
    taken = next((name for name, short in _SHORT.items() if short == getattr(body, "unit", "m")), "metres")
    metres = _LENGTHS.get(taken, 1.0)
    likely = _likely(_LENGTHS, lambda scale: room / _LONG <= scale / metres * side <= room)
    if likely:
        words = (
            f"{found}: its numbers look like {likely} and are taken as {taken} (of a mesh: scene.tool.unit)"
        )
        return Odd(words, side > 10.0 * room)
    if room / _LONG <= 1e3 * side <= room:
        return Odd(
            f"{found}: it was made a thousand times too small (of a mesh: scene.tool.unit, scale)", True
        )
    return Odd(f"{found}; lengths are in metres", side > 10.0 * room)


def place_unit(places: np.ndarray, size: tuple[float, float, float]) -> str:
    """The unit that positions (k, 3) of a path look like in a bin of `size` [m]; empty where it may be metres."""
    middle = np.array([0.5 * size[0], 0.5 * size[1], 0.0])
    room = np.array([size[0], size[1], max(size)])

    def fits(scale: float) -> bool:
        near = scale * places
        return bool((np.abs(near - middle) <= room).all()) and np.abs(near).max() >= 0.1 * max(size)

    return "" if (np.abs(places - middle) <= room).all() else _likely(_LENGTHS, fits)


def odd_times(times: np.ndarray, duration: float) -> Odd | None:
    """What is odd about the times of a path's rows in a run of `duration` [s]; None if nothing is."""
    first, last = float(times[0]), float(times[-1])
    found = f"the path's times are {first:.10g} to {last:.10g}, the run's 0 to {duration:.4g} s"
    likely = _likely(_TIMES, lambda scale: 0.1 <= scale * last / duration <= 10.0)
    unit = f"; they look like {likely} and are taken as seconds" if likely else ""
    if len(times) < 2:
        return None
    if first >= _CLOCK:
        return Odd(
            f"{found}: they look like those of a clock; subtract the first from all (in seconds)", True
        )
    if first >= duration or last <= 0.0:
        return Odd(f"{found}: the tool does not move{unit}", bool(likely))
    if last - first > _LONG * duration:
        used = 100.0 * (duration - first) / (last - first)
        return Odd(f"{found}: only the first {used:.2g} % is used{unit}", bool(likely))
    if _LONG * (last - first) < duration:
        return Odd(f"{found}: the tool rests for nearly all of it; are the times in seconds?")
    return None


def _likely(units: dict[str, float], fits: Callable[[float], bool]) -> str:
    return " or ".join(unit for unit, scale in units.items() if fits(scale))
