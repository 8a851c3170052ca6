"""What was measured: wheels, soils, conditions, which of them fix parameters, and how an answer is judged."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

sys.path.insert(1, str(Path(__file__).resolve().parents[1]))

from common import read_rows

DATA = Path(__file__).parent / "data"
RIM_SPEEDS = (0.0, 0.003, 0.005, 0.008, 0.010, 0.013, 0.020, 0.040, 0.100)  # at a travel of 10 mm/s [m/s]
SLIPS = (-1.0, -0.7, -0.5, -0.2, 0.0, 0.23, 0.5, 0.75, 0.9)  # of these rim speeds
TRAVEL = 0.010  # [m/s]
GRAVITY = 9.81  # [m/s^2]
FIXES = (-1.0, 0.0, 0.5)  # slips of straight rolling that may fix parameters; the rest is judged
QUANTITIES = {"fx": "pull [N]", "fy": "lateral force [N]", "sinkage": "sinkage [m]", "torque": "torque [N m]"}


class Wheel(NamedTuple):
    """Smooth."""

    radius: float
    """[m]"""
    width: float
    """[m]"""


SMALL = Wheel(0.058, 0.050)
"""Of the 63 conditions."""


class Soil(NamedTuple):
    """As its authors give it."""

    density: float
    """Bulk [kg/m^3]."""
    friction_angle: float
    """[degrees]"""
    cohesion: float = 0.0
    """[Pa]"""

    @property
    def angle(self) -> float:
        """Of friction [rad]."""
        return math.radians(self.friction_angle)


class Forces(NamedTuple):
    """Of the soil on the wheel [N, N m].

    x is the wheel's heading, y its axle; the wheel travels towards -y where the slip angle is not 0, so that the soil
    pushes towards +y as in the tables. The torque is what the drive must give, against the soil's.
    """

    fx: float
    fy: float
    fz: float
    torque: float


@dataclass(frozen=True)
class Condition:
    """One wheel at one slip angle and one rim speed: what was set, and means and scatter over trials."""

    source: str
    wheel: Wheel
    soil: Soil
    slip_angle: float
    """Between the wheel's plane and its travel [degrees]."""
    slip: float
    """1 - travel / rim speed, or rim speed / travel - 1 where the rim is slower."""
    load: float
    """[N]"""
    measured: Mapping[str, float]
    """Means over trials by QUANTITIES."""
    scatter: Mapping[str, float]
    """Standard deviations over trials, where there are several."""

    @property
    def angle(self) -> float:
        """The slip angle [rad]."""
        return math.radians(self.slip_angle)

    @property
    def rim_speed(self) -> float:
        """At the travel of the trials [m/s]."""
        return TRAVEL / (1.0 - self.slip) if self.slip > 0.0 else TRAVEL * (1.0 + self.slip)

    @property
    def fixed(self) -> bool:
        """Whether parameters may be fixed from it; otherwise it is judged."""
        return self.source == "cmu" and self.slip_angle == 0.0 and self.slip in FIXES

    @property
    def key(self) -> tuple[str, float, float]:
        return self.source, self.slip_angle, self.slip


def cmu() -> list[Condition]:
    """The 63 conditions of the small wheel, trials averaged."""
    trials: dict[tuple[float, float], list[list[float]]] = {}
    for row in read_rows(DATA / "cmu_wheel_smooth.csv"):
        slip = min(SLIPS, key=lambda s: abs(s - float(row["slip"])))
        values = [float(row[name]) for name in ("fx_N", "fy_N", "sinkage_mm", "load_N")]
        trials.setdefault((float(row["slip_angle_deg"]), slip), []).append(values)
    found = []
    for (angle, slip), rows in trials.items():
        scale = np.array([1.0, 1.0, 1e-3, 1.0])
        mean, scatter = np.mean(rows, axis=0) * scale, np.std(rows, axis=0, ddof=1) * scale
        names = ("fx", "fy", "sinkage")
        found.append(
            Condition(
                "cmu",
                SMALL,
                Soil(1330.0, 29.0),
                angle,
                slip,
                float(mean[3]),
                dict(zip(names, map(float, mean), strict=False)),
                dict(zip(names, map(float, scatter), strict=False)),
            )
        )
    return found


def ding() -> list[Condition]:
    """The six conditions of the larger wheel, all judged."""
    found = []
    for row in read_rows(DATA / "ding2011_wheel_smooth.csv"):
        wheel = Wheel(float(row["wheel_radius_m"]), float(row["wheel_width_m"]))
        columns = {"fx": "meas_drawbar_pull_n", "sinkage": "meas_sinkage_m", "torque": "meas_torque_nm"}
        measured = {name: float(row[column]) for name, column in columns.items()}
        soil = Soil(1605.0, 31.9, 250.0)
        load = float(row["vertical_load_n"])
        found.append(Condition("ding", wheel, soil, 0.0, float(row["slip"]), load, measured, {}))
    return found


def steady(force_at: Callable[[float], Forces], condition: Condition) -> dict[str, float]:
    """Forces and sinkage where the soil carries the load: the smallest such depth.

    Args:
        force_at: forces at a depth of the wheel's lowest point [m].

    A wheel that finds no support within its height counts as sunk by 1.9 radii.
    """

    def excess(depth: float) -> float:
        return force_at(depth).fz - condition.load

    lower = 0.0
    for depth in condition.wheel.radius * np.linspace(0.0, 1.9, 39)[1:]:
        if excess(depth) >= 0.0:
            depth = brentq(excess, lower, depth)
            break
        lower = depth
    return {**force_at(depth)._asdict(), "sinkage": float(depth)}


def errors(
    conditions: list[Condition], answers: Mapping[tuple, Mapping[str, float]]
) -> dict[str, np.ndarray]:
    """|error| of each judged condition that has an answer, as a share of the largest |value| measured anywhere."""
    found = {}
    for name in QUANTITIES:
        measured = [c for c in conditions if name in c.measured]
        judged = [c for c in measured if not c.fixed and name in answers.get(c.key, {})]
        if judged:
            largest = max(abs(c.measured[name]) for c in measured)
            found[name] = np.array([abs(answers[c.key][name] - c.measured[name]) / largest for c in judged])
    return found
