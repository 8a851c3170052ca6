"""A wheel drives over a bed under a load."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from .axle import Axle
from .bodies import Cylinder
from .errors import SceneError
from .limits import BODY_MASS
from .rotation import about_y
from .scene import Scene

__all__ = ["Wheel"]


@dataclass(frozen=True)
class Wheel(Scene):
    """A wheel settles under its load, then drives along x with a given slip.

    Forward motion and rotation are prescribed: both are zero during the first `settle` seconds and constant
    afterwards. The height is free. The mass is load / gravity, so that the weight is the load.
    """

    name: str = "wheel"
    kind: str = "wheel"
    contact_margin: float = 0.0
    duration: float = 1.0 + 16.0 / 3.0
    """Settling and driving [s]."""
    load: float = 100.0
    """Weight that the wheel carries, its own included [N]."""
    diameter: float = 0.15
    """Of the rim, without grousers [m]."""
    width: float = 0.083
    """[m]."""
    friction: float = 0.5
    """Coulomb friction between soil and wheel [-]."""
    grousers: int = 0
    """How many bars along the rim."""
    grouser_height: float = 0.0
    """Above the rim [m]."""
    grouser_thickness: float = 0.0
    """Along the rim [m]."""
    slip: float = 0.2
    """1 - forward speed / rim speed [-]."""
    rim_speed: float = 0.0195
    """Angular speed times half the diameter [m/s]."""
    friction_angle: float | None = None
    """In place of material.friction_angle [degrees]; None: the material's own."""
    settle: float = 1.0
    """Time at rest under the load before driving [s]; recorded like the rest."""
    damping: float = 0.0
    """Force against the vertical velocity per mass of the wheel [1/s]."""
    bilateral: bool = False
    """Whether soil in contact may not leave the wheel along its normal (bilateral contact)."""
    start: float = 0.30
    """Where the axle starts, as a share of the bin's length."""
    clearance: float = 0.0
    """Height of the wheel's lowest point above the undisturbed surface at the start [m]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, unit in (("load", "N"), ("rim_speed", "m/s"), ("gravity", "m/s^2")):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise SceneError(f"scene.{name} is {value} {unit}; a wheel needs more than 0")
        if not BODY_MASS[0] <= self.load / self.gravity <= BODY_MASS[1]:
            raise SceneError(
                f"scene.load is {self.load} N at scene.gravity {self.gravity} m/s^2: a wheel of "
                f"{self.load / self.gravity:.3g} kg; allowed: {BODY_MASS[0]:g} to {BODY_MASS[1]:g} kg"
            )
        if not -1.0 <= self.slip <= 1.0:
            raise SceneError(
                f"scene.slip is {self.slip}; allowed: -1 to 1 (0: rolls freely, 1: turns on the spot)"
            )
        if not 0.0 <= self.settle < self.duration:
            raise SceneError(
                f"scene.settle is {self.settle} s; allowed: 0 up to, not including, scene.duration ({self.duration} s)"
            )
        if not (math.isfinite(self.damping) and self.damping >= 0):
            raise SceneError(f"scene.damping is {self.damping} 1/s; it must be 0 or more")
        if not 0.0 <= self.start <= 1.0:
            raise SceneError(f"scene.start is {self.start}; allowed: 0 to 1, a share of the bin's length")
        try:
            _ = self.body
        except SceneError as error:
            raise SceneError(str(error).replace("tool.", "scene.")) from None
        if self.friction_angle is not None:
            material = replace(self.material, friction_angle=self.friction_angle)
            object.__setattr__(self, "material", material)
        self._check_thickness("a wheel's width")
        self._check_fits()

    @cached_property
    def body(self) -> Cylinder:
        """The wheel; its axis is y and its centre of mass the middle of the axle."""
        return Cylinder(
            diameter=self.diameter,
            width=self.width,
            friction=self.friction,
            grousers=self.grousers,
            grouser_height=self.grouser_height,
            grouser_thickness=self.grouser_thickness,
        )

    @property
    def axle(self) -> Axle:
        return Axle(self.load / self.gravity, self.damping)

    @property
    def speed(self) -> float:
        """Forward speed while driving [m/s]."""
        return self.rim_speed * (1.0 - self.slip)

    @property
    def angular_speed(self) -> float:
        """While driving, about +y: the rim's lowest point moves backwards past the axle [rad/s]."""
        return 2.0 * self.rim_speed / self.diameter

    def poses_at(self, time: np.ndarray) -> np.ndarray:
        driven = np.maximum(np.atleast_1d(np.asarray(time, dtype=float)) - self.settle, 0.0)
        poses = np.empty((len(driven), 7))
        poses[:, 0] = self.start * self.bed.size[0] + self.speed * driven
        poses[:, 1] = 0.5 * self.bed.size[1]
        poses[:, 2] = self.body.tip_radius + self.clearance
        poses[:, 3:] = np.array([about_y(angle) for angle in self.angular_speed * driven])
        return poses

    def travel(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # From the speeds: poses do not show a whole turn.
        driven = np.diff(np.maximum(time - self.settle, 0.0))
        return abs(self.speed) * driven, self.angular_speed * driven

    def sinkage(self, poses: np.ndarray) -> np.ndarray:
        """Depth of the wheel's lowest point below the undisturbed surface [m], shape (T,) for poses (T, 7)."""
        return self.body.tip_radius - poses[:, 2]

    def body_points(self) -> np.ndarray:
        return self.body.points()

    def warnings(self) -> list[str]:
        found = super().warnings()
        if self.grousers and self.grouser_thickness < self.bed.spacing:
            found.append(
                f"the grousers are {self.grouser_thickness / self.bed.spacing:.2f} grid spacings thick; below 1 the "
                "grid does not resolve them"
            )
        return found

    def summary(self, force: np.ndarray, torque: np.ndarray, poses: np.ndarray) -> str:
        driving = self.times()[: len(force)] > self.settle + 0.5 / self.frame_rate
        pull, _, vertical = force[driving].mean(axis=0)
        return (
            f"while driving: mean drawbar pull {pull:.2f} N, vertical force {vertical:.2f} N, "
            f"sinkage {1000.0 * self.sinkage(poses)[driving].mean():.1f} mm, "
            f"torque {torque[driving, 1].mean():.3f} N m"
        )

    def _check_fits(self) -> None:
        """The axle stays over the bin and the rims between its side walls, whatever the height."""
        lx, ly, _ = self.bed.size
        if self.width >= ly:
            raise SceneError(f"scene.width is {self.width} m; the bin is only {ly:g} m wide")
        first, last = self.poses_at(self.times()[[0, -1]])[:, 0]
        if min(first, last) < 0.0 or max(first, last) > lx:
            raise SceneError(
                f"the axle moves from x = {first:.3f} to {last:.3f} m; allowed: 0 to {lx:g} m; change scene.start, "
                "slip, rim_speed or duration"
            )
        if not -self.bed.size[2] < self.clearance < self.bed.headroom:
            raise SceneError(
                f"scene.clearance is {self.clearance} m; allowed: above the floor ({-self.bed.size[2]:g} m) and below "
                f"bed.headroom ({self.bed.headroom:g} m)"
            )
