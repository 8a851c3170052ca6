"""A 3D material point method for granular soil, in NVIDIA Warp. Usable alone; needs warp and numpy only."""

from .arrangement import arrange
from .bodies import Box, Cylinder, MeshBody, Plate
from .effects import Effects
from .errors import SceneError, SolverStopped
from .excavation import Excavation
from .material import Material
from .push import Push
from .scene import Bed, Scene
from .solver import Frame, Solver
from .wheel import Wheel

__all__ = [
    "Bed",
    "Box",
    "Cylinder",
    "Effects",
    "Excavation",
    "Frame",
    "Material",
    "MeshBody",
    "Plate",
    "Push",
    "Scene",
    "SceneError",
    "Solver",
    "SolverStopped",
    "Wheel",
    "arrange",
]
