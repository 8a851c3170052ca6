"""How soil is expected to flow in a scene: an estimate from the scene alone, before anything is computed."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .column import Column
from .scene import Scene

__all__ = ["Flow", "expected_flow"]

_TOP_SHARE = 5.0  # a body's speed is the one it exceeds in this share of its time in the soil [%]


@dataclass(frozen=True)
class Flow:
    """The fastest flow that something in the scene drives."""

    cause: str
    """What drives it."""
    speed: float
    """V [m/s]."""
    thickness: float
    """l: over which the speed falls to zero [m]."""
    inertial_number: float
    """I [-]; infinite where nothing limits the speed."""

    @property
    def rate(self) -> float:
        """Of deformation, V / l [1/s]."""
        return self.speed / self.thickness


def expected_flow(scene: Scene) -> Flow | None:
    """The flow with the largest inertial number; None where the soil stays at rest.

    With the speed V and the thickness l of the flowing layer I = (V / l) d sqrt(rho_s / p) at the pressure
    p = rho g l of soil as deep as the layer.
    """
    found = [flow for flow in (_of_body(scene), _of_column(scene), _of_slope(scene)) if flow]
    return max(found, key=lambda flow: flow.inertial_number, default=None)


def _sheared(scene: Scene, cause: str, speed: float, thickness: float) -> Flow:
    material = scene.material
    # No layer on a grid is thinner than one spacing.
    thickness = min(max(thickness, scene.bed.spacing), scene.bed.size[2])
    pressure = material.bulk_density * scene.gravity * thickness
    inertial = math.inf
    if pressure > 0.0:
        rate = speed / thickness
        inertial = rate * material.grain_diameter * math.sqrt(material.grain_density / pressure)
    return Flow(cause, speed, thickness, inertial)


def _of_body(scene: Scene) -> Flow | None:
    """A body shears soil over the depth of its cut; one that rests on it, over a quarter of its smaller side."""
    body = scene.body
    if body is None:
        return None
    poses = scene.body_poses()
    depth = -(poses[:, 2] + (_heights(poses[:, 3:]) @ body.outline().T).min(axis=1))
    way, angle = scene.travel(scene.times())
    speed = np.maximum(way, angle * body.reach) * scene.frame_rate
    if scene.axle is None:
        speed, thickness = speed[depth[:-1] > 0.0], float(depth.max())
    else:
        thickness = 0.5 * float(body.half_size[:2].min())
    moving = speed[speed > 0.0]
    if not len(moving):
        return None
    return _sheared(scene, "the body", float(np.percentile(moving, 100.0 - _TOP_SHARE)), thickness)


def _heights(q: np.ndarray) -> np.ndarray:
    """What points in the body's frame are multiplied with for their height in the world, shape (T, 3)."""
    x, y, z, w = q.T
    return np.stack([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)], axis=-1)


def _of_column(scene: Scene) -> Flow | None:
    """A column falls by about its height, all of it."""
    if not isinstance(scene, Column) or scene.gravity == 0.0:
        return None
    height = scene.bed.size[2]
    return _sheared(scene, "the column", math.sqrt(scene.gravity * height), height)


def _of_slope(scene: Scene) -> Flow | None:
    """On a slope steeper than atan mu_s the steady flow with mu(I) = tan(slope); there is none beyond atan mu_2."""
    material, slope, thickness = scene.material, abs(math.tan(math.radians(scene.tilt))), scene.bed.size[2]
    if slope <= material.static_friction or scene.gravity == 0.0:
        return None
    inertial = material.inertial_number(slope)
    fall = scene.gravity * math.cos(math.radians(scene.tilt))
    # At the surface; what accelerates for ever is taken as fast as free fall through the layer.
    speed = (
        2.0 * inertial / (3.0 * material.grain_diameter) * math.sqrt(material.packing * fall) * thickness**1.5
    )
    if math.isinf(inertial):
        speed = math.sqrt(2.0 * scene.gravity * thickness)
    return Flow("the slope", speed, thickness, inertial)
