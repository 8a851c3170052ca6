"""A 3D material point method for granular soil, in NVIDIA Warp.

Usable alone; needs warp, numpy, scipy, manifold3d and pydantic.
"""

from .bed import Bed, Walls, arrange
from .bodies import Box, Cylinder, MeshBody, Plate
from .discretisation import asymmetry
from .effects import Decision, Effects, Tolerances, effects_for
from .limits import substeps_per_frame
from .material import Material
from .preview import Preview
from .scene import Scene
from .scenes import Body, Column, Excavation, Incline, Wheel
from .solver import Frame, Solver, frames_together
from .state import SceneError, Soil, SolverStopped, State

__all__ = [
    "Bed",
    "Body",
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
    "Preview",
    "Scene",
    "SceneError",
    "Soil",
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
