"""Soil parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass

from .errors import SceneError

__all__ = ["Material"]


@dataclass(frozen=True)
class Material:
    """Dry granular soil: Hencky elasticity with rate-dependent friction mu(I).

    The defaults are the sand of the paper's excavation runs (A. Haeri, K. Skonieczny) except for the
    stiffness: 1 MPa instead of 15 MPa, which makes the explicit step almost four times longer.
    """

    youngs_modulus: float = 1.0e6
    """Young's modulus E [Pa]. The cost of a run grows with its square root."""
    poissons_ratio: float = 0.3
    """Poisson's ratio [-]."""
    grain_density: float = 2583.0
    """Density of the grain material [kg/m^3]."""
    packing: float = 0.67
    """Solid volume fraction at the critical density [-]."""
    grain_diameter: float = 3.0e-4
    """Grain diameter d [m]."""
    static_friction: float = 0.76
    """mu_s: ratio of shear stress to pressure below which the soil does not flow [-]."""
    limit_friction: float = 0.9616
    """mu_2: the ratio approached in very fast flow [-]."""
    reference_inertial_number: float = 0.278
    """I_0 of the saturating law mu(I) = mu_s + (mu_2 - mu_s) / (1 + I_0 / I) [-]."""

    def __post_init__(self) -> None:
        positive = ("youngs_modulus", "grain_density", "grain_diameter", "reference_inertial_number")
        for name in positive:
            value = getattr(self, name)
            if not (isinstance(value, (int, float)) and math.isfinite(value) and value > 0):
                raise SceneError(f"material.{name} is {value}; it must be a number above 0")
        if not 0.0 <= self.poissons_ratio < 0.5:
            raise SceneError(
                f"material.poissons_ratio is {self.poissons_ratio}; allowed: 0 up to, not including, 0.5"
            )
        if not 0.0 < self.packing <= 1.0:
            raise SceneError(f"material.packing is {self.packing}; allowed: above 0, at most 1")
        if not self.static_friction > 0.0:
            raise SceneError(f"material.static_friction is {self.static_friction}; it must be above 0")
        if not self.limit_friction > self.static_friction:
            raise SceneError(
                f"material.limit_friction is {self.limit_friction}; it must be above material.static_friction "
                f"({self.static_friction})"
            )

    @property
    def bulk_density(self) -> float:
        """Density of the soil at its critical packing [kg/m^3]."""
        return self.grain_density * self.packing

    @property
    def shear_modulus(self) -> float:
        """G [Pa]."""
        return self.youngs_modulus / (2.0 * (1.0 + self.poissons_ratio))

    @property
    def bulk_modulus(self) -> float:
        """K [Pa]."""
        return self.youngs_modulus / (3.0 * (1.0 - 2.0 * self.poissons_ratio))

    @property
    def wave_speed(self) -> float:
        """Speed of confined compression waves, sqrt((K + 4 G / 3) / rho) [m/s]."""
        return math.sqrt((self.bulk_modulus + 4.0 * self.shear_modulus / 3.0) / self.bulk_density)

    @property
    def lateral_stress_ratio(self) -> float:
        """K0 = nu / (1 - nu), horizontal over vertical stress of an elastic bed at rest [-]."""
        return self.poissons_ratio / (1.0 - self.poissons_ratio)

    @property
    def rest_stress_yields(self) -> bool:
        """True when the elastic K0 state lies outside the friction cone (a warning, not an error)."""
        nu = self.poissons_ratio
        return self.static_friction <= math.sqrt(3.0) * (1.0 - 2.0 * nu) / (1.0 + nu)
