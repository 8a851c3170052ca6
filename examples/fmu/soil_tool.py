"""Soil under a tool as an FMU for co-simulation (FMI 2.0), for Simulink, Modelica tools, Chrono and others.

pip install 'sgns[fmi]'
pythonfmu build -f examples/fmu/soil_tool.py  # makes SoilTool.fmu

Where it runs there must be a Python with sgns: the FMU holds this file, and the importing program loads Python. Inputs
are the pose of the tool's centre of mass, outputs the wrench about it, in the frame of the bed.
"""

from pythonfmu import Boolean, Fmi2Causality, Fmi2Slave, Fmi2Variability, Real, String

import sgns
from mpm_warp import Scene
from sgns.coupling import Coupling

POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
WRENCH = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")


class SoilTool(Fmi2Slave):
    author = "sgns"
    description = "Granular soil under a tool: pose in, force and torque out"

    def __init__(self, **kwargs) -> None:
        super().__init__(**kwargs)
        self.checkpoint, self.between = "excavation", "hold"
        self.x, self.y, self.z, self.qx, self.qy, self.qz, self.qw = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0
        self.Fx = self.Fy = self.Fz = self.Tx = self.Ty = self.Tz = 0.0
        self.guess, self.begin = False, 0.0
        fixed = {"causality": Fmi2Causality.parameter, "variability": Fmi2Variability.tunable}
        self.register_variable(String("checkpoint", **fixed, description="file, or name of one that ships"))
        self.register_variable(String("between", **fixed, description="hold, interpolate or extrapolate"))
        for name in POSE:
            self.register_variable(Real(name, causality=Fmi2Causality.input))
        for name in WRENCH:
            self.register_variable(Real(name, causality=Fmi2Causality.output))
        self.register_variable(
            Boolean(
                "guess",
                causality=Fmi2Causality.output,
                variability=Fmi2Variability.discrete,
                description="far outside the training range",
            )
        )

    def setup_experiment(self, start_time, stop_time=None, tolerance=None) -> None:
        self.begin = start_time

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
