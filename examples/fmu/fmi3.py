"""Soil under a tool as an FMU for co-simulation, FMI 3.0.

pip install 'sgns[fmi]'
pythonfmu3 build -f examples/fmu/fmi3.py examples/fmu/soil.py  # makes SoilTool.fmu

Where it runs there must be a Python with sgns: the FMU holds these files, and the importing program loads Python.
"""

from pythonfmu3 import Boolean, Float64, Fmi3Causality, Fmi3Slave, Fmi3Variability, String
from soil import POSE, WORDS, WRENCH, Soil


class SoilTool(Soil, Fmi3Slave):
    def __init__(self, **kwargs) -> None:
        super().__init__(**kwargs)
        self.set_defaults()
        self.time = 0.0
        self.register_variable(
            Float64("time", causality=Fmi3Causality.independent, variability=Fmi3Variability.continuous)
        )
        fixed = {"causality": Fmi3Causality.parameter, "variability": Fmi3Variability.tunable}
        for name in ("checkpoint", "between"):
            self.register_variable(String(name, **fixed, description=WORDS[name]))
        for name in POSE:
            self.register_variable(
                Float64(name, causality=Fmi3Causality.input, variability=Fmi3Variability.continuous)
            )
        for name in WRENCH:
            self.register_variable(
                Float64(name, causality=Fmi3Causality.output, variability=Fmi3Variability.continuous)
            )
        discrete = {"causality": Fmi3Causality.output, "variability": Fmi3Variability.discrete}
        self.register_variable(Boolean("guess", **discrete, description=WORDS["guess"]))

    def setup_experiment(self, start_time) -> None:
        self.begin = start_time
