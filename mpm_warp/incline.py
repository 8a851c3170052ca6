"""A layer of soil on an endless rough slope."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .errors import SceneError
from .scene import Scene

__all__ = ["Incline"]


@dataclass(frozen=True)
class Incline(Scene):
    """A layer as thick as the bed, tilted; meant for a bed that is periodic in x."""

    name: str = "incline"
    kind: str = "incline"
    flowing: bool = True
    """Start in the steady flow of mu(I) down the slope (Bagnold's profile); off: start at rest."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.flowing, bool):
            raise SceneError(f"scene.flowing is {self.flowing!r}; allowed: true, false")
        if self.flowing and not self._flows:
            low, high = self._flowing_angles
            raise SceneError(
                f"scene.tilt is {self.tilt} degrees; this soil flows steadily between {low:.2f} and {high:.2f} "
                "degrees: choose such a tilt or start at rest with scene.flowing=false"
            )

    @property
    def _flowing_angles(self) -> tuple[float, float]:
        """Slopes at which the soil flows without stopping or accelerating for ever [degrees]."""
        friction = (self.material.static_friction, self.material.limit_friction)
        return tuple(math.degrees(math.atan(mu)) for mu in friction)

    @property
    def _flows(self) -> bool:
        low, high = self._flowing_angles
        return low < self.tilt < high

    @property
    def inertial_number(self) -> float:
        """I of the steady flow, the same at every depth [-]."""
        if not self._flows:
            return 0.0
        soil, slope = self.material, math.tan(math.radians(self.tilt))
        return soil.reference_inertial_number * (slope - soil.static_friction) / (soil.limit_friction - slope)

    def steady_velocity(self, height: np.ndarray) -> np.ndarray:
        """Speed down the slope of the steady flow at heights above the base [m], in [m/s] (Bagnold's profile)."""
        soil, thickness = self.material, self.bed.size[2]
        fall = self.gravity * math.cos(math.radians(self.tilt))
        scale = 2.0 * self.inertial_number / (3.0 * soil.grain_diameter) * math.sqrt(soil.packing * fall)
        return scale * (thickness**1.5 - np.clip(thickness - height, 0.0, thickness) ** 1.5)

    def initial_velocities(self) -> np.ndarray:
        velocities = super().initial_velocities()
        if self.flowing:
            velocities[:, 0] = self.steady_velocity(self.filled[0][:, 2] + self.bed.size[2])
        return velocities
