"""A 3D material point method for granular soil, in NVIDIA Warp.

Usable alone; needs warp, numpy, scipy, manifold3d and pydantic.
"""

from .bed import Bed, Walls, arrange
from .bodies import Box, Cylinder, MeshBody, Plate, Sphere
from .discretisation import asymmetry
from .effects import Decision, Effects, Tolerances, effects_for
from .limits import substeps_per_frame
from .material import Material
from .motions import Other
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
    "Other",
    "Plate",
    "Preview",
    "Scene",
    "SceneError",
    "Soil",
    "Solver",
    "SolverStopped",
    "Sphere",
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
