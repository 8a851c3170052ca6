"""Soil under a tool as an FMU for co-simulation, FMI 2.0.

pip install 'sgns[fmi]'
pythonfmu build -f examples/fmu/fmi2.py examples/fmu/soil.py  # makes SoilTool.fmu

Where it runs there must be a Python with sgns: the FMU holds these files, and the importing program loads Python.
"""

from pythonfmu import Boolean, Fmi2Causality, Fmi2Slave, Fmi2Variability, Real, String
from soil import POSE, WORDS, WRENCH, Soil


class SoilTool(Soil, Fmi2Slave):
    def __init__(self, **kwargs) -> None:
        super().__init__(**kwargs)
        self.set_defaults()
        fixed = {"causality": Fmi2Causality.parameter, "variability": Fmi2Variability.tunable}
        for name in ("checkpoint", "between"):
            self.register_variable(String(name, **fixed, description=WORDS[name]))
        for name in POSE:
            self.register_variable(Real(name, causality=Fmi2Causality.input))
        for name in WRENCH:
            self.register_variable(Real(name, causality=Fmi2Causality.output))
        discrete = {"causality": Fmi2Causality.output, "variability": Fmi2Variability.discrete}
        self.register_variable(Boolean("guess", **discrete, description=WORDS["guess"]))

    def setup_experiment(self, start_time, stop_time=None, tolerance=None) -> None:
        self.begin = start_time
