"""The stress soil starts with."""

from __future__ import annotations

import numpy as np

from .scene import Scene

__all__ = ["initial_stress"]


def initial_stress(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """ln J, shape (n,), and the deviatoric elastic strain xx, yy, zz, xy, xz, yz, shape (n, 6), at time 0.

    `geostatic` is isotropic: the vertical stress of rest at once, so nothing settles. In a tilted bin it holds the
    shear stress rho g_x d at depth d, too, that carries an endless slope.
    """
    positions, volume = scene.filled
    material, (pull, _, fall) = scene.material, scene.gravity_vector
    ln_j, strain = np.zeros(len(positions)), np.zeros((len(positions), 6))
    if scene.bed.initial_stress == "geostatic":
        density = material.bulk_density * len(positions) * volume / scene.soil_volume
        depth = np.maximum(-positions[:, 2], 0.0)
        ln_j = density * fall * depth / material.bulk_modulus
        strain[:, 4] = density * pull * depth / (2.0 * material.shear_modulus)
    return ln_j, strain
