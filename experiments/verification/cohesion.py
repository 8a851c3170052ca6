"""Cohesive soil: the strength of a column that nothing confines, the height of a bank, the draft of a blade."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import mckyes
import numpy as np

from mpm_warp import Bed, Box, Material, Scene, Solver, Walls

SIDE = 0.08  # of the column; it is twice as high [m]
SPEED = 0.02  # of the plate that presses it [m/s]
HEIGHT = 0.16  # of the bank [m]
ANGLE = 30.0  # of friction in column and bank [degrees]


@dataclass(frozen=True)
class Block(Scene):
    """Soil in the corner of a bin, up to x and y as in `end`."""

    kind: str = "block"
    end: tuple[float, float] = (SIDE, SIDE)
    """[m]"""

    @cached_property
    def filled(self) -> tuple[np.ndarray, float]:
        positions, volume = self.bed.filled
        return positions[(positions[:, :2] < self.end).all(axis=1)], volume

    @property
    def soil_volume(self) -> float:
        positions, volume = self.filled
        return len(positions) * volume


@dataclass(frozen=True)
class PressedColumn(Block):
    """A smooth plate moves down on a square column on a smooth floor, without gravity."""

    kind: str = "pressed_column"

    @property
    def body(self) -> Box:
        return Box(size=(3.2 * SIDE, 3.2 * SIDE, 0.02), friction=0.0)

    def poses_at(self, time: np.ndarray) -> np.ndarray:
        poses = super().poses_at(time)
        top = self.filled[0][:, 2].max() + self.contact_distance + 0.5 * self.body.size[2]
        poses[:, :2] = 0.5 * SIDE
        poses[:, 2] = top - SPEED * np.atleast_1d(time)
        return poses


def pressed_column(cohesion: float, friction_map: str = "triaxial", cells: int = 6) -> PressedColumn:
    """A quarter of a column, whose sides in the walls x = 0 and y = 0 are its planes of symmetry."""
    h = SIDE / cells
    bed = Bed(
        size=(1.5 * SIDE, 1.5 * SIDE, 2.0 * SIDE),
        spacing=h,
        particles_per_cell=8.0,
        headroom=0.04,
        initial_stress="none",
        walls=Walls("slip", "slip", "slip"),
    )
    soil = Material(friction_angle=ANGLE, friction_map=friction_map, cohesion=cohesion)
    return PressedColumn(bed=bed, material=soil, gravity=0.0, duration=0.15, frame_rate=200.0)


def strength(scene: PressedColumn) -> float:
    """Pressure of the plate once the column yields: median over the second half [Pa]."""
    force = np.array([frame.force[2] for frame in Solver(scene).frames()])
    return float(np.median(force[len(force) // 2 :])) / SIDE**2


def unconfined(cohesion: float) -> float:
    """2 c cos(phi) / (1 - sin(phi)): Mohr and Coulomb, met by friction_map=triaxial [Pa]."""
    phi = math.radians(ANGLE)
    return 2.0 * cohesion * math.cos(phi) / (1.0 - math.sin(phi))


def bank(height: float, cells: int = 16) -> Block:
    """A bank with a vertical face, endless in y, as high as `height` times 4 c / gamma tan(45 + phi / 2).

    That height needs the least soil: a wedge slides on a plane. Half of it stands by Rankine's stresses alone. With
    nu = 0 the stress of an elastic bank is that of its weight alone, and in balance at the start.
    """
    h = HEIGHT / cells
    bed = Bed(
        size=(3.0 * HEIGHT, 4.0 * h, HEIGHT),
        spacing=h,
        particles_per_cell=4.0,
        headroom=3.0 * h,
        initial_stress="k0",
        walls=Walls("slip", "periodic", "no_slip"),
    )
    soil = Material(friction_angle=ANGLE, friction_map="sin", poissons_ratio=0.0)
    scene = Block(bed=bed, material=soil, duration=0.6, frame_rate=50.0, end=(1.5 * HEIGHT, 1.0))
    weight = soil.bulk_density * scene.gravity * HEIGHT
    cohesion = weight / (4.0 * math.tan(math.radians(45.0 + 0.5 * ANGLE)) * height)
    return replace(scene, material=replace(soil, cohesion=cohesion))


def settlement(scene: Block) -> float:
    """Way of the particle that has moved most, over the height [-]."""
    *_, last = Solver(scene).frames()
    return float(np.linalg.norm(last.position - scene.initial_positions(), axis=1).max()) / HEIGHT


def cohesive_draft(rake: float, cohesion: float, spacing: float) -> tuple[float, float]:
    """What cohesion adds to the draft of an endless blade, and to that of the earth-moving equation [N/m]."""
    dry = mckyes.buried_blade("sin", rake=rake, spacing=spacing)
    scene = replace(dry, material=replace(dry.material, cohesion=cohesion))
    added = mckyes.force_per_width(scene)[0] - mckyes.force_per_width(dry)[0]
    equation = [mckyes.wedge(mckyes.ANGLE, rake, dry.depth, cohesion=c)[0] for c in (cohesion, 0.0)]
    return added, equation[0] - equation[1]


def measure() -> list[dict]:
    rows = []
    for cohesion, cells in ((1000.0, 6), (1000.0, 9), (3000.0, 6)):
        found, known = strength(pressed_column(cohesion, cells=cells)), unconfined(cohesion)
        rows.append(
            {"case": "column", "of": f"{cohesion:g} Pa", "cells": cells, "found": found, "known": known}
        )
    for cells in (16, 24):
        for height in (0.3, 0.4, 0.48, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.3):
            found = settlement(bank(height, cells))
            rows.append(
                {"case": "bank", "of": f"{height:g} of the upper bound", "cells": cells, "found": found}
            )
    for cohesion, spacing in ((1000.0, 0.02), (1000.0, 0.08 / 6), (3000.0, 0.08 / 6), (1000.0, 0.01)):
        for rake in (0.0, 10.0, 30.8):
            found, known = cohesive_draft(rake, cohesion, spacing)
            of, cells = f"rake {rake:g}, {cohesion:g} Pa", round(0.08 / spacing)
            rows.append({"case": "blade", "of": of, "cells": cells, "found": found, "known": known})
    for row in rows:
        row["ratio"] = row["found"] / row["known"] if "known" in row else math.nan
    return rows
