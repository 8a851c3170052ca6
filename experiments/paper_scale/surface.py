"""What do two measures of the soil's surface say of the same small errors? Writes surface.csv.

python experiments/paper_scale/surface.py

Three frames of each test run of reduced/paper_excavation, decoded from all 64 modes, against the same with fewer modes,
with noise on every particle, and against soil that stays. No network is involved.
"""

from __future__ import annotations

import math
from collections import defaultdict

import numpy as np
import torch
from run import HERE, filled, packed_dataset, write_rows

from sgns.data.surface import height_map, particle_spacing, surface_grid
from sgns.evaluate.metrics import height_error

FRAMES = (100, 200, 300)
MODES = (8, 16, 32)
NOISE = (1.0, 3.0)  # deviation along each axis [mm]


def main() -> None:
    data = packed_dataset(HERE.parents[1] / "reduced" / "paper_excavation", {"num_modes": 64})
    grid, volume = surface_grid(data.start_positions), particle_spacing(data.start_positions) ** 3
    rng = np.random.default_rng(0)
    squares: dict[str, list[list[float]]] = defaultdict(list)
    for run in data.runs("test"):
        for frame in FRAMES:
            latent = torch.from_numpy(run.latent[frame])
            true = data.basis.inverse(latent).numpy()
            changed = {f"{r} modes": data.basis.sliced(r).inverse(latent[:r]).numpy() for r in MODES}
            changed |= {f"noise {mm:g} mm": true + rng.normal(0.0, 1e-3 * mm, true.shape) for mm in NOISE}
            changed["nothing moves"] = data.start_positions
            for name, soil in changed.items():
                squares[name].append(
                    [
                        float(np.square(soil - true).mean()),  # along an axis, as everywhere
                        height_error(height_map(soil, grid), height_map(true, grid)),
                        height_error(filled(soil, grid, volume), filled(true, grid, volume)),
                    ]
                )
    rows = []
    for name, values in squares.items():
        position, highest, fill = (1e3 * math.sqrt(mean) for mean in np.mean(values, axis=0))
        rows.append({"change": name, "position_mm": position, "highest_mm": highest, "filled_mm": fill})
        print(rows[-1])
    write_rows(HERE / "surface.csv", rows, digits=3)


if __name__ == "__main__":
    main()
