"""What the units of FMI 2 and 3 share: pose in, wrench out. It goes into the FMU beside fmi2.py or fmi3.py."""

import sgns
from mpm_warp import Scene
from sgns.coupling import Coupling

POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
WRENCH = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")
WORDS = {
    "checkpoint": "file, or name of one that ships",
    "between": "hold, interpolate or extrapolate",
    "guess": "far outside the training range",
}


class Soil:
    """Soil under a tool; all variables are attributes."""

    author = "sgns"
    description = "Granular soil under a tool: pose in, force and torque out"

    def set_defaults(self) -> None:
        self.checkpoint, self.between = "excavation", "hold"
        self.x, self.y, self.z, self.qx, self.qy, self.qz, self.qw = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0
        self.Fx = self.Fy = self.Fz = self.Tx = self.Ty = self.Tz = 0.0
        self.guess, self.begin = False, 0.0

    def exit_initialization_mode(self) -> None:
        self.soil = Coupling(sgns.Simulator.load(self.checkpoint), self.between)
        if not any((self.x, self.y, self.z)):  # not set: where the training runs begin
            start = Scene.from_dict(self.soil.simulator.scene).body_poses()[0].tolist()
            self.x, self.y, self.z, self.qx, self.qy, self.qz, self.qw = start
        self.soil.reset([getattr(self, name) for name in POSE], self.begin)

    def do_step(self, current_time: float, step_size: float) -> bool:
        # The pose that is set before a step is that of its beginning.
        wrench = self.soil.step(current_time, [getattr(self, name) for name in POSE])
        values = [*wrench.force.tolist(), *wrench.torque.tolist()]
        self.Fx, self.Fy, self.Fz, self.Tx, self.Ty, self.Tz = values
        self.guess = bool(self.soil.state.outside > 0.5)
        return True
