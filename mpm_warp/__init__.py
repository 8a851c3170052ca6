"""A 3D material point method for granular soil, in NVIDIA Warp. Usable alone; needs warp and numpy only."""

from .arrangement import arrange
from .bodies import Plate
from .column import Column
from .effects import Effects
from .errors import SceneError, SolverStopped
from .incline import Incline
from .material import Material
from .scene import Bed, Excavation, Scene
from .solver import Frame, Solver
from .time_step import substeps_per_frame
from .symmetry import asymmetry
from .walls import Walls

__all__ = [
    "Bed",
    "Column",
    "Effects",
    "Excavation",
    "Frame",
    "Incline",
    "Material",
    "Plate",
    "Scene",
    "SceneError",
    "Solver",
    "SolverStopped",
    "Walls",
    "arrange",
    "substeps_per_frame",
    "asymmetry",
]
