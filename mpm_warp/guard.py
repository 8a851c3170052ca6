"""Where a solver has to stop: values that are not finite, or that soil cannot have."""

from __future__ import annotations

import math

import numpy as np

from .scene import Scene
from .time_step import damped_share, top_body_speed

__all__ = ["Guard", "speed_bound"]

LARGEST_STRAIN = 1.0
"""Of the elastic log strain: soil at 37 % of its volume. The elastic law means nothing there."""

STABLE_COURANT = 0.84
"""Longest step that was found stable, over what theory gives for waves along one axis [-]; `MOST_COURANT` of scene.py
leaves soil room to become stiffer."""


def speed_bound(scene: Scene, time_step: float) -> float:
    """Speed [m/s] that no soil of a scene can reach, computed in steps of `time_step` [s].

    Four times the sum of what it has at the start, of the fastest point of the body and of a fall through the whole
    grid (or, down an endless slope, of a fall for as long as the scene lasts), and half the speed of its waves for what
    elastic strain can give back.
    """
    bed = scene.bed
    start = float(np.linalg.norm(scene.initial_velocities(), axis=1).max(initial=0.0))
    height = bed.size[2] + bed.headroom + abs(math.sin(math.radians(scene.tilt))) * bed.size[0]
    fall = math.sqrt(2.0 * scene.gravity * height)
    if bed.walls.kinds[0] == "periodic" and scene.tilt:
        fall = max(fall, scene.gravity * scene.duration)
    return 4.0 * (start + top_body_speed(scene, time_step) + fall) + 0.5 * scene.material.wave_speed


class Guard:
    """Knows what soil cannot do, and what is to blame when it does.

    Args:
        scene: what is computed.
        time_step: substep [s].
    """

    def __init__(self, scene: Scene, time_step: float) -> None:
        self._time_step = time_step
        self.speed_bound = speed_bound(scene, time_step)
        # Compressed soil is stiffer: its waves are faster by sqrt(1 - ln J).
        stable = damped_share(scene) * scene.bed.spacing / scene.material.wave_speed
        self._most_compression = min(LARGEST_STRAIN, (STABLE_COURANT * stable / time_step) ** 2 - 1.0)

    def too_fast(self, speed: float) -> str:
        """The cause for soil faster than the bound."""
        return (
            f"it moves at {speed:.3g} m/s, which nothing here can cause ({self.speed_bound:.3g} m/s at most): lower "
            "scene.courant"
        )

    def strayed(self, near: bool) -> str:
        """The cause for a particle that the kernels left where it was; `near` its place at the last remap or not."""
        if near:
            return "it left the grid: soil was thrown or pushed beyond it, raise scene.bed.headroom"
        return (
            "its speed is not finite or carried it further than a cell between two remaps: lower scene.courant or the "
            "body's speed"
        )

    def too_strained(self, ln_j: np.ndarray, strain: np.ndarray) -> tuple[int, str] | None:
        """The first particle whose elastic strain cannot be, and why; None if there is none.

        Args:
            ln_j: log of the volume (n,).
            strain: deviatoric part (n, 6) [-].
        """
        lowest, largest = ln_j.min(), max(strain.max(), -strain.min())  # a NaN makes both comparisons false
        if lowest > -self._most_compression and largest < LARGEST_STRAIN:
            return None
        sheared = np.abs(strain).max(axis=1)
        particle = int(np.argmax(~((ln_j > -self._most_compression) & (sheared < LARGEST_STRAIN))))
        volume, shear = ln_j[particle], sheared[particle]
        if not np.isfinite(volume + shear):
            return particle, "its strain is not finite: lower scene.courant"
        left = f"{100.0 * math.exp(volume):.3g} % of its volume"
        if volume > -LARGEST_STRAIN and shear < LARGEST_STRAIN:
            return particle, (
                f"it is compressed to {left}, where waves are too fast for steps of {self._time_step:.3g} s: lower "
                "scene.courant or raise material.youngs_modulus"
            )
        return particle, (
            f"it is strained to {left} and by {shear:.2g} in shear, more than elastic soil can be: raise "
            "material.youngs_modulus or lower the body's speed"
        )

    def lost_fluidity(self, excess: np.ndarray) -> tuple[int, str] | None:
        """The first particle to which cooperative flow gave a fluidity that is no number, and why; None if there is
        none. Its stress does not show it: without a fluidity soil is elastic.

        Args:
            excess: what the grid gave the particles (n,) [1/s].
        """
        lost = ~np.isfinite(excess)
        if not lost.any():
            return None
        return int(
            np.argmax(lost)
        ), "its fluidity is not finite: lower scene.courant or set effects.nonlocality=false"
