"""Any body along a path."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from .bodies import Body, Box, Cylinder, MeshBody
from .errors import SceneError
from .motion import sampled_poses
from .scene import Scene

__all__ = ["Push"]


@dataclass(frozen=True)
class Push(Scene):
    """A box, a cylinder or a mesh moves through the bed along a path of its centre of mass."""

    name: str = "body"
    kind: str = "body"
    tool: Box | Cylinder | MeshBody = field(default_factory=Box)
    path: tuple[tuple[float, ...], ...] | None = None
    """Rows t [s], x, y, z [m], qx, qy, qz, qw of the body's centre of mass."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.path is None:
            raise SceneError("scene.path is missing: a CSV file with columns t,x,y,z,qx,qy,qz,qw")
        object.__setattr__(self, "path", tuple(tuple(float(v) for v in row) for row in self.path))
        self._check_thickness("a body")
        self._check_inside("the body", "change scene.path or scene.duration")

    @property
    def body(self) -> Body:
        return self.tool

    def poses_at(self, time: np.ndarray) -> np.ndarray:
        return sampled_poses(np.asarray(self.path), np.atleast_1d(np.asarray(time, dtype=float)))

    def path_times(self) -> np.ndarray:
        return np.array([row[0] for row in self.path])

    def body_points(self) -> np.ndarray:
        return self.tool.points()

    def summary(self, force: np.ndarray, torque: np.ndarray, poses: np.ndarray) -> str:
        x, y, z = force[1:].mean(axis=0)
        return f"mean force ({x:.1f}, {y:.1f}, {z:.1f}) N"
