"""How long a step may be, and how many of them pass between two remaps."""

from __future__ import annotations

import math

import numpy as np

from .errors import SceneError
from .limits import MOST_STEPS, MOST_SUBSTEPS
from .material import Material
from .rigid_body import longest_step
from .scene import Bed, Scene

__all__ = ["damped_share", "steps_to_remap", "substeps_per_frame", "top_body_speed"]


def substeps_per_frame(scene: Scene) -> int:
    """Equal steps in a frame: as many as elastic waves, the body's motion and a free body's mass ask for.

    Raises:
        SceneError: more than limits.py allows in a frame or in all.
    """
    limit = scene.courant * scene.bed.spacing / (scene.material.wave_speed + top_body_speed(scene))
    limit *= damped_share(scene)
    limit = min(limit, longest_step(scene))
    count = 1.0 / scene.frame_rate / limit - 1e-9 if limit > 0.0 else math.inf
    total = count * (scene.frame_count - 1)
    if not count <= MOST_SUBSTEPS:
        raise SceneError(
            f"a frame would take {count:.3g} substeps of {limit:.3g} s; at most {MOST_SUBSTEPS:g} are allowed: "
            f"{_way_out(scene)}"
        )
    if not total <= MOST_STEPS:
        raise SceneError(
            f"the run would take {total:.3g} substeps, {count:.3g} in each of {scene.frame_count - 1} frames; at most "
            f"{MOST_STEPS:g} are allowed: lower scene.duration ({scene.duration:g} s), or {_way_out(scene)}"
        )
    return max(1, math.ceil(count))


def _way_out(scene: Scene) -> str:
    """What to change for fewer substeps: the key that asks for most of them beyond what the defaults would."""
    mass, speed, waves = longest_step(scene), top_body_speed(scene), scene.material.wave_speed
    if mass < damped_share(scene) * scene.courant * scene.bed.spacing / (waves + speed):
        kilograms = scene.axle.mass
        return (
            f"the body's mass of {kilograms:.3g} kg is too small for contact this stiff: raise scene.load or lower "
            "scene.gravity"
        )
    if speed > waves:
        return (
            f"the body moves at up to {speed:.3g} m/s: make its path or scene.speed, scene.rim_speed slower"
        )
    soil, usual = scene.material, Material()
    more = {  # key → by what it multiplies the number of steps
        "raise scene.bed.spacing": Bed.spacing / scene.bed.spacing,
        "raise scene.courant": Scene.courant / scene.courant,
        "raise scene.frame_rate": Scene.frame_rate / scene.frame_rate,
        "lower material.youngs_modulus": math.sqrt(soil.youngs_modulus / usual.youngs_modulus),
        "lower material.poissons_ratio": Material(poissons_ratio=soil.poissons_ratio).wave_speed
        / usual.wave_speed,
        "raise material.grain_density": math.sqrt(usual.grain_density / soil.grain_density),
        "raise material.packing": math.sqrt(usual.packing / soil.packing),
    }
    return max(more, key=lambda key: more[key])


def damped_share(scene: Scene) -> float:
    """Longest stable step of a damped oscillator over that of a free one [-]."""
    return math.sqrt(1.0 + scene.elastic_damping**2) - scene.elastic_damping


def top_body_speed(scene: Scene, step: float | None = None) -> float:
    """Fastest motion of any point of the body between frames and, with `step` [s], along its path within such a time
    [m/s]; a free height moves on top of it."""
    if scene.body is None:
        return 0.0
    times = scene.times()
    top = float(np.max(scene.ways(times), initial=0.0) * scene.frame_rate)
    rows = scene.path_times()
    if step is None or not len(rows):
        return top
    # Where a path is fastest, such a time begins or ends at one of its rows.
    begin = np.clip(np.concatenate([rows, rows - step]), 0.0, times[-1])
    every = np.unique(np.concatenate([[0.0], begin, begin + step]))
    travelled = np.concatenate([[0.0], np.cumsum(scene.ways(every))])
    way = np.interp(begin + step, every, travelled) - np.interp(begin, every, travelled)
    return max(top, float(way.max()) / step)


def steps_to_remap(scene: Scene, time_step: float, speed: float) -> int:
    """Number of steps of `time_step` [s] until momentum is carried to a fresh grid: 2^n or 3 2^n.

    Soil of at most `speed` [m/s] must not travel far from the place that its weights belong to: at most
    `scene.remap_distance` grid spacings, free fall included, and never longer than `scene.remap_time`.
    """
    room, limit = scene.remap_distance * scene.bed.spacing, scene.remap_time
    if speed * limit + scene.gravity * limit**2 > room:
        limit = 2.0 * room / (speed + math.sqrt(speed**2 + 4.0 * scene.gravity * room))
    most = max(1, int(limit / time_step * (1.0 + 1e-9)))
    # Few different numbers, because on a GPU each is recorded once.
    power = 1 << (most.bit_length() - 1)
    return power + power // 2 if most >= power + power // 2 else power
