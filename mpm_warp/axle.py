"""A body whose height is free: it carries a load and rests on the soil.

One thread on the device moves it once per substep with the impulse the soil gave it, so nothing waits for the host and
the step can be part of a captured graph. Height and speed are kept in double precision whatever the solver's: in
single precision a height of 0.15 m moves in steps of 1.5e-8 m, and a wheel that sinks slower than one such step per
substep would hang in the air.
"""

import math
from dataclasses import dataclass
from functools import cache

import warp as wp

from .launches import SceneKernel, scene_kernel

__all__ = ["Axle", "axle_step", "stable_step"]


@dataclass(frozen=True)
class Axle:
    """The vertical motion of a body whose other motions are prescribed."""

    mass: float
    """[kg]; gravity acts on it."""
    damping: float = 0.0
    """Force against the vertical velocity per mass [1/s]."""


@cache
def axle_step(real: type) -> SceneKernel:
    """Kernel of one thread: symplectic Euler with the damping taken implicitly."""
    vec3 = wp.types.vector(3, real)

    @scene_kernel()
    def step(
        _: int,
        axle: wp.array(
            dtype=wp.float64
        ),  # height [m], its rate [m/s], vertical impulse of this frame so far [N s]
        impulse: wp.array(dtype=vec3),
        dt: wp.float64,
        mass: wp.float64,
        gravity: wp.float64,
        damping: wp.float64,
    ):
        total = wp.float64(impulse[0][2])
        gained = total - axle[2]
        axle[2] = total
        axle[1] = (axle[1] + gained / mass - dt * gravity) / (wp.float64(1.0) + dt * damping)
        axle[0] = axle[0] + dt * axle[1]

    return step


def stable_step(mass: float, contacts: float, stiffness: float, damping: float) -> float:
    """Longest substep [s] in which a free body on springs is stable, with a margin of two.

    On N springs k with dampers c at rest in the soil, a step dt changes the body's velocity by the share
    q = N (k dt^2 + c dt) / M of what it would take to stop it; symplectic Euler with a lagged damper is stable
    for q below 2. The step returned has q = 1.

    Args:
        mass: M of the body [kg].
        contacts: N, the most particles that can touch it at once.
        stiffness: k [N/m].
        damping: c [N s/m].
    """
    a, b = contacts * stiffness / mass, contacts * damping / mass
    return 2.0 / (b + math.sqrt(b * b + 4.0 * a))
