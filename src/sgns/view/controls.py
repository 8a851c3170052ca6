"""What a person asks of a tool on the page, and where the tool is then: a pose for every frame."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mpm_warp import Cylinder, Scene
from mpm_warp.motions import CUT_LENGTH
from mpm_warp.poses import about_z_y, rotate
from sgns.config import UserError
from sgns.model.training_range import TrainingRange

SETTLING = 0.1
"""Time in which the tool takes a new speed, or comes to the depth and rake that are asked for [s]."""
TURNING = 20.0
"""Fastest change of the rake [degrees/s]."""
LIFT = 0.05
"""Of the tip above the surface on the way back to where it began [m]."""
MARGIN = 15.0
"""Angles reach so much further than in the training runs [degrees]."""


@dataclass(frozen=True)
class Slider:
    """A number that the page lets a person choose."""

    key: str
    label: str
    unit: str
    scale: float
    """Of what is shown, per SI unit."""
    step: float
    low: float
    high: float
    value: float
    trained: tuple[float, float] | None
    """What the training runs covered."""


class Controls:
    """Sliders and their values, the way a person drives, and where the tool is.

    Args:
        scene: Whose tool it is, and where it begins.
        known: What the training runs covered.
        rate: Frames per second [Hz].

    Attributes:
        sliders: By their keys.
        wanted: Value of each.
        way: -1 back to 1 forward.
        told: Values of the scene that a person changes, by their keys.
        plan: Places that the tip goes to by itself, x and z [m].
    """

    def __init__(self, scene: Scene, known: TrainingRange, rate: float) -> None:
        self.scene, self.known, self.rate = scene, known, rate
        self.first = scene.body_poses()[0]
        self.sliders = {one.key: one for one in self._sliders()}
        self.wanted = {key: one.value for key, one in self.sliders.items()}
        self.way = 0.0
        self.reset()

    @property
    def told(self) -> dict[str, float]:
        return {}

    def hear(self, asked: Mapping[str, Any]) -> None:
        """Take values of sliders and the way; beyond a slider's ends they are its ends.

        Raises:
            UserError: They are something else.
        """
        for key, value in asked.items():
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
                raise UserError(f"{key!s:.40} is {value!r:.40}; it must be a number")
            if key != "way" and key not in self.sliders:
                raise UserError(f"{key!s:.40} is no control; there are way, {', '.join(self.sliders)}")
        for key, value in asked.items():
            if key == "way":
                self.way = min(max(float(value), -1.0), 1.0)
            else:
                self.wanted[key] = min(max(float(value), self.sliders[key].low), self.sliders[key].high)

    def reset(self) -> None:
        """The tool where it begins; sliders stay as they are, but for the depth."""
        self.speed = 0.0
        self.plan: list[tuple[float, float]] = []

    def cut_again(self) -> None:
        """Lift the tool, go back to where it began, and cut: as deep as is asked for, else as before.

        Raises:
            UserError: It cuts nothing.
        """
        raise UserError("a wheel makes no cuts")

    def moved(self) -> np.ndarray:
        """The tool's pose one frame later, shape (7,)."""
        change = self.wanted["speed"] / (SETTLING * self.rate)
        self.speed += min(max(self.way * self.wanted["speed"] - self.speed, -change), change)
        self._move(1.0 / self.rate)
        return self.pose()

    def pose(self) -> np.ndarray:
        """Of the tool now, shape (7,)."""
        raise NotImplementedError

    def _move(self, dt: float) -> None:
        raise NotImplementedError

    def _sliders(self) -> list[Slider]:
        raise NotImplementedError

    def _trained(self, name: str, index: int = 0, scale: float = 1.0) -> tuple[float, float] | None:
        """Smallest and largest value of a quantity's component in the training runs."""
        if name not in self.known.low:
            return None
        return scale * float(self.known.low[name][index]), scale * float(self.known.high[name][index])

    def _along(self, x: float) -> float:
        """A place that is over the bin [m]."""
        return min(max(x, 0.0), self.scene.bed.size[0])


class ToolControls(Controls):
    """Of a tool whose whole motion is prescribed: its tip has a depth, the tool a rake."""

    def reset(self) -> None:
        super().reset()
        self.rake = self.wanted["rake"]
        self.tip = self.first[:3] + rotate(self.first[3:], self._tip)
        self.start, self.furthest, self.deepest = self.tip.copy(), float(self.tip[0]), 0.0
        self.wanted["depth"] = -float(self.tip[2])

    def hear(self, asked: Mapping[str, Any]) -> None:
        before = self.wanted["depth"]
        super().hear(asked)
        if self.way or abs(self.wanted["depth"] - before) > 1e-6:
            self.plan = []

    def cut_again(self) -> None:
        trained, high = self.sliders["depth"].trained, self.sliders["depth"].high
        usual = float(getattr(self.scene, "depth", high))
        depth = (
            self.wanted["depth"]
            if self.wanted["depth"] > 0.0
            else min(usual, trained[1] if trained else high)
        )
        begin, lifted = float(self.start[0]), max(LIFT, float(self.start[2]))
        end = min(max(self.furthest, begin + depth + CUT_LENGTH / 2), self.scene.bed.size[0] - depth)
        away = self.tip[2] < 0.0 or self.tip[0] > begin + 1e-6
        back = [(float(self.tip[0]), lifted), (begin, lifted)] if away else []
        cut = [(begin, float(self.start[2])), (begin + depth, -depth), (end, -depth), (end + depth, lifted)]
        self.plan = [*back, *cut]

    def pose(self) -> np.ndarray:
        turn = Rotation.from_euler("y", rake_of(self.first[3:]) - self.rake, degrees=True)
        rotation = (turn * Rotation.from_quat(self.first[3:])).as_quat()
        return np.array([*(self.tip - rotate(rotation, self._tip)), *rotation])

    @property
    def _tip(self) -> np.ndarray:
        assert self.scene.body is not None
        return self.scene.body.tip

    def _move(self, dt: float) -> None:
        fastest = self.wanted["speed"]
        if self.plan:
            gap = np.array(self.plan[0]) - self.tip[[0, 2]]
            distance = float(np.linalg.norm(gap))
            self.tip[[0, 2]] += gap * min(1.0, fastest * dt / max(distance, 1e-12))
            self.speed, self.wanted["depth"] = 0.0, -self.plan[0][1]
            if distance <= fastest * dt:
                del self.plan[0]
        else:
            self.tip[0] = self._along(self.tip[0] + self.speed * dt)
            fall = (-self.wanted["depth"] - self.tip[2]) / SETTLING
            self.tip[2] += min(max(fall, -fastest), fastest) * dt
        turn = (self.wanted["rake"] - self.rake) / SETTLING
        self.rake += min(max(turn, -TURNING), TURNING) * dt
        self.deepest = max(self.deepest, -float(self.tip[2]))
        if self.tip[2] < 0.0:
            self.furthest = max(self.furthest, float(self.tip[0]))

    def _sliders(self) -> list[Slider]:
        low, high = self._trained("the tool's lowest point") or (-0.1, 0.0)
        _, speed = self._trained("the tool's displacement per frame", 0, self.rate) or (0.0, 0.1)
        speed = speed if speed > 0.0 else 0.1
        # The third number of an orientation is the sine of the rake.
        sines = self._trained("the tool's orientation", 2) or (0.0, 0.0)
        least, most = (math.degrees(math.asin(min(max(sine, -1.0), 1.0))) for sine in sines)
        deepest = min(1.2 * max(-low, 0.01), self.scene.bed.size[2])
        rake = rake_of(self.first[3:])
        ends = max(min(least, rake) - MARGIN, -60.0), min(max(most, rake) + MARGIN, 60.0)
        return [
            Slider("depth", "depth", "mm", 1e3, 1e-3, -2.0 * LIFT, deepest, 0.0, (-high, -low)),
            Slider("rake", "rake", "°", 1.0, 0.5, *ends, rake, (least, most)),
            Slider("speed", "speed", "mm/s", 1e3, 1e-3, 0.0, 1.5 * speed, 0.7 * speed, (0.0, speed)),
        ]


class WheelControls(Controls):
    """Of a wheel: how fast its rim turns and how much it slips; its height follows from the soil."""

    def reset(self) -> None:
        super().reset()
        self.angle, self.x = 0.0, float(self.first[0])

    @property
    def told(self) -> dict[str, float]:
        return {key: value for key, value in self.wanted.items() if key != "speed"}

    def pose(self) -> np.ndarray:
        turned = self.wanted.get("slip_angle", getattr(self.scene, "slip_angle", 0.0))
        return np.array([self.x, *self.first[1:3], *about_z_y(math.radians(turned), self.angle)])

    @property
    def _radius(self) -> float:
        assert isinstance(self.scene.body, Cylinder)
        return 0.5 * self.scene.body.diameter

    def _move(self, dt: float) -> None:
        slip = self.wanted["slip"]
        # As of `mpm_warp.Wheel`, whose slip follows from a travel speed, or the other way round.
        as_given = slip >= 0.0 or getattr(self.scene, "travel_speed", None) is None
        travel = self.speed * (1.0 - slip if as_given else 1.0 / (1.0 + slip))
        self.x = self._along(self.x + travel * dt)
        self.angle += self.speed * dt / self._radius

    def _sliders(self) -> list[Slider]:
        scene: Any = self.scene
        _, rim = self._trained("the tool's rotation per frame", 1, self.rate * self._radius) or (0.0, 0.0)
        rim = rim if rim > 0.0 else scene.rim_speed
        found = [
            Slider("speed", "rim speed", "mm/s", 1e3, 1e-4, 0.0, 1.5 * rim, rim, (0.0, rim)),
            Slider("slip", "slip", "%", 100.0, 0.01, -0.5, 1.0, scene.slip, self._trained("slip")),
        ]
        if (load := self._trained("load")) and isinstance(scene.load, (int, float)):
            found.append(
                Slider("load", "load", "N", 1.0, 1.0, 0.5 * load[0], 1.5 * load[1], scene.load, load)
            )
        if turned := self._trained("slip_angle"):
            ends = max(turned[0] - MARGIN, -90.0), min(turned[1] + MARGIN, 90.0)
            found.append(Slider("slip_angle", "steering", "°", 1.0, 1.0, *ends, scene.slip_angle, turned))
        return found


def rake_of(quaternion: np.ndarray) -> float:
    """Angle about -y from upright [degrees]: the tip leads where it is positive."""
    x, y, z, w = quaternion
    return math.degrees(math.atan2(2.0 * (x * z - w * y), w * w + z * z - x * x - y * y))
