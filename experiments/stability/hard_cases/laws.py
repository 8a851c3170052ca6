"""The stress update where its formulas end: no pressure, mu at mu_s and mu_2, grains of no size, inverted particles.

(No `from __future__ import annotations`: Warp reads the types of the kernel.)
"""

from dataclasses import replace
from functools import partial

import numpy as np
import warp as wp

from mpm_warp import Effects, Material, Solver
from sgns_testing.points import shear_stress, updated
from sgns_testing.scenes import block, cut

from .measures import frames_of

SAND = Material()
LAWS = {
    "constant friction": (Effects(rate_dependence=False), SAND),
    "saturating mu(I)": (Effects(), SAND),
    "linear mu(I)": (Effects(), replace(SAND, rate_law="linear")),
    "dynamic fluidity": (Effects(fluidity=True), SAND),
    "dynamic fluidity, linear": (Effects(fluidity=True), replace(SAND, rate_law="linear")),
    "steady nonlocality": (Effects(nonlocality=True), SAND),
    "both": (Effects(fluidity=True, nonlocality=True), SAND),
    "no separation": (Effects(separation=False), SAND),
}
"""Every law that a user can choose."""
DT = 2.0e-4  # [s]


def stepped(effects: Effects, material: Material, pressure, ratio, a=0.0, g=1.0, real=wp.float32):
    """Shear stress and pressure [Pa] and the new fluidity after a step at trial states.

    Args:
        pressure: [Pa], shape (n,).
        ratio: shear stress over pressure of the state before, shape (n,).
        a: dt times the velocity gradient, shape (3, 3).
        g: fluidity before, or the excess of cooperative flow [1/s].
    """
    pressure, ratio = (np.ravel(v).astype(float) for v in np.broadcast_arrays(pressure, ratio))
    strain = np.zeros((len(pressure), 3, 3))
    strain[:, 0, 1] = strain[:, 1, 0] = ratio * pressure / (2.0 * material.shear_modulus)
    ln_j = -pressure / material.bulk_modulus
    strain, ln_j, g = updated(material, strain, ln_j, a, DT, g=g, effects=effects, real=real)
    return shear_stress(material, strain), -material.bulk_modulus * ln_j, g


def no_pressure(law: str) -> tuple[float, str]:
    """Largest shear stress over what the law allows, at pressures from 1e-30 Pa up, and in a whole block [-].

    A law without such a bound may have what it had before the step.
    """
    effects, material = LAWS[law]
    pressure, ratio = np.meshgrid(
        10.0 ** np.arange(-30.0, 3.5, 0.5), [0.0, 1e-6, 0.5, 0.76, 0.9616, 2.0, 100.0]
    )
    shear = np.zeros((3, 3))
    shear[0, 2] = 1e-3
    worst = 0.0
    for a in (0.0, shear):
        tau, p, g = stepped(effects, material, pressure, ratio, a)
        if not (np.isfinite(tau).all() and np.isfinite(p).all() and np.isfinite(g).all()):
            return np.nan, "the update at a point is not finite"
        most = material.limit_friction * np.maximum(p, 0.0)
        if material.rate_law == "linear":
            trial = ratio.ravel() * pressure.ravel() + material.shear_modulus * 1e-3 * np.any(a)
            most = np.maximum(most, 1.001 * trial)
        # Where stress has no meaning in single precision any more, it must be negligible.
        worst = max(worst, float(np.max(tau / (most + 1e-6))))
    scene = block(duration=0.05, frame_rate=20.0, material=material)
    solver = Solver(scene, effects)
    turning = np.cross([3.0, -2.0, 5.0], scene.initial_positions() - 0.15)
    solver.particles.velocity.assign(turning + 0.2 * np.random.default_rng(0).normal(size=turning.shape))
    start = solver.particles.velocity.numpy().astype(float)
    for _ in solver.frames():
        pass
    lost = np.linalg.norm(np.sum(solver.particles.velocity.numpy() - start, axis=0)) / np.abs(start).sum()
    words = f"shear stress {worst:.3g} of its bound; momentum lost {lost:.2g} (1e-4)"
    return max(worst, float(lost) / 1e-4), words


def near(friction: str, laws: tuple[str, ...]) -> tuple[float, str]:
    """Jump of mu between trial ratios next to each other around mu_s or mu_2, beyond their distance [-].

    The return is a contraction: it never moves two states apart.
    """
    offsets = np.concatenate([-np.logspace(-1, -13, 60), [0.0], np.logspace(-13, -1, 60)])
    worst, where = 0.0, ""
    for name in laws:
        effects, material = LAWS[name]
        centre = getattr(material, f"{friction}_friction")
        for pressure in (1.0, 1e3, 1e5):
            for g in (0.0, 1e-6, 1.0, 1e4):
                tau, p, after = stepped(effects, material, pressure, centre + offsets, g=g, real=wp.float64)
                mu = tau / p
                if not (np.isfinite(mu).all() and np.isfinite(after).all()):
                    return np.nan, f"{name} at {pressure:g} Pa, g {g:g} 1/s is not finite"
                jump = np.abs(np.diff(mu)) - np.diff(offsets)
                found = max(float(jump.max()), float(mu.max() - material.limit_friction))
                if found > worst:
                    worst, where = found, f"{name} at {pressure:g} Pa, g {g:g} 1/s"
    return worst, where


def tiny_grains(effects: Effects) -> float:
    """Change of a cut's force between grains of 1 nm and constant friction mu_s [%].

    The fluidity's own dynamics, which have nothing to do with d, are as good as at once. The times of the numerics,
    which have, are those of the sand.
    """
    force, numerics = [], {"remap_time": cut().remap_limit, "velocity_memory": cut().memory_time}
    for chosen, material in (
        (effects, replace(SAND, grain_diameter=1e-9, fluidity_time=1e-8)),
        (Effects(rate_dependence=False), SAND),
    ):
        frames = frames_of(cut(material=material, **numerics), effects=chosen)
        force.append(np.mean([f.force for f in frames[6:]], axis=0))
    return 100.0 * float(np.linalg.norm(force[0] - force[1]) / np.linalg.norm(force[1]))


def huge_grains() -> tuple[float, str]:
    force, stronger = [], replace(SAND, static_friction=SAND.limit_friction, limit_friction=1.2)
    for effects, material in (
        (Effects(), replace(SAND, grain_diameter=10.0)),
        (Effects(rate_dependence=False), stronger),
    ):
        frames = frames_of(cut(material=material), effects=effects)
        force.append(float(np.linalg.norm(np.mean([f.force for f in frames[6:]], axis=0))))
    return max(0.0, 100.0 * (force[0] / force[1] - 1.0)), f"{force[0]:.4g} N, {force[1]:.4g} N"


def inverted() -> tuple[float, str]:
    """Shear stress over its bound after steps that turn a particle inside out, or stretch it by e^8 [-]."""
    worst = 0.0
    flat = [np.diag([squeezed, 0.0, 0.0]) for squeezed in (-3.0, -1.0)]
    for a in (-2.5 * np.eye(3), *flat, np.full((3, 3), 50.0), 3e3 * np.eye(3)):
        tau, p, _ = stepped(Effects(), SAND, np.logspace(-3, 5, 9), 0.5, a)
        if not (np.isfinite(tau).all() and np.isfinite(p).all()):
            return np.nan, f"not finite after {a.tolist()}"
        worst = max(worst, float(np.max(tau / (SAND.limit_friction * np.maximum(p, 0.0) + 1e-6))))
    return worst, ""


MEASURES = {
    **{f"no pressure: {law}": partial(no_pressure, law) for law in LAWS},
    **{
        f"mu at mu_{number}{which}": partial(near, friction, laws)
        for friction, number in (("static", "s"), ("limit", "2"))
        for which, laws in (
            ("", ("saturating mu(I)", "steady nonlocality")),
            (", dynamic fluidity", ("dynamic fluidity",)),
        )
    },
    "grains of 1 nm, mu(I)": partial(tiny_grains, Effects()),
    "grains of 1 nm, dynamic fluidity": partial(tiny_grains, Effects(fluidity=True)),
    "grains of 1 nm, steady nonlocality": partial(tiny_grains, Effects(nonlocality=True)),
    "grains of 10 m": huge_grains,
    "particles turned inside out": inverted,
}
