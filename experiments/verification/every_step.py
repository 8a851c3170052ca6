"""Bagnold's flow with a remap in every step: the numerical viscosity that the default numerics avoid.

    python experiments/verification/every_step.py

Writes every_step.csv beside this script; about five minutes on one core.
"""

from __future__ import annotations

import csv
import logging
from pathlib import Path

from bagnold import layer, profile

HERE = Path(__file__).parent
PLAIN = {"elastic_damping": 0.0, "volume_averaging": 0.0, "remap_time": 0.0, "velocity_memory": 1.0e-9}
"""The group numerics=every_step."""
CASES = (
    (0.003, 0.6),
    (0.003, 0.15),
    (0.0015, 0.6),
)  # grid spacing [m], share of the largest time step; 8 per cell


def main() -> None:
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    with (HERE / "every_step.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["spacing", "particles_per_cell", "courant", "mean_speed", "mean_theory"])
        for spacing, courant in CASES:
            _, speed, steady = profile(layer(spacing, 8, courant, **PLAIN))
            row = [spacing, 8, courant, f"{speed.mean():.4f}", f"{steady.mean():.4f}"]
            logging.info("%s: %.1f %%", row, 100.0 * (speed.mean() / steady.mean() - 1.0))
            writer.writerow(row)
            stream.flush()


if __name__ == "__main__":
    main()
