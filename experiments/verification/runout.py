"""Columns of soil collapse: how far they run, against their aspect ratio, and how steep the piles are that stay."""

from __future__ import annotations

import logging
import math

import numpy as np

from mpm_warp import Bed, Column, Effects, Material, Solver, Walls

RADIUS = 0.04  # [m]
CELLS = {"cylinder": 8, "slab": 10}  # grid spacings in the radius
SOIL = Material(static_friction=0.5, limit_friction=0.7)


def collapse(shape: str, aspect: float) -> Column:
    """A column on a rough floor, let go for as long as it takes to fall and stop."""
    h = RADIUS / CELLS[shape]
    height = aspect * RADIUS
    reach = RADIUS * (2.0 + (2.5 if shape == "cylinder" else 3.0) * aspect ** (0.6 if aspect > 2 else 1.0))
    side = 2.0 * h * math.ceil(reach / h)
    bed = Bed(
        size=(side, side if shape == "cylinder" else 4 * h, height),
        spacing=h,
        particles_per_cell=1.0,
        headroom=4 * h,
        walls=Walls("no_slip", "no_slip" if shape == "cylinder" else "slip"),
    )
    duration = 6.0 * math.sqrt(height / 9.81) + 0.3
    return Column(bed=bed, material=SOIL, shape=shape, radius=RADIUS, duration=duration, frame_rate=10.0)


def pile(scene: Column) -> dict:
    """Run-out over the first radius, height over it, mean slope [degrees] and fastest 1 % [m/s] at the end.

    The front is where 99 % of the soil lie within, compared with the same measure of the column.
    """
    frame = list(Solver(scene, Effects(symmetry=True)).frames())[-1]
    before, after = (_distance(scene, x) for x in (scene.initial_positions(), frame.position))
    front = RADIUS * float(np.quantile(after, 0.99) / np.quantile(before, 0.99))
    half_cell = 0.5 * scene.bed.spacing  # a particle stands for soil half a cell further up
    top = np.quantile(frame.position[after < 0.5 * RADIUS, 2], 0.99) + half_cell + scene.bed.size[2]
    return {
        "runout": front / RADIUS - 1.0,
        "final_height": float(top) / RADIUS,
        "slope": math.degrees(math.atan(top / front)),
        "speed": float(np.quantile(np.linalg.norm(frame.velocity, axis=1), 0.99)),
    }


def _distance(scene: Column, position: np.ndarray) -> np.ndarray:
    off = position[:, :2] - 0.5 * np.asarray(scene.bed.size[:2])
    return np.abs(off[:, 0]) if scene.shape == "slab" else np.hypot(off[:, 0], off[:, 1])


ASPECTS = (0.5, 1.0, 1.5, 3.0, 5.0, 8.0)
EXPONENTS = {"cylinder": (1.0, 0.5), "slab": (1.0, 2.0 / 3.0)}
"""Of squat and tall columns, as measured by others."""


def exponents(rows: list[dict], shape: str) -> tuple[float, float]:
    """Slopes of log run-out over log aspect ratio for squat (up to 1.5) and tall (from 3) columns."""
    found = [(r["aspect"], r["runout"]) for r in rows if r["shape"] == shape]
    fits = []
    for part in ([f for f in found if f[0] <= 1.5], [f for f in found if f[0] >= 3.0]):
        fits.append(float(np.polyfit(*np.log(np.array(part)).T, 1)[0]))
    return tuple(fits)


def measure() -> list[dict]:
    rows = [
        {"shape": shape, "aspect": aspect} | pile(collapse(shape, aspect))
        for shape in EXPONENTS
        for aspect in ASPECTS
    ]
    for shape, known in EXPONENTS.items():
        logging.info("%s: exponents %s, known %s", shape, exponents(rows, shape), known)
    return rows
