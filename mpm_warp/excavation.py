"""A plate cuts through a bed."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from .bodies import Plate
from .errors import SceneError
from .motion import MOTIONS, curved, ramp, sampled_poses
from .rotation import about_y, rotate
from .scene import Scene

__all__ = ["Excavation"]


@dataclass(frozen=True)
class Excavation(Scene):
    """A plate cuts through the bed along x."""

    name: str = "excavation"
    kind: str = "excavation"
    blade: Plate = field(default_factory=Plate)
    depth: float = 0.05
    """Depth the motion law reaches below the tip's starting height [m]."""
    speed: float = 0.10
    """Forward speed of the cut [m/s]."""
    rake: float = 10.0
    """Angle of the plate from vertical, tip leading [degrees]."""
    motion: str = "curved"
    """curved | ramp | rest | path."""
    start: float = 0.10
    """Where the tip starts, as a share of the bin's length."""
    clearance: float = 0.00665
    """Height of the tip above the surface at the start [m]; the cut is this much shallower than `depth`."""
    path: tuple[tuple[float, ...], ...] | None = None
    """For motion=path: rows t [s], x, y, z [m], qx, qy, qz, qw of the plate's centre of mass."""
    body_grid: tuple[int, int] = (3, 5)
    """Rows and columns of body nodes on the front face."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.motion not in MOTIONS:
            raise SceneError(f"scene.motion is {self.motion!r}; allowed: {', '.join(MOTIONS)}")
        if self.motion == "path":
            if self.path is None:
                raise SceneError(
                    "scene.motion=path needs scene.path, a CSV file with columns t,x,y,z,qx,qy,qz,qw"
                )
            object.__setattr__(self, "path", tuple(tuple(float(v) for v in row) for row in self.path))
        elif self.path is not None:
            raise SceneError(
                f"scene.path is given but scene.motion is {self.motion!r}; use scene.motion=path"
            )
        if not (math.isfinite(self.depth) and self.depth >= 0):
            raise SceneError(f"scene.depth is {self.depth} m; it must be 0 or more")
        if not (math.isfinite(self.speed) and self.speed > 0):
            raise SceneError(f"scene.speed is {self.speed} m/s; it must be above 0")
        if not -60.0 <= self.rake <= 60.0:
            raise SceneError(f"scene.rake is {self.rake} degrees; allowed: -60 to 60")
        if not 0.0 <= self.start <= 1.0:
            raise SceneError(f"scene.start is {self.start}; allowed: 0 to 1, a share of the bin's length")
        self._check_thickness("blade.thickness")
        object.__setattr__(self, "body_grid", tuple(int(c) for c in self.body_grid))
        if len(self.body_grid) != 2 or not all(1 <= c <= 100 for c in self.body_grid):
            raise SceneError(f"scene.body_grid is {self.body_grid}; it needs two counts from 1 to 100")
        self._check_inside("the plate", "change scene.depth, speed, start, duration or the path")

    @property
    def body(self) -> Plate:
        return self.blade

    def poses_at(self, time: np.ndarray) -> np.ndarray:
        time = np.atleast_1d(np.asarray(time, dtype=float))
        if self.motion == "path":
            return sampled_poses(np.asarray(self.path), time)
        rotation = about_y(-math.radians(self.rake))
        lx, ly, _ = self.bed.size
        start = np.array([self.start * lx, 0.5 * ly, self.clearance]) - rotate(rotation, self.blade.tip)
        law = {"curved": curved, "ramp": ramp, "rest": lambda t, *_: np.zeros((len(t), 2))}[self.motion]
        moved = law(time, self.depth, self.speed)
        poses = np.empty((len(time), 7))
        poses[:, :3] = start
        poses[:, [0, 2]] += moved
        poses[:, 3:] = rotation
        return poses

    def path_times(self) -> np.ndarray:
        return np.array([row[0] for row in self.path or ()])

    def body_points(self) -> np.ndarray:
        return self.blade.points(*self.body_grid)

    def warnings(self) -> list[str]:
        found = super().warnings()
        if self.blade.thickness < 2.0 * self.bed.spacing:
            found.append(
                f"the plate is {self.blade.thickness / self.bed.spacing:.1f} grid spacings thick; below 2 the soil "
                "behind it feels the soil in front of it"
            )
        return found

    def summary(self, force: np.ndarray, torque: np.ndarray, poses: np.ndarray) -> str:
        return f"mean draft {-np.mean(force[1:, 0]):.1f} N, vertical force {np.mean(force[1:, 2]):.1f} N"
