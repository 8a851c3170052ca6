"""The wheel of Bekker, Wong and Reece, with a slip angle: pressure and shear along the rim, soil pushed by the face.

Pressure k z^n in two branches that meet at the angle of largest pressure (Wong and Reece 1967), shear after Janosi and
Hanamoto (1961) along and across, bulldozed soil at the side after Hegedus (1960); put together as by Ishigami et al.,
J. Field Robotics 24(3) (2007). The exponent grows with slip, so that a slipping or braked wheel sinks (Ding et al.).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from conditions import GRAVITY, TRAVEL, Condition, Forces

PEAK = (0.4, 0.15)  # angle of largest pressure as a share of the entry's, and growth with slip (Ishigami)
EXPONENT = 1.1  # of a dry sand (Wong)
SHEAR_LENGTH = 0.010  # over which shear builds up in a firm sand (Wong) [m]


class Parameters(NamedTuple):
    """What the tables do not say."""

    stiffness: float
    """k of pressure = k depth^n, k_c / width + k_phi in one [N/m^(n+2)]."""
    driven: float
    """Growth of n with slip."""
    braked: float
    """Growth of n with negative slip."""
    friction: float
    """Between wheel and soil."""


def forces(condition: Condition, depth: float, given: Parameters, pieces: int = 120) -> Forces:
    """Of the soil on the wheel with its lowest point at `depth` [m]."""
    radius, width = condition.wheel
    entry = math.acos(1.0 - depth / radius)
    theta = (np.arange(pieces) + 0.5) * entry / pieces  # from the lowest point, where soil leaves
    pressure, along, across = rim_stress(condition, entry, theta, given)
    element = radius * width * entry / pieces
    sin, cos = np.sin(theta), np.cos(theta)
    return Forces(
        fx=element * float(np.sum(along * cos - pressure * sin)),
        fy=element * float(np.sum(across)) + side_force(condition, entry),
        fz=element * float(np.sum(along * sin + pressure * cos)),
        torque=element * radius * float(np.sum(along)),
    )


def rim_stress(
    condition: Condition, entry: float, theta: np.ndarray, given: Parameters
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pressure, and shear that drives and that pushes along the axle, at angles from the lowest point [Pa]."""
    radius, soil, rim = condition.wheel.radius, condition.soil, condition.rim_speed
    ahead, aside = TRAVEL * math.cos(condition.angle), TRAVEL * math.sin(condition.angle)
    slip = (rim - ahead) / max(rim, ahead)  # of the motion along the heading
    exponent = EXPONENT + (given.driven * slip if slip > 0.0 else -given.braked * slip)
    peak = entry * (PEAK[0] + PEAK[1] * max(slip, 0.0))
    front = np.where(theta > peak, theta, entry - theta / peak * (entry - peak))
    pressure = given.stiffness * (radius * np.maximum(np.cos(front) - math.cos(entry), 0.0)) ** exponent
    # Rim past soil since it entered, times the turning speed: a locked wheel has slid for ever, along its motion.
    along = rim * (entry - theta) - ahead * (math.sin(entry) - np.sin(theta))
    across = aside * (entry - theta)
    whole = np.hypot(along, across)
    built = -np.expm1(-whole * radius / max(rim * SHEAR_LENGTH, 1e-12))
    strength = (soil.cohesion + pressure * given.friction) * built / np.maximum(whole, 1e-300)
    return pressure, strength * along, strength * across


def side_force(condition: Condition, entry: float, pieces: int = 120) -> float:
    """Of soil that the wheel's face pushes ahead, along the axle [N]."""
    radius, soil = condition.wheel.radius, condition.soil
    phi = soil.angle
    plane = 0.25 * math.pi - 0.5 * phi  # on which the pushed soil slides, from level
    widest = min(entry, 0.5 * math.pi)
    theta = ((np.arange(pieces) + 0.5) / pieces * 2.0 - 1.0) * widest
    depth = radius * (np.cos(theta) - math.cos(entry))
    cot = 1.0 / math.tan(plane)
    weight = 0.5 * soil.density * GRAVITY * depth**2 * (cot + cot**2 * math.tan(phi))
    per_length = (cot + math.tan(plane + phi)) * (soil.cohesion * depth + weight)
    area = radius * np.cos(theta) * 2.0 * widest / pieces
    return math.sin(condition.angle) * float(np.sum(per_length * area))
