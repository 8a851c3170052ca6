"""What hard cases measure. All are 0 or more, and the smaller the better."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
from leakage import leakage

from mpm_warp import Frame, Scene, SceneError, Solver, SolverStopped
from mpm_warp.poses import rotate
from sgns.config import UserError


def frames_of(scene: Scene, every: int = 1, **settings) -> list[Frame]:
    """All frames of a scene, or one of `every` and the last."""
    frames = Solver(scene, **settings).frames()
    last = scene.frame_count - 1
    return [f for f in frames if f.index % every == 0 or f.index == last]


def volume_gain(scene: Scene, position: np.ndarray) -> float:
    """Volume gain of settled soil [-]: how much less soil than at the start is in the middle of the bed's inner blocks.

    The bin is cut into blocks of 2 x 2 x 2 grid cells. A block is inner where it and all its neighbours hold soil;
    what lies beyond walls and floor counts as full. Negative gains, soil that has become denser, count as they are.
    """
    bed, edge = scene.bed, 2.0 * scene.bed.spacing
    count = [round(s / edge) for s in bed.size[:2]] + [int((bed.size[2] + bed.headroom) / edge)]
    place = np.floor((position - [0.0, 0.0, -bed.size[2]]) / edge).astype(int)
    place = place[np.all((place >= 0) & (place < count), axis=1)]
    blocks = np.zeros(count)
    np.add.at(blocks, tuple(place.T), 1.0)
    nominal = 8.0 * bed.particles_per_cell
    filled = np.pad(blocks > 0.25 * nominal, 1, constant_values=True)
    filled[:, :, -1] = False
    inner = filled[1:-1, 1:-1, 1:-1].copy()
    for axis in range(3):
        for shift in (-1, 1):
            inner &= np.roll(filled, shift, axis)[1:-1, 1:-1, 1:-1]
    if not inner.any():
        raise ValueError("no block of the bed is surrounded by soil")
    return nominal / float(blocks[inner].mean()) - 1.0


def blade_force(scene: Scene, frames: list[Frame]) -> float:
    """A generous estimate of the most soil can do to a blade [N], from its strength in plane strain (sin phi = mu_s).

    Passive pressure with a heap as high as the cut is deep on top of it, and the bearing capacity of the blade's end
    (Vesic's factors).
    """
    soil, (hx, hy, _) = scene.material, scene.body.half_size
    weight = soil.bulk_density * scene.gravity
    lowest = min((f.body_pose[2] + rotate(f.body_pose[3:], scene.body.outline())[:, 2].min()) for f in frames)
    depth = max(-lowest, 0.5 * scene.bed.spacing)
    sine = min(soil.static_friction, 0.95)
    ratio, tangent = (1.0 + sine) / (1.0 - sine), sine / np.sqrt(1.0 - sine**2)
    passive = ratio * 0.5 * weight * (2.0 * depth) ** 2 * 2.0 * hy
    surcharge = np.exp(np.pi * tangent) * ratio
    own = 2.0 * (surcharge + 1.0) * tangent
    end = 4.0 * hx * hy * (weight * hx * own + weight * depth * surcharge)
    return float(passive + end)


def top_speed(frames: Iterable[Frame]) -> float:
    """Of any particle in any frame [m/s]."""
    return max(float(np.linalg.norm(f.velocity, axis=1).max()) for f in frames)


def energies(scene: Scene, frames: Iterable[Frame]) -> np.ndarray:
    """Kinetic energy and potential energy above the floor of the soil [J], shape (T,)."""
    mass = scene.filled[1] * scene.material.bulk_density
    found = []
    for frame in frames:
        height = frame.position[:, 2].astype(float) + scene.bed.size[2]
        kinetic = 0.5 * np.sum(frame.velocity.astype(float) ** 2)
        found.append(mass * (kinetic + scene.gravity * np.sum(height)))
    return np.array(found)


def work_on_soil(frames: list[Frame]) -> np.ndarray:
    """Done on the soil by a body that does not turn, since the first frame [J], shape (T,)."""
    way = np.diff([f.body_pose[:3] for f in frames], axis=0)
    force = np.array([f.force for f in frames[1:]])
    return np.concatenate([[0.0], np.cumsum(-np.sum(force * way, axis=1))])


def shares(found: Mapping[str, tuple[float, float, str]]) -> tuple[float, str]:
    """The largest of several quantities, each as a share of its limit; the note has all of them.

    Args:
        found: name -> value, limit, unit.
    """
    words = [f"{name} {value:.3g} of {limit:.3g} {unit}" for name, (value, limit, unit) in found.items()]
    worst = [np.maximum(0.0, value) / limit for value, limit, _ in found.values()]  # a NaN stays one
    return float(np.max(worst)), "; ".join(words)


def blade_shares(scene: Scene, frames: list[Frame], gain: float = 3.0) -> tuple[float, str]:
    """What must hold of any cut: bounded force and speed, no leak, soil that keeps its volume (to `gain` %)."""
    force = max(float(np.linalg.norm(f.force)) for f in frames[1:])
    way = np.diff([f.body_pose[:3] for f in frames], axis=0)
    body_speed = float(np.linalg.norm(way, axis=1).max()) * scene.frame_rate
    drop = np.sqrt(2.0 * scene.gravity * (scene.bed.size[2] + scene.bed.headroom))
    return shares(
        {
            "force": (force, blade_force(scene, frames), "N"),
            "speed": (top_speed(frames), 2.0 * body_speed + drop, "m/s"),
            "leakage": (100.0 * leakage(frames, scene.body), 1.0, "%"),
            "volume gain": (100.0 * volume_gain(scene, frames[-1].position), gain, "%"),
        }
    )


def refused(make: Callable[[], object], words: str) -> tuple[float, str]:
    """0 if `make` is refused with a line that has `words` in it, else 1."""
    try:
        make()
    except SceneError as error:
        return float(words not in str(error)), str(error)
    return 1.0, "it was accepted"


def stopped_with(scene: Scene, words: str, **settings) -> tuple[float, str]:
    """0 if the solver stops with a line that has `words` in it, else 1."""
    try:
        for _ in Solver(scene, **settings).frames():
            pass
    except SolverStopped as error:
        return float(words not in str(error) or "\n" in str(error)), str(error)
    return 1.0, "it went on to the end"


def unsaid(act: Callable[[], Any], *words: str) -> tuple[float, str]:
    """How many of some words the one line of a refusal lacks; NaN if nothing is refused."""
    try:
        act()
    except UserError as error:
        line = str(error)
        lacking = [word for word in words if word not in line]
        return len(lacking) + line.count("\n"), f"lacks {', '.join(lacking)}: {line}" if lacking else ""
    return math.nan, "nothing was refused"
