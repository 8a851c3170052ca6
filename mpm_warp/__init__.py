"""A 3D material point method for granular soil, in NVIDIA Warp. Usable alone; needs warp and numpy only."""

from .arrangement import arrange
from .batch import frames_together
from .bodies import Box, Cylinder, MeshBody, Plate
from .column import Column
from .effects import Effects
from .effects_for import Decision, Tolerances, effects_for
from .errors import SceneError, SolverStopped
from .excavation import Excavation
from .incline import Incline
from .material import Material
from .push import Push
from .scene import Bed, Scene
from .solver import Frame, Solver
from .state import State
from .symmetry import asymmetry
from .time_step import substeps_per_frame
from .walls import Walls
from .wheel import Wheel

__all__ = [
    "Bed",
    "Box",
    "Column",
    "Cylinder",
    "Decision",
    "Effects",
    "Excavation",
    "Frame",
    "Incline",
    "Material",
    "MeshBody",
    "Plate",
    "Push",
    "Scene",
    "SceneError",
    "Solver",
    "SolverStopped",
    "State",
    "Tolerances",
    "Walls",
    "Wheel",
    "arrange",
    "asymmetry",
    "effects_for",
    "frames_together",
    "substeps_per_frame",
]
