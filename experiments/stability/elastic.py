"""Where the energy of grains comes from that elastic soil throws up: the quick cut with effects.yielding=false.

    python experiments/stability/elastic.py

Prints, ten times in its first second, how high soil is, its energy and what the blade has done.
"""

from __future__ import annotations

import logging

import numpy as np
from hydra import compose, initialize_config_module

from mpm_warp import Effects, Scene, Solver
from sgns.simulate.scene import scene_from_config

SETTINGS = ["scene=quick_excavation", "scene.duration=1", "scene.bed.headroom=0.8"]
EVERY = 6  # frames


def energies(solver: Solver, scene: Scene, frame) -> tuple[float, float, float]:
    """Kinetic, potential and elastic energy of the soil [J]; half of it is computed."""
    material, (_, volume) = scene.material, scene.filled
    mass = material.bulk_density * volume
    shear = material.shear_modulus
    bulk = shear * 2.0 * (1.0 + material.poissons_ratio) / (3.0 * (1.0 - 2.0 * material.poissons_ratio))
    strain, ln_j = (array.numpy().astype(float) for array in (solver._e, solver._ln_j))
    squared = (strain[:, :3] ** 2).sum() + 2.0 * (strain[:, 3:] ** 2).sum()
    elastic = 2.0 * volume * (shear * squared + 0.5 * bulk * (np.minimum(ln_j, 0.0) ** 2).sum())
    kinetic = 0.5 * mass * (frame.velocity.astype(float) ** 2).sum()
    return kinetic, mass * scene.gravity * frame.position[:, 2].astype(float).sum(), elastic


def main() -> None:
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    with initialize_config_module("sgns.conf", version_base="1.3"):
        scene = scene_from_config(compose("simulate", SETTINGS))
    solver = Solver(scene, Effects(yielding=False, rate_dependence=False, symmetry=True))
    work, before, start = 0.0, None, None
    for frame in solver.frames():
        if before is not None:
            work -= float(frame.force @ (frame.body_pose[:3] - before))
        before = frame.body_pose[:3]
        if frame.index % EVERY:
            continue
        kinetic, potential, elastic = energies(solver, scene, frame)
        start = potential + elastic if start is None else start
        logging.info(
            "%.2f s: highest %.2f m; kinetic %.2f J, elastic %.1f J, in all %.1f J more than at the start; work %.1f J",
            *(
                frame.time,
                frame.position[:, 2].max(),
                kinetic,
                elastic,
                kinetic + potential + elastic - start,
                work,
            ),
        )


if __name__ == "__main__":
    main()
