"""How much of the bed could be skipped because it is at rest while a blade cuts?

    python experiments/resting_soil/run.py

Writes table.csv beside this script: for tolerances of speed, the share of particles slower than that, and the share in
blocks of 4 x 4 x 4 cells that could be left out safely: no particle in the block or in a neighbouring one is faster.
"""

from __future__ import annotations

import csv
import logging
from pathlib import Path

import numpy as np
from hydra import compose, initialize_config_module

from mpm_warp import Effects, Solver
from sgns.simulate.scene import scene_from_config

HERE = Path(__file__).parent
TOLERANCES = (1e-4, 3e-4, 1e-3, 3e-3)  # [m/s]
BLOCK = 4  # cells


def shares(position: np.ndarray, fast: np.ndarray, edge: float) -> tuple[float, float]:
    """Share of particles that are not fast, and of those with no fast one in their block or next to it."""
    block = np.floor(position / edge).astype(int)
    block -= block.min(axis=0) - 1
    awake = np.zeros(block.max(axis=0) + 2, dtype=bool)
    awake[tuple(block[fast].T)] = True
    for axis in range(3):
        awake = awake | np.roll(awake, 1, axis) | np.roll(awake, -1, axis)
    return float(np.mean(~fast)), float(np.mean(~awake[tuple(block.T)]))


def main() -> None:
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    with initialize_config_module("sgns.conf", version_base="1.3"):
        scene = scene_from_config(compose("simulate", ["scene=quick_excavation"]))
    rows = []
    for frame in Solver(scene, Effects(symmetry=True)).frames():
        if frame.index % 20 or not frame.index:
            continue
        speed = np.linalg.norm(frame.velocity, axis=1)
        row = {"time": round(frame.time, 3), "draft": round(-float(frame.force[0]), 1)}
        for tolerance in TOLERANCES:
            slow, skipped = shares(frame.position, speed > tolerance, BLOCK * scene.bed.spacing)
            row |= {f"slow_{tolerance:g}": round(slow, 2), f"skipped_{tolerance:g}": round(skipped, 2)}
        rows.append(row)
        logging.info("%s", row)
    with (HERE / "table.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, rows[0])
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
