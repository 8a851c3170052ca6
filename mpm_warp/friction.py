"""From a friction angle to the friction coefficients of the material."""

from __future__ import annotations

import math
from dataclasses import replace

from .errors import SceneError
from .material import Material

__all__ = ["static_friction", "with_friction_angle"]


def static_friction(angle: float) -> float:
    """mu_s of a friction angle [degrees]: its tangent."""
    if not 0.0 < angle < 60.0:
        raise SceneError(f"friction_angle is {angle} degrees; allowed: above 0, below 60")
    return math.tan(math.radians(angle))


def with_friction_angle(material: Material, angle: float) -> tuple[Material, bool]:
    """The material with the mu_s of `angle` [degrees], and whether mu_2 had to be raised for it.

    mu_2 stays as it is while it is above mu_s. Otherwise it is raised to keep its distance from mu_s, so that friction
    goes on to rise with the rate as much as it did in the material given.
    """
    friction = static_friction(angle)
    raised = friction >= material.limit_friction
    limit = material.limit_friction
    if raised:
        limit = friction + material.limit_friction - material.static_friction
    return replace(material, static_friction=friction, limit_friction=limit), raised
