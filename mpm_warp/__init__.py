"""A 3D material point method for granular soil, in NVIDIA Warp. Usable alone; needs warp and numpy only."""

from .arrangement import arrange
from .bodies import Plate
from .effects import Effects
from .errors import SceneError, SolverStopped
from .material import Material
from .scene import Bed, Excavation, Scene
from .solver import Frame, Solver
from .time_step import substeps_per_frame

__all__ = [
    "Bed",
    "Effects",
    "Excavation",
    "Frame",
    "Material",
    "Plate",
    "Scene",
    "SceneError",
    "Solver",
    "SolverStopped",
    "arrange",
    "substeps_per_frame",
]
