"""From an angle of internal friction to the cone's static friction mu_s."""

from __future__ import annotations

import math

from .errors import SceneError

__all__ = ["FRICTION_MAPS", "static_friction"]

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
