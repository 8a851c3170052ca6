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
    """Volume gain of settled soil [-]: how much less soil than in a full bed is around the inner points.

    The points are the middles of the grid's cells, and the density there is the sum of quadratic splines one grid
    spacing wide: that of a lattice of any spacing is 1 to a percent, where counts of particles in blocks of the bin
    would tell how the lattice and the blocks happen to lie. Soil goes on beyond walls and floor as its mirror image. A
    point is inner where there is soil two cells from it on every side. Negative gains, soil that has become denser,
    count as they are.
    """
    bed = scene.bed
    count = [round(s / bed.spacing) for s in (*bed.size[:2], bed.size[2] + bed.headroom)]
    place = (position - [0.0, 0.0, -bed.size[2]]) / bed.spacing - 0.5
    lowest = np.floor(place - 0.5).astype(int)
    off = place - lowest
    weights = [0.5 * (1.5 - off) ** 2, 0.75 - (off - 1.0) ** 2, 0.5 * (off - 0.5) ** 2]
    density = np.zeros(count)
    for shift in np.ndindex(3, 3, 3):
        node = lowest + shift
        node = np.where(node < 0, -1 - node, node)
        node = np.where(node >= count, 2 * np.array(count) - 1 - node, node)
        inside = np.all((node >= 0) & (node < count), axis=1)
        weight = np.prod([weights[n][:, axis] for axis, n in enumerate(shift)], axis=0)
        np.add.at(density, tuple(node[inside].T), weight[inside])
    density *= scene.filled[1] / bed.spacing**3
    filled = np.pad(density > 0.25, 2, constant_values=True)
    filled[:, :, -2:] = False
    inner = density > 0.25
    for axis in range(3):
        for shift in (-2, -1, 1, 2):
            inner &= np.roll(filled, shift, axis)[2:-2, 2:-2, 2:-2]
    if not inner.any():
        raise ValueError("no point of the bed is surrounded by soil")
    return 1.0 / float(density[inner].mean()) - 1.0


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
