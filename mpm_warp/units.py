"""The unit that a path or a tool was likely given in, where its numbers cannot be metres and seconds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

_LENGTHS = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254}
_TIMES = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
_LONG = 50.0
"""What is so many times longer or shorter than what it belongs to, is odd."""
_CLOCK = 1e8
"""Seconds since 1970 in the year 1973."""


def size_warning(outline: np.ndarray, size: tuple[float, float, float], open_sides: bool) -> str | None:
    """What is odd about a tool with surface points (k, 3) in a bin of `size` [m]; None if nothing is. With
    `open_sides` it may be wider than the bin."""
    kept = [0, 2] if open_sides else [0, 1, 2]
    side, room = float(np.ptp(outline, axis=0)[kept].max()), max(size[axis] for axis in kept)
    if room / _LONG <= side <= room:
        return None
    way = "longer than" if side > room else "less than 1/50 of"
    found = f"the tool is {side:.3g} m long, {way} the bin ({room:g} m)"
    likely = _likely(_LENGTHS, lambda scale: room / _LONG <= scale * side <= room)
    if likely:
        return f"{found}: its numbers look like {likely} and are taken as metres (of a mesh: scene.tool.unit)"
    if room / _LONG <= 1e3 * side <= room:
        return f"{found}: it was made a thousand times too small (of a mesh: scene.tool.unit, scale)"
    return f"{found}; lengths are in metres"


def place_unit(places: np.ndarray, size: tuple[float, float, float]) -> str:
    """The unit that positions (k, 3) of a path look like in a bin of `size` [m]; empty where it may be metres."""
    middle = np.array([0.5 * size[0], 0.5 * size[1], 0.0])
    room = np.array([size[0], size[1], max(size)])

    def fits(scale: float) -> bool:
        near = scale * places
        return bool((np.abs(near - middle) <= room).all()) and np.abs(near).max() >= 0.1 * max(size)

    return "" if (np.abs(places - middle) <= room).all() else _likely(_LENGTHS, fits)


def time_warning(times: np.ndarray, duration: float) -> str | None:
    """What is odd about the times of a path's rows in a run of `duration` [s]; None if nothing is."""
    first, last = float(times[0]), float(times[-1])
    found = f"the path's times are {first:.10g} to {last:.10g}, the run's 0 to {duration:.4g} s"
    likely = _likely(_TIMES, lambda scale: 0.1 <= scale * last / duration <= 10.0)
    likely = f"; they look like {likely} and are taken as seconds" if likely else ""
    if len(times) < 2:
        return None
    if first >= _CLOCK:
        return f"{found}: they look like those of a clock; subtract the first from all (in seconds)"
    if first >= duration or last <= 0.0:
        return f"{found}: the tool does not move{likely}"
    if last - first > _LONG * duration:
        return f"{found}: only the first {100.0 * (duration - first) / (last - first):.2g} % is used{likely}"
    if _LONG * (last - first) < duration:
        return f"{found}: the tool rests for nearly all of it; are the times in seconds?"
    return None


def _likely(units: dict[str, float], fits: Callable[[float], bool]) -> str:
    return " or ".join(unit for unit, scale in units.items() if fits(scale))
