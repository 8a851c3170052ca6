"""Soil in the loop of another program: poses of the tool in at any rate, force and torque out.

The soil goes on in frames, 1/60 s for the shipped networks. A frame's force is its mean over that frame, so it is known
only at the frame's end; what is given until the next frame ends is a choice, see `Coupling`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from mpm_warp.poses import rotate, sampled_poses
from sgns.config import UserError
from sgns.numbers import check_pose, finite_array
from sgns.simulator import Simulator, State

BETWEEN = ("hold", "interpolate", "extrapolate")
"""What is given between two frames of the soil."""
_ROUNDING = 1e-6  # of a frame: control times are sums of steps


class Wrench(NamedTuple):
    """By the soil on the tool, in the world frame."""

    force: np.ndarray
    """[N], shape (3,)."""
    torque: np.ndarray
    """About the tool's origin [N m], shape (3,)."""


class Coupling:
    """Steps a simulator's soil whenever a frame is due, and gives the wrench at every moment.

    Between frames:

    - "hold": the newest frame's force. On average it is one frame late.
    - "interpolate": from the force of the frame before to the newest, without jumps; one and a half frames late.
    - "extrapolate": on the line through both; not late, but jumps are half as large again.

    The tool's pose at the end of a frame lies between the two poses around it. The wrench is zero until the first
    frame ends. Steps longer than a frame take several; the wrench is that of the last one.

    Args:
        simulator: Of a tool whose motion is prescribed; it is stepped, and is at `state`.
        between: One of `BETWEEN`.
        origin: The tool's origin, whose poses are given and about which the torque is, from its centre of mass in the
            body frame [m], shape (3,).

    Attributes:
        state: Of the soil at the end of the newest frame.
        time: Of the newest pose [s].

    Raises:
        UserError: The network predicts a wheel's height, or an argument is not as above.
    """

    def __init__(
        self,
        simulator: Simulator,
        between: str = "hold",
        origin: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
    ) -> None:
        if between not in BETWEEN:
            raise UserError(f"between is {between!r}; allowed: {', '.join(BETWEEN)}")
        if simulator.predicts_body:
            raise UserError(
                "this network predicts a wheel's height, so the pose is not given to it; a coupling needs a network of "
                "a tool on a prescribed path"
            )
        self.simulator, self.between = simulator, between
        self.origin = finite_array(origin, "origin", (3,))
        self.period = 1.0 / simulator.frame_rate
        self.reset()

    def reset(self, pose: Any = None, time: float = 0.0, values: Mapping[str, Any] | None = None) -> Wrench:
        """The bed at rest with the tool's origin at a pose, at a time [s]; values as of `Simulator.reset`. Without a
        pose the tool is where the first step puts it, and the first frame begins there."""
        pose, time = None if pose is None else check_pose(pose), self._checked(time, -np.inf)
        self.state: State = self.simulator.reset(None if pose is None else self._centre(pose), values=values)
        # All is in order: nothing is changed before.
        self.pose: np.ndarray | None = pose
        self.time, self._values = time, values
        self._begin, self._frame = time, 0
        self._loads = [(np.zeros(3), np.zeros(3))] * 2
        return Wrench(np.zeros(3), np.zeros(3))

    def step(self, time: float, pose: Any) -> Wrench:
        """The wrench on a tool whose origin is at a pose (7,) at a time [s], not before the last one.

        Raises:
            UserError: Time or pose are not as above; then nothing has changed.
        """
        time, pose = self._checked(time, self.time), check_pose(pose)
        if self.pose is None:
            self.state = self.simulator.reset(self._centre(pose), values=self._values)
            self._begin, self.pose, self.time = time, pose, time
        while (due := self._begin + (self._frame + 1) * self.period) <= time + _ROUNDING * self.period:
            there = pose
            if due < time and time > self.time:
                rows = np.array([[self.time, *self.pose], [time, *pose]])
                there = sampled_poses(rows, np.array([due]))[0]
            self.state = self.simulator.step(self._centre(there))
            self._loads = [self._loads[1], (self.state.force, self.state.torque)]
            self._frame += 1
        self.time, self.pose = time, pose
        return self._wrench()

    def _wrench(self) -> Wrench:
        """At the newest time and pose."""
        (force_before, torque_before), (force, torque) = self._loads
        if self.between != "hold":
            share = (self.time - self._begin) / self.period - self._frame
            share = min(max(share, 0.0), 1.0) - 1.0 if self.between == "interpolate" else share + 0.5
            force, torque = force + share * (force - force_before), torque + share * (torque - torque_before)
        assert self.pose is not None
        if self.origin.any():
            torque = torque - np.cross(rotate(self.pose[3:], self.origin), force)
        return Wrench(force.copy(), torque.copy())

    def _centre(self, pose: np.ndarray) -> np.ndarray:
        """The pose of the centre of mass."""
        return np.concatenate([pose[:3] - rotate(pose[3:], self.origin), pose[3:]])

    def _checked(self, time: float, before: float) -> float:
        try:
            found = float(time)
        except (TypeError, ValueError):
            found = np.nan
        if not (math.isfinite(found) and before <= found):
            after = (
                "" if before == -np.inf else f", not before the last one, {before:g} s; to begin again: reset"
            )
            raise UserError(f"the time is {time!r}; it must be a finite number of seconds{after}")
        return found
