"""How long may a step be? The force of a small cut against the Courant number, past what scenes allow.

    python experiments/stability/step.py

Writes step.csv beside this script.
"""

from __future__ import annotations

import csv
import logging
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import mpm_warp.limits
from mpm_warp import Material, Solver, SolverStopped

HERE = Path(__file__).resolve().parent
sys.path.insert(1, str(HERE.parents[1] / "support"))

from sgns_testing.scenes import cut  # noqa: E402

COURANT = (0.1, 0.2, 0.4, 0.6, 0.8, 0.83, 0.86, 0.9, 0.95, 1.0, 1.05, 1.2, 1.5)


def mean_force(courant: float, particles_per_cell: float, youngs_modulus: float) -> tuple[float, float, str]:
    """Draft and vertical force [N] over the second half of the cut, and why there is none."""
    bed = replace(cut().bed, particles_per_cell=particles_per_cell)
    scene = cut(bed=bed, material=Material(youngs_modulus=youngs_modulus))
    object.__setattr__(scene, "courant", courant)  # past the check
    try:
        frames = list(Solver(scene).frames())
    except SolverStopped as stopped:
        return np.nan, np.nan, str(stopped).split(": ")[1]
    x, _, z = np.mean([f.force for f in frames[len(frames) // 2 :]], axis=0)
    return -x, z, ""


def main() -> None:
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    mpm_warp.limits.STABLE_COURANT = math.inf  # past the guard, which would stop all runs from 0.86 on
    with (HERE / "step.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["youngs_modulus", "particles_per_cell", "courant", "draft", "vertical", "stopped"])
        for youngs_modulus, count in ((1e6, 1.0), (1e6, 8.0), (5e7, 1.0)):
            for courant in COURANT:
                draft, vertical, why = mean_force(courant, count, youngs_modulus)
                row = [f"{youngs_modulus:g}", f"{count:g}", courant, f"{draft:.1f}", f"{vertical:.1f}", why]
                logging.info("%s", row)
                writer.writerow(row)


if __name__ == "__main__":
    main()
