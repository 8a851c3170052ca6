"""A silo with rough walls whose bottom is lowered: the pressure on it saturates (Janssen)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mpm_warp import Bed, Plate, Scene, Solver, Walls

WIDTH = 0.1  # between the walls [m]
CELLS = 8  # grid spacings between the walls


@dataclass(frozen=True)
class Silo(Scene):
    """Soil between two rough walls, endless in y, on a smooth piston that goes down."""

    kind: str = "silo"
    height: float = 0.2
    """Of the fill [m]."""
    speed: float = 0.02
    """Of the piston [m/s]."""

    @property
    def body(self) -> Plate:
        return Plate(length=4.0 * self.bed.spacing, width=1.0, thickness=1.0, friction=0.0, edge="square")

    @property
    def filled(self) -> tuple[np.ndarray, float]:
        positions, volume = self.bed.filled
        return positions[positions[:, 2] > -self.height], volume

    def poses_at(self, time: np.ndarray) -> np.ndarray:
        poses = super().poses_at(time)
        poses[:, 0] = 0.5 * self.bed.size[0]
        # The lowest particles rest where contact begins: `contact_distance` off the piston's face.
        face = self.filled[0][:, 2].min() - self.contact_distance
        poses[:, 2] = face - 0.5 * self.body.length - self.speed * np.atleast_1d(time)
        return poses


def silo(height: float, friction: float, particles_per_cell: float = 8.0, cells: int = CELLS) -> Silo:
    h = WIDTH / cells
    bed = Bed(
        size=(WIDTH, 4 * h, height + 8 * h),
        spacing=h,
        particles_per_cell=particles_per_cell,
        initial_stress="k0",
        headroom=0.05,
        walls=Walls(friction, "periodic"),
    )
    return Silo(bed=bed, duration=0.6, frame_rate=100.0, height=height)


def bottom_pressure(scene: Silo) -> float:
    """Mean over the last third of the run [Pa]."""
    force = [f.force[2] for f in Solver(scene).frames()]
    return -float(np.mean(force[2 * len(force) // 3 :])) / (scene.bed.size[0] * scene.bed.size[1])


def janssen(scene: Silo) -> float:
    """Pressure on the bottom with the elastic lateral stress ratio K0 that the fill starts with [Pa]."""
    weight = scene.material.bulk_density * scene.gravity
    length = WIDTH / (2.0 * scene.bed.walls.x * scene.material.lateral_stress_ratio)
    return weight * length * (1.0 - math.exp(-scene.height / length))


def measure() -> list[dict]:
    rows = []
    for friction in (0.2, 0.4):
        for filled in (0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0):
            scene = silo(filled * WIDTH, friction)
            rows.append(
                {
                    "friction": friction,
                    "height_over_width": filled,
                    "pressure": bottom_pressure(scene),
                    "janssen": janssen(scene),
                    "hydrostatic": scene.material.bulk_density * scene.gravity * scene.height,
                }
            )
    return rows
