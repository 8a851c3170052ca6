"""A smooth wall is pushed into a layer of soil: Rankine's passive force with the cone's own coefficient."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mpm_warp import Bed, Material, Plate, Scene, Solver, Walls

DEPTH = 0.08  # of the layer [m]
BEHIND = 0.1  # where the wall starts [m]


@dataclass(frozen=True)
class RetainingWall(Scene):
    """A smooth wall as deep as the layer, endless in y, on a smooth floor."""

    kind: str = "retaining_wall"
    speed: float = 0.05
    """[m/s]"""

    @property
    def body(self) -> Plate:
        return Plate(length=0.4, width=1.0, thickness=2.0 * BEHIND, friction=0.0, edge="square")

    @property
    def filled(self) -> tuple[np.ndarray, float]:
        positions, volume = self.bed.filled
        return positions[positions[:, 0] > BEHIND], volume

    @property
    def soil_volume(self) -> float:
        return super().soil_volume * (1.0 - BEHIND / self.bed.size[0])

    def poses_at(self, time: np.ndarray) -> np.ndarray:
        poses = super().poses_at(time)
        # Soil touches the wall where contact begins.
        face = self.filled[0][:, 0].min() - self.contact_distance + self.speed * np.atleast_1d(time)
        poses[:, 0] = face - 0.5 * self.body.thickness
        poses[:, 2] = 0.5 * self.body.length - DEPTH
        return poses


def retaining_wall(friction: float, cells: int = 8, particles_per_cell: float = 1.0) -> RetainingWall:
    """A layer `cells` grid spacings deep."""
    h = DEPTH / cells
    bed = Bed(
        size=(0.6, 4 * h, DEPTH),
        spacing=h,
        particles_per_cell=particles_per_cell,
        headroom=0.1,
        walls=Walls("no_slip", "periodic", 0.0),
    )
    soil = Material(static_friction=friction, limit_friction=friction + 0.2)
    return RetainingWall(bed=bed, material=soil, duration=0.3, frame_rate=100.0)


def coefficient(scene: RetainingWall) -> np.ndarray:
    """Passive coefficient 2 F / (rho g depth^2) of the frames after the first."""
    weight = 0.5 * scene.material.bulk_density * scene.gravity * DEPTH**2 * scene.bed.size[1]
    return np.array([-f.force[0] / weight for f in Solver(scene).frames()][1:])


def expected(friction: float) -> float:
    """(1 + mu_s) / (1 - mu_s): in plane strain without volume change the cone has sin(phi) = mu_s."""
    return (1.0 + friction) / (1.0 - friction)


def measure() -> list[dict]:
    rows = []
    for friction in (0.3, 0.5):
        for cells, ppc in ((8, 1), (12, 1), (16, 1), (8, 8), (12, 8)):
            scene = retaining_wall(friction, cells, ppc)
            case = {"friction": friction, "cells": cells, "particles_per_cell": ppc}
            for i, value in enumerate(coefficient(scene), start=1):
                travel = scene.speed * i / scene.frame_rate
                rows.append(case | {"travel": travel, "coefficient": value, "theory": expected(friction)})
    return rows
