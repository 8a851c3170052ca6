"""Steps near their limit, soft and stiff soil, precision, very many steps."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

import numpy as np

from mpm_warp import Bed, Effects, Material, Scene, Solver, Walls
from mpm_warp.scene import MOST_COURANT
from sgns_testing.scenes import cut

from .measures import blade_shares, frames_of, refused, stopped_with

ELASTIC = Effects(yielding=False, rate_dependence=False)


@cache
def mean_force(share: float, **changes) -> np.ndarray:
    """Of the second half of a short cut at a share of the longest step [N]."""
    frames = frames_of(cut(courant=share * MOST_COURANT, **changes))
    return np.mean([f.force for f in frames[len(frames) // 2 :]], axis=0)


def step_error(share: float) -> float:
    exact = mean_force(0.1)
    return 100.0 * float(np.linalg.norm(mean_force(share) - exact) / np.linalg.norm(exact))


def chain_sinking(material: Material, height: float, damping: float, frames: int, interval: float):
    """How far the top of an elastic column that is let go has sunk at each frame [m].

    A chain of elements under the stress M ln J / J, M the confined modulus, of a strain with the viscous time `damping`
    [s], and none where ln J >= 0.
    """
    count, modulus = 80, material.wave_speed**2 * material.bulk_density
    dx = height / count
    longest = min(0.3 * dx / material.wave_speed, 0.2 * dx**2 / (material.wave_speed**2 * damping))
    steps = int(np.ceil(interval / longest))
    dt, x, v, before = interval / steps, np.arange(count + 1) * dx, np.zeros(count + 1), np.zeros(count)
    mass = np.full(count + 1, material.bulk_density * dx)
    mass[-1] /= 2.0
    found = [0.0]
    for step in range(1, steps * (frames - 1) + 1):
        stretch = np.diff(x) / dx
        ln_j = np.log(stretch)
        damped = np.minimum(ln_j + damping / dt * (ln_j - before), 0.5 * ln_j)
        stress, before = np.where(ln_j < 0.0, modulus * damped / stretch, 0.0), ln_j
        v += dt * (np.diff(stress, prepend=0.0, append=0.0) / mass - 9.81)
        v[0] = 0.0
        x += dt * v
        if step % steps == 0:
            found.append(height - x[-1])
    return np.array(found)


def settling_error(youngs_modulus: float) -> tuple[float, str]:
    """Of the mean sinking of a confined elastic column that bounces under its own weight, however large its strains
    [%]. It bounces much longer than this, and at 10 kPa not about the height of rest: its top flies for a while."""
    height, material = 0.16, Material(youngs_modulus=youngs_modulus)
    size, walls = (0.04, 0.04, height), Walls("slip", "slip", "slip")
    bed = Bed(size=size, spacing=0.01, initial_stress="none", headroom=0.02, walls=walls)
    period = 4.0 * height / material.wave_speed
    scene = Scene(bed=bed, material=material, duration=6.0 * period, frame_rate=40.0 / period, courant=0.4)
    start = scene.initial_positions()[:, 2]
    top = start > start.max() - 1e-6
    frames = frames_of(scene, effects=ELASTIC)
    judged = slice(len(frames) // 6, None)
    viscous_time = scene.elastic_damping * bed.spacing / material.wave_speed
    exact = float(
        chain_sinking(material, height, viscous_time, len(frames), 1.0 / scene.frame_rate)[judged].mean()
    )
    sink = float(np.mean([np.mean(start[top] - f.position[top, 2]) for f in frames[judged]]))
    return 100.0 * abs(sink / exact - 1.0), f"sinks {1e3 * sink:.4g} mm, exact {1e3 * exact:.4g} mm"


def soft_or_stiff_cut(youngs_modulus: float) -> tuple[float, str]:
    scene = cut(material=Material(youngs_modulus=youngs_modulus))
    return blade_shares(scene, frames_of(scene))


def precision_gap(quantity: str) -> float:
    one, two = (frames_of(cut(), precision=p) for p in ("float32", "float64"))
    if quantity == "force":
        a, b = (np.mean([f.force for f in frames[6:]], axis=0) for frames in (one, two))
        return 100.0 * float(np.linalg.norm(a - b) / np.linalg.norm(b))
    return 1000.0 * float(np.abs(one[-1].position - two[-1].position).max())


def creep_in_float32() -> float:
    """Displacement of a resting bed in 20 s [mm]; single steps move soil by less than float32 can add to a position."""
    scene = replace(cut(), bed=replace(cut().bed, spacing=0.04), motion="rest", clearance=0.05, duration=20.0)
    scene = replace(scene, blade=replace(scene.blade, thickness=0.09))
    last = frames_of(scene, every=10**6)[-1]
    return 1000.0 * float(np.abs(last.position - scene.initial_positions()).max())


def a_million_steps() -> tuple[float, str]:
    bed = Bed(size=(0.08, 0.08, 0.06), spacing=0.02, headroom=0.02)
    scene = Scene(bed=bed, duration=1.0, frame_rate=1.0)
    substeps = Solver(scene).substeps_per_frame
    scene = replace(scene, duration=float(-(-1_000_000 // substeps)))
    last = frames_of(scene, every=10**6)[-1]
    moved = 1000.0 * float(np.abs(last.position - scene.initial_positions()).max())
    return moved, f"{(scene.frame_count - 1) * substeps} substeps, {scene.duration:g} s"


def twice(effects: Effects) -> float:
    bed = replace(cut().bed, arrangement="jittered", seed=3)
    one, two = (frames_of(cut(bed=bed, duration=0.1), effects=effects) for _ in range(2))
    pairs = zip(one, two, strict=True)
    return float(sum(np.sum(a.position != b.position) + np.sum(a.force != b.force) for a, b in pairs))


def compressed_beyond_the_step() -> tuple[float, str]:
    """Soil at E = 10 kPa is compressed by a quarter, where the longest step is too long. (Frames are long, so that the
    step is not much shortened to fit into one.)"""
    scene = cut(material=Material(youngs_modulus=1e4), courant=MOST_COURANT, motion="rest", clearance=0.05)
    return stopped_with(replace(scene, frame_rate=5.0, duration=0.4), "waves are too fast for steps")


MEASURES = {
    **{f"step at {share:g} of its limit": partial(step_error, share) for share in (0.2, 0.5, 0.9, 1.0)},
    "step at 1.05 of its limit": partial(
        refused, lambda: cut(courant=1.05 * MOST_COURANT), f"allowed: 0.0001 to {MOST_COURANT}"
    ),
    "soil stiffens beyond its step": compressed_beyond_the_step,
    **{f"E = {e:.0e} Pa, column settles": partial(settling_error, e) for e in (1e4, 1e5, 1e6, 1e7, 1e8)},
    **{f"E = {e:.0e} Pa, cut": partial(soft_or_stiff_cut, e) for e in (1e4, 1e8)},
    "float32 against float64, force": partial(precision_gap, "force"),
    "float32 against float64, positions": partial(precision_gap, "position"),
    "bed at rest for 20 s in float32": creep_in_float32,
    "a million substeps": a_million_steps,
    "same seed twice": partial(twice, Effects()),
    "same seed twice, steady nonlocality": partial(twice, Effects(nonlocality=True)),
}
