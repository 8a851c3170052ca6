"""Three-dimensional resistive force theory: each piece of a surface feels a stress of its own depth and motion.

S. Agarwal, D. I. Goldman, K. Kamrin, PNAS 120(4), e2214017120 (2023). The stress per depth is an isotropic function of
the outward normal n, the direction of motion v and gravity g: scale (f1 n + f2 v + f3 g), where each f is a cubic
polynomial of v.g, n.g and n.v. Coefficients: their supplement, S3. Of two public transcriptions, which differ in two
numbers, this is the one in which no plate pressed down resists more than a level one; no median changes by 0.006.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from conditions import GRAVITY, TRAVEL, Condition, Forces, Soil, Wheel

POWERS = (  # of v.g, n.g, n.v in each term
    *((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (2, 0, 0), (0, 2, 0), (0, 0, 2), (1, 1, 0), (0, 1, 1), (1, 0, 1)),
    *((3, 0, 0), (0, 3, 0), (0, 0, 3), (1, 2, 0), (2, 1, 0), (0, 1, 2), (0, 2, 1), (2, 0, 1), (1, 0, 2), (1, 1, 1)),
)  # fmt: skip
COEFFICIENTS = np.array(
    [
        [0.00212, -0.02320, -0.20890, -0.43083, -0.00259, 0.48872, -0.00415, 0.07204, -0.02750, -0.08772],
        [0.01992, -0.45961, 0.40799, -0.10107, -0.06576, 0.05664, -0.09269, 0.01892, 0.01033, 0.15120],
        [-0.06796, -0.10941, 0.04725, -0.06914, -0.05835, -0.65880, -0.11985, -0.25739, -0.26834, 0.02692],
        [-0.00736, 0.63758, 0.08997, 0.21069, 0.04748, 0.20406, 0.18519, 0.04934, 0.13527, -0.33207],
        [-0.02634, -0.03436, 0.45256, 0.00835, 0.02553, -1.31290, -0.05532, 0.06790, -0.16404, 0.02287],
        [0.02927, 0.95406, -0.00131, -0.11028, 0.01487, -0.20770, 0.10911, -0.04097, 0.07881, -0.27519],
    ]
).reshape(3, 20)  # of f1, f2, f3


def scale_of(soil: Soil) -> float:
    """Stress per depth of the soil from its density and friction [N/m^3]."""
    mu = math.tan(soil.angle)
    return soil.density * GRAVITY * (894.0 * mu**3 - 386.0 * mu**2 + 89.0 * mu)


def stress(normal: np.ndarray, velocity: np.ndarray, friction: float) -> np.ndarray:
    """Stress on surfaces per depth and scale [-], shape (N, 3), z up.

    Zero on a surface that does not move into the soil. The soil presses and does not pull; the tangential part is at
    most friction times the normal part.

    Args:
        normal: outward unit normals (N, 3).
        velocity: of the surfaces (N, 3), of any size.
    """
    speed = np.linalg.norm(velocity, axis=1, keepdims=True)
    v = velocity / np.maximum(speed, 1e-300)
    leads = (np.sum(normal * v, axis=1) >= -1e-9) & (speed[:, 0] > 0.0)
    n = np.where(normal[:, 2:] > 0.0, -normal, normal)  # the theory's plates face down
    x = np.stack([-v[:, 2], -n[:, 2], np.sum(n * v, axis=1)], axis=1)
    powers = np.stack([np.ones_like(x), x, x**2, x**3])
    f1, f2, f3 = COEFFICIENTS @ [powers[i, :, 0] * powers[j, :, 1] * powers[k, :, 2] for i, j, k in POWERS]
    raw = f1[:, None] * n + f2[:, None] * v - f3[:, None] * np.array([0.0, 0.0, 1.0])
    pressure = np.maximum(-np.sum(raw * normal, axis=1), 0.0)
    along = raw - np.sum(raw * normal, axis=1)[:, None] * normal
    limit = friction * pressure / np.maximum(np.linalg.norm(along, axis=1), 1e-300)
    return leads[:, None] * (np.minimum(limit, 1.0)[:, None] * along - pressure[:, None] * normal)


def surface(wheel: Wheel, around: int = 180, across: int = 12) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rim and both faces in pieces: centres from the wheel's centre [m], outward normals, areas [m^2]."""
    piece = 2.0 * math.pi / around
    angle = (np.arange(around) + 0.5) * piece
    out = np.stack([np.sin(angle), 0.0 * angle, -np.cos(angle)], axis=1)
    side = np.array([0.0, 1.0, 0.0])
    centres, normals = [wheel.radius * out], [out]
    areas = [np.full(around, wheel.radius * piece * wheel.width)]
    for radius in (np.arange(across) + 0.5) * wheel.radius / across:
        for sign in (-1.0, 1.0):
            centres.append(radius * out + 0.5 * sign * wheel.width * side)
            normals.append(np.tile(sign * side, (around, 1)))
            areas.append(np.full(around, radius * piece * wheel.radius / across))
    return np.concatenate(centres), np.concatenate(normals), np.concatenate(areas)


@lru_cache(maxsize=512)
def pattern(wheel: Wheel, angle: float, rim_speed: float, friction: float) -> tuple[np.ndarray, np.ndarray]:
    """Centres of the pieces and forces on them per depth and scale [m, m^2]; depth changes neither."""
    centres, normals, areas = surface(wheel)
    travel = TRAVEL * np.array([round(math.cos(angle), 12), -round(math.sin(angle), 12), 0.0])
    turn = rim_speed / wheel.radius
    velocity = travel + turn * np.stack([centres[:, 2], 0.0 * areas, -centres[:, 0]], axis=1)
    return centres, areas[:, None] * stress(normals, velocity, friction)


def forces(condition: Condition, depth: float, scale: float, friction: float) -> Forces:
    """Of the soil on the wheel with its lowest point at `depth` [m].

    Args:
        scale: stress per depth of the soil [N/m^3].
        friction: between wheel and soil.
    """
    wheel = condition.wheel
    at, each = pattern(wheel, condition.angle, condition.rim_speed, friction)
    parts = scale * np.maximum(depth - wheel.radius - at[:, 2:], 0.0) * each
    x, y, z = parts.sum(axis=0)
    return Forces(x, y, z, float(np.sum(at[:, 0] * parts[:, 2] - at[:, 2] * parts[:, 0])))
