"""Soil parameters."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, ClassVar, Literal

from .settings import Settings, setting, settings
from .state import SceneError

FRICTION_MAPS: dict[str, Callable[[float], float]] = {
    "tan": math.tan,
    "sin": math.sin,
    "triaxial": lambda phi: 2.0 * math.sqrt(3.0) * math.sin(phi) / (3.0 - math.sin(phi)),
}
"""mu_s of an angle [rad] such that the cone and the Mohr-Coulomb criterion agree in one kind of loading: `tan` in
simple shear, `sin` in plane strain, `triaxial` in triaxial compression. In other kinds they differ."""

SINES: dict[str, Callable[[float], float]] = {
    "tan": lambda mu: mu / math.hypot(1.0, mu),
    "sin": lambda mu: mu,
    "triaxial": lambda mu: 3.0 * mu / (2.0 * math.sqrt(3.0) + mu),
}
"""sin phi of mu_s, the other way round; 1 or more where no angle has that mu_s."""


def static_friction(angle: float, friction_map: str = "tan") -> float:
    """mu_s [-] of soil with friction angle `angle` [degrees], between 0 and 90."""
    return FRICTION_MAPS[friction_map](math.radians(angle))


MOST_STRETCH = 0.05
"""Largest ln J of soil that holds together: the elastic law is meant for small strains."""
FRICTION_RANGE = 0.2016
"""mu_2 - mu_s of the paper's sand: what the limit friction is set above a static friction that reaches it."""


def _positive(default: float, words: str, unit: str = "") -> Any:
    return setting(default, words, unit, gt=0, words="; it must be a number above 0")


@settings
class Material(Settings):
    """Granular soil: Hencky elasticity with rate-dependent friction mu(I), its fluidity, and cohesion.

    The defaults are the sand of the paper's excavation runs (A. Haeri, K. Skonieczny) except for the
    stiffness: 1 MPa instead of 15 MPa, which makes the explicit step almost four times longer.
    """

    group: ClassVar[str] = "material"
    _notes: ClassVar[tuple[str, ...]] = ()  # of a soil with a friction angle

    youngs_modulus: float = setting(1.0e6, "E; the cost grows with its square root", "Pa", ge=1e-9, le=1e12)
    poissons_ratio: float = setting(
        0.3, "nu", ge=0, le=0.499, note=": soil that keeps its volume has infinitely fast waves"
    )
    grain_density: float = _positive(2583.0, "density of the grains' material", "kg/m^3")
    packing: float = setting(0.67, "solid volume fraction at the critical density", ge=0.05, le=1)
    grain_diameter: float = _positive(3.0e-4, "d", "m")
    static_friction: float = setting(0.76, "mu_s, where flow begins; friction_angle goes before it", gt=0)
    cohesion: float = setting(
        0.0,
        "c: shear strength of soil without pressure, with the angle that friction_map gives mu_s",
        "Pa",
        ge=0,
    )
    limit_friction: float = setting(0.9616, "mu_2: the ratio approached in very fast flow")
    reference_inertial_number: float = _positive(0.278, "I_0 of the rate law")
    rate_law: Literal["saturating", "linear"] = setting(
        "saturating", "saturating: mu_s + (mu_2 - mu_s) / (1 + I_0 / I); linear: mu_s + (mu_2 - mu_s) I / I_0"
    )
    friction_angle: float | None = setting(
        None,
        "angle of internal friction; None: static_friction holds",
        "degrees",
        gt=0,
        lt=90,
        words="; allowed: above 0 and below 90 degrees, or null for material.static_friction",
        radians_below=1.6,
    )
    friction_map: Literal["sin", "tan", "triaxial"] = setting(
        "tan", "mu_s of the angle: tan (simple shear), sin (plane strain) or triaxial (compression)"
    )
    nonlocal_amplitude: float = setting(0.48, "A: reach of cooperative flow in grain diameters", ge=0)
    fluidity_time: float = _positive(2.0e-4, "t_0 of the fluidity's own dynamics", "s")
    fluidity_at_walls: Literal["zero", "free"] = setting(
        "zero",
        "zero: no flow at rough floor and walls; free: no gradient across them; for the effect nonlocality",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.friction_angle is not None:
            self._apply_friction_angle(self.friction_angle)
        if not self.limit_friction > self.static_friction:
            raise SceneError(
                f"material.limit_friction is {self.limit_friction}; it must be above material.static_friction "
                f"({self.static_friction})"
            )

        if self.cohesion > 0.0:
            self._check_cohesion()

    def _check_cohesion(self) -> None:
        if SINES[self.friction_map](self.static_friction) >= 1.0:
            raise SceneError(
                f"material.cohesion needs an angle of friction, and with material.friction_map={self.friction_map} no "
                f"angle has a static friction of {self.static_friction:g}: lower material.static_friction or set "
                "material.friction_map=tan"
            )
        if self.cohesive_pressure > MOST_STRETCH * self.bulk_modulus:
            enough = self.youngs_modulus * self.cohesive_pressure / (MOST_STRETCH * self.bulk_modulus)
            raise SceneError(
                f"material.cohesion is {self.cohesion:g} Pa: soil as soft as material.youngs_modulus "
                f"{self.youngs_modulus:g} Pa would stretch by more than {100.0 * MOST_STRETCH:g} % before it tears; "
                f"raise material.youngs_modulus to {enough:.3g} Pa or more"
            )

    def _apply_friction_angle(self, angle: float) -> None:
        """Set mu_s, and mu_2 where it must follow, and keep what to tell the user."""
        found = static_friction(angle, self.friction_map)
        source = f"material.friction_angle {angle:g} degrees ({self.friction_map})"
        notes = []
        if self.static_friction not in (type(self).static_friction, found):
            notes.append(
                f"material.static_friction {self.static_friction:g} is not used, because {source} gives {found:.4f}; "
                "set material.friction_angle=null to use it"
            )
        object.__setattr__(self, "static_friction", found)
        if found >= self.limit_friction:
            raised = found + FRICTION_RANGE
            notes.append(
                f"{source} gives a static friction of {found:.4f}, not below material.limit_friction "
                f"{self.limit_friction:g}; the limit is raised to {raised:.4f}"
            )
            object.__setattr__(self, "limit_friction", raised)
        object.__setattr__(self, "_notes", tuple(notes))

    def warnings(self) -> list[str]:
        """What a user should know about this soil before it is used."""
        return list(self._notes)

    def warnings_at_rest(self) -> list[str]:
        """Likewise of a bed of it that is to rest."""
        if not self.rest_stress_yields:
            return []
        return [
            f"material.static_friction {self.static_friction:.3f} is so low that the bed at rest already yields under "
            "its own weight (K0 condition)"
        ]

    @property
    def cohesive_pressure(self) -> float:
        """p_c = c cot(phi) [Pa]: cohesion is like so much more pressure between the grains, tau <= mu (p + p_c)."""
        sine = SINES[self.friction_map](self.static_friction)
        return self.cohesion * math.sqrt(1.0 - sine**2) / sine if self.cohesion > 0.0 else 0.0

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

    def friction_at(self, inertial_number: float) -> float:
        """mu(I) of steady flow, by the rate law [-]."""
        above = self.limit_friction - self.static_friction
        if self.rate_law == "linear":
            return self.static_friction + above * inertial_number / self.reference_inertial_number
        if inertial_number == 0.0:
            return self.static_friction
        return self.static_friction + above / (1.0 + self.reference_inertial_number / inertial_number)

    def inertial_number(self, friction: float) -> float:
        """I of the steady flow with a ratio `friction` of shear stress to pressure [-]: 0 up to mu_s, infinite where
        the rate law has no such flow."""
        above = friction - self.static_friction
        if above <= 0.0:
            return 0.0
        if self.rate_law == "linear":
            return self.reference_inertial_number * above / (self.limit_friction - self.static_friction)
        below = self.limit_friction - friction
        return self.reference_inertial_number * above / below if below > 0.0 else math.inf

    def cooperativity_length(self, friction: float) -> float:
        """xi [m]: how far flow reaches at a ratio `friction` of shear stress to pressure."""
        if self.rate_law == "saturating" and friction >= self.limit_friction:
            return 0.0
        slowing = abs(friction - self.static_friction)
        if self.rate_law == "saturating":
            slowing *= (self.limit_friction - self.static_friction) / (self.limit_friction - friction)
        return (
            math.inf if slowing == 0.0 else self.nonlocal_amplitude * self.grain_diameter / math.sqrt(slowing)
        )

    @property
    def lateral_stress_ratio(self) -> float:
        """K0 = nu / (1 - nu), horizontal over vertical stress of an elastic bed at rest [-]."""
        return self.poissons_ratio / (1.0 - self.poissons_ratio)

    @property
    def rest_stress_yields(self) -> bool:
        """True when the elastic K0 state lies outside the friction cone (a warning, not an error)."""
        nu = self.poissons_ratio
        return self.static_friction <= math.sqrt(3.0) * (1.0 - 2.0 * nu) / (1.0 + nu)
