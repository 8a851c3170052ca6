"""The stress soil starts with."""

from __future__ import annotations

import numpy as np

from .scene import Scene

__all__ = ["initial_stress"]


def initial_stress(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """ln J, shape (n,), and the deviatoric elastic strain xx, yy, zz, xy, xz, yz, shape (n, 6), at time 0.

    Both `geostatic` and `k0` hold the vertical stress of rest at once, so nothing settles. `geostatic` is isotropic;
    `k0` has the horizontal stress nu / (1 - nu) times the vertical one, as an elastic bed filled from above has.
    In a tilted bin they hold the shear stress rho g_x d at depth d, too, that carries an endless slope.
    """
    positions, volume = scene.filled
    material, (pull, _, fall) = scene.material, scene.gravity_vector
    ln_j, strain = np.zeros(len(positions)), np.zeros((len(positions), 6))
    if scene.bed.initial_stress != "none":
        density = material.bulk_density * len(positions) * volume / scene.soil_volume
        depth = np.maximum(-positions[:, 2], 0.0)
        ratio = material.lateral_stress_ratio if scene.bed.initial_stress == "k0" else 1.0
        vertical = density * fall * depth  # tension is positive
        ln_j = vertical * (1.0 + 2.0 * ratio) / 3.0 / material.bulk_modulus
        share = vertical * (1.0 - ratio) / (6.0 * material.shear_modulus)
        strain[:, :3] = share[:, None] * np.array([-1.0, -1.0, 2.0])
        strain[:, 4] = density * pull * depth / (2.0 * material.shear_modulus)
    return ln_j, strain
