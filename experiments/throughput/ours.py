"""mpm_warp on a bin, one core; writes the case file the others read, or prints its rates as JSON.

python ours.py --particles 29700 --blade --seconds 5
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
import warp as wp

from mpm_warp import Bed, Effects, Excavation, Material, Scene, Solver

MATERIAL = Material(youngs_modulus=1.0e6)
BLOCK = 1e7  # particle-steps between two looks at the clock


def bed(particles: int) -> Bed:
    """The paper's bin with about so many particles, one per cell."""
    size = (0.8, 0.6, 0.15)
    return Bed(size=size, spacing=(size[0] * size[1] * size[2] / particles) ** (1.0 / 3.0))


def cut(particles: int) -> Excavation:
    """The paper's excavation: 8 cm deep, 10 cm/s, rake 10 degrees."""
    return Excavation(bed=bed(particles), material=MATERIAL, depth=0.08, speed=0.10, rake=10.0)


def time_step(particles: int) -> float:
    """Substep of the bed without a body [s]."""
    return Solver(Scene(bed=bed(particles), material=MATERIAL)).time_step


def write_case(path: Path, particles: int) -> None:
    """What the other solvers need to know, as plain arrays."""
    soil, scene = bed(particles), cut(30_000)
    positions, volume = soil.filled
    np.savez(
        path,
        position=positions,
        volume=volume,
        spacing=soil.spacing,
        size=soil.size,
        headroom=soil.headroom,
        dt=time_step(particles),
        density=MATERIAL.bulk_density,
        youngs_modulus=MATERIAL.youngs_modulus,
        poissons_ratio=MATERIAL.poissons_ratio,
        friction=MATERIAL.static_friction,
        poses=scene.body_poses(),
        half_size=scene.blade.half_size,
        body_friction=scene.blade.friction,
        frame_rate=scene.frame_rate,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--particles", type=int, default=30_000)
    parser.add_argument(
        "--blade", action="store_true", help="full law and contact; else a bed at constant friction"
    )
    parser.add_argument("--seconds", type=float, default=5.0)
    options = parser.parse_args()
    if options.blade:
        scene, effects = cut(options.particles), Effects()
    else:
        soil = bed(options.particles)
        # Frames so short that the clock is looked at often, also with many particles.
        rate = 1.0 / (max(1, round(BLOCK / len(soil.filled[0]))) * time_step(options.particles))
        scene = Scene(bed=soil, material=MATERIAL, duration=60.0, frame_rate=rate)
        effects = Effects(rate_dependence=False)
    solver = Solver(scene, effects)
    frames, seconds = solver.frames(), options.seconds
    begin, warm = time.process_time(), 0
    while warm < (5 if options.blade else 3) or time.process_time() - begin < 0.3 * seconds:
        next(frames)
        warm += 1
    times, stop = [], time.process_time() + seconds
    while len(times) < 3 or time.process_time() < stop:
        begin = time.process_time()
        next(frames)
        times.append(time.process_time() - begin)
    found = {
        "version": f"warp {wp.__version__}",
        "particles": solver.particle_count,
        "rates": [solver.particle_count * solver.substeps_per_frame / spent for spent in times],
        "s_per_simulated_s": [spent * scene.frame_rate for spent in times],
    }
    print(json.dumps(found))


if __name__ == "__main__":
    main()
