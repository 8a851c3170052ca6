"""Soil parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass

from .ranges import LEAST_PACKING, MOST_POISSONS_RATIO, YOUNGS_MODULUS
from .state import SceneError

# --- From an angle of internal friction to the cone's static friction mu_s ------------------------------

FRICTION_MAPS = {
    "tan": lambda phi: math.tan(phi),
    "sin": lambda phi: math.sin(phi),
    "triaxial": lambda phi: 2.0 * math.sqrt(3.0) * math.sin(phi) / (3.0 - math.sin(phi)),
}
"""mu_s of an angle [rad] such that the cone and the Mohr-Coulomb criterion agree in one kind of loading: `tan` in
simple shear, `sin` in plane strain, `triaxial` in triaxial compression. In other kinds they differ."""


def static_friction(angle: float, friction_map: str = "tan") -> float:
    """mu_s [-] of soil with friction angle `angle` [degrees].

    Raises:
        SceneError: when the map is not known or the angle not between 0 and 90 degrees.
    """
    if friction_map not in FRICTION_MAPS:
        raise SceneError(
            f"material.friction_map is {friction_map!r}; allowed: {', '.join(sorted(FRICTION_MAPS))}"
        )
    if isinstance(angle, bool) or not isinstance(angle, (int, float)) or not 0.0 < angle < 90.0:
        raise SceneError(
            f"material.friction_angle is {angle!r}; allowed: above 0 and below 90 degrees, or null for "
            "material.static_friction"
        )
    return FRICTION_MAPS[friction_map](math.radians(angle))


# --- Soil parameters ------------------------------------------------------------------------------------

RATE_LAWS = ("saturating", "linear")
FLUIDITY_AT_WALLS = ("zero", "free")
FRICTION_RANGE = 0.2016
"""mu_2 - mu_s of the paper's sand: what the limit friction is set above a static friction that reaches it."""


@dataclass(frozen=True)
class Material:
    """Dry granular soil: Hencky elasticity with rate-dependent friction mu(I) and its fluidity.

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
    """mu_s: ratio of shear stress to pressure below which the soil does not flow [-]. Follows from
    `friction_angle` where that is given."""
    limit_friction: float = 0.9616
    """mu_2: the ratio approached in very fast flow [-]."""
    reference_inertial_number: float = 0.278
    """I_0 of the rate law [-]."""
    rate_law: str = "saturating"
    """saturating: mu(I) = mu_s + (mu_2 - mu_s) / (1 + I_0 / I); linear: mu(I) = mu_s + (mu_2 - mu_s) I / I_0."""
    friction_angle: float | None = None
    """Angle of internal friction [degrees]; None: `static_friction` holds."""
    friction_map: str = "tan"
    """How the angle becomes mu_s: tan | sin | triaxial (see `static_friction`)."""
    nonlocal_amplitude: float = 0.48
    """A: reach of cooperative flow in grain diameters [-]. Used by the effect `nonlocality`."""
    fluidity_time: float = 2.0e-4
    """t_0 of the fluidity's own dynamics [s]. Used by the effect `fluidity`."""
    fluidity_at_walls: str = "zero"
    """zero: no flow at rough floor and walls; free: no gradient across them. Used by the effect `nonlocality`."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "_notes", tuple(self._apply_friction_angle()))
        for name, allowed in (("rate_law", RATE_LAWS), ("fluidity_at_walls", FLUIDITY_AT_WALLS)):
            if getattr(self, name) not in allowed:
                raise SceneError(f"material.{name} is {getattr(self, name)!r}; allowed: {', '.join(allowed)}")
        if not (math.isfinite(self.nonlocal_amplitude) and self.nonlocal_amplitude >= 0.0):
            raise SceneError(
                f"material.nonlocal_amplitude is {self.nonlocal_amplitude}; it must be 0 or more"
            )
        positive = (
            "youngs_modulus",
            "grain_density",
            "grain_diameter",
            "reference_inertial_number",
            "fluidity_time",
        )
        for name in positive:
            value = getattr(self, name)
            if not (isinstance(value, (int, float)) and math.isfinite(value) and value > 0):
                raise SceneError(f"material.{name} is {value}; it must be a number above 0")
        low, high = YOUNGS_MODULUS
        if not low <= self.youngs_modulus <= high:
            raise SceneError(
                f"material.youngs_modulus is {self.youngs_modulus} Pa; allowed: {low:g} to {high:g}"
            )
        if not 0.0 <= self.poissons_ratio <= MOST_POISSONS_RATIO:
            raise SceneError(
                f"material.poissons_ratio is {self.poissons_ratio}; allowed: 0 to {MOST_POISSONS_RATIO}: soil that "
                "keeps its volume has infinitely fast waves"
            )
        if not LEAST_PACKING <= self.packing <= 1.0:
            raise SceneError(f"material.packing is {self.packing}; allowed: {LEAST_PACKING} to 1")
        if not self.static_friction > 0.0:
            raise SceneError(f"material.static_friction is {self.static_friction}; it must be above 0")
        if not self.limit_friction > self.static_friction:
            raise SceneError(
                f"material.limit_friction is {self.limit_friction}; it must be above material.static_friction "
                f"({self.static_friction})"
            )

    def _apply_friction_angle(self) -> list[str]:
        """Set mu_s, and mu_2 where it must follow, from the angle if there is one; what to tell the user."""
        if self.friction_map not in FRICTION_MAPS:
            static_friction(45.0, self.friction_map)  # says what is allowed
        if self.friction_angle is None:
            return []
        found = static_friction(self.friction_angle, self.friction_map)
        source = f"material.friction_angle {self.friction_angle:g} degrees ({self.friction_map})"
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
        return notes

    def warnings(self) -> list[str]:
        """What a user should know about this soil before it is used."""
        found = list(self._notes)
        if self.rest_stress_yields:
            found.append(
                f"material.static_friction {self.static_friction:.3f} is so low that the bed at rest "
                "already yields under its own weight (K0 condition)"
            )
        return found

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
        above, most = friction - self.static_friction, self.limit_friction - self.static_friction
        if above <= 0.0:
            return 0.0
        if self.rate_law == "linear":
            return self.reference_inertial_number * above / most
        return self.reference_inertial_number * above / (most - above) if above < most else math.inf

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
