"""A 3D material point method for granular soil, in NVIDIA Warp. Usable alone; needs warp and numpy only."""

import warp as wp

from .arrangement import arrange
from .bodies import Plate
from .effects import Effects
from .errors import SceneError, SolverStopped
from .material import Material
from .scene import Bed, Excavation, Scene
from .solver import Frame, Solver

# Warp announces its start and every kernel it loads; here only its warnings are of use.
wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)

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
]
