"""The stress update at single points, apart from any grid."""

from dataclasses import replace
from functools import cache

import numpy as np
import warp as wp

from mpm_warp import Effects, Material
from mpm_warp.kernels.constitutive import constitutive
from mpm_warp.kernels.fluidity import soil_parameters, soil_struct
from mpm_warp.launch import start_warp

ROW, COLUMN = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
"""Of the six numbers of a symmetric matrix, as the kernels order them."""


def updated(material, strain, ln_j, a, dt, steps=1, g=0.0, effects: Effects | None = None, real=wp.float64):
    """What points hold after steps in which they are strained the same.

    Args:
        material: of the soil.
        strain: deviatoric elastic strain, shape (n, 3, 3).
        ln_j: log of the volume, shape (n,).
        a: dt times the velocity gradient, shape (n, 3, 3); or several of them one after the other, (m, n, 3, 3).
        dt: step [s].
        steps: how many, of each.
        g: fluidity or the excess of it, as `constitutive` says [1/s], shape (n,).
        effects: by default those of `Effects()`.
        real: precision.

    Returns:
        The new strain (n, 3, 3), ln J (n,) and g (n,).
    """
    effects = replace(effects or Effects(), cohesion=material.cohesion > 0.0)
    kernel, a = _kernel(real, effects), np.asarray(a)
    whole = material.cohesive_pressure / material.bulk_modulus if effects.can_tear else 0.0
    ln_j, g, bond = (np.broadcast_to(values, len(strain)) for values in (ln_j, g, whole))
    e, j, fluidity, holds = (
        wp.array(values, dtype=dtype, device="cpu")
        for values, dtype in (
            (strain[:, ROW, COLUMN], wp.types.vector(6, real)),
            (ln_j, real),
            (g, real),
            (bond, real),
        )
    )
    soil = soil_parameters(real, material, 1.0)
    for one in a if a.ndim == 4 else [a]:
        motion = wp.array(
            np.broadcast_to(one, strain.shape), dtype=wp.types.matrix((3, 3), real), device="cpu"
        )
        wp.launch(kernel, len(strain), [e, j, fluidity, holds, motion, dt, steps, soil], device="cpu")
    full = np.empty(strain.shape)
    full[:, ROW, COLUMN] = full[:, COLUMN, ROW] = e.numpy()
    return full, j.numpy().astype(float), fluidity.numpy().astype(float)


def shear_stress(material: Material, strain: np.ndarray) -> np.ndarray:
    """Equivalent shear stress [Pa] of deviatoric strains (n, 3, 3)."""
    return np.sqrt(2.0) * material.shear_modulus * np.linalg.norm(strain, axis=(1, 2))


def sheared(step: float) -> np.ndarray:
    """dt times the velocity gradient of simple shear in x along z, shape (1, 3, 3)."""
    a = np.zeros((1, 3, 3))
    a[0, 0, 2] = step
    return a


@cache
def _kernel(real, effects):
    start_warp()
    law, Soil = constitutive(real, effects), soil_struct(real)
    vec6, mat33, update = law.vec6, law.mat33, law.update

    @wp.kernel(module="unique", enable_backward=False)
    def run(
        e: wp.array(dtype=vec6),
        ln_j: wp.array(dtype=real),
        g: wp.array(dtype=real),
        bond: wp.array(dtype=real),
        a: wp.array(dtype=mat33),
        dt: real,
        steps: int,
        soil: Soil,
    ):
        p = wp.tid()
        for _ in range(steps):
            state = update(e[p], ln_j[p], a[p], dt, soil, g[p], bond[p])
            e[p] = vec6(state[0], state[1], state[2], state[3], state[4], state[5])
            ln_j[p] = state[6]
            g[p] = state[7]
            if wp.static(effects.can_tear):
                bond[p] = state[8]

    return run
