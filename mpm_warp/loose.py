"""The volume of soil that came apart.

While soil is dense, ln J of a particle is the sum of what its velocity gradient said, exact in the small: pressure is a
matter of thousandths. Soil in free fall, in a spray or in the air behind a blade has no pressure that keeps neighbours
in step. There the sum loses touch with how far apart the particles are: what lands is too high, or too low, by tens of
per cent. So where soil bears no stress and the grid sees none that is dense, ln J is what the grid sees.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from .grid import grid_struct
from .splines import splines

__all__ = ["loose"]

DENSE = 0.98
"""Share of an undisturbed bed's density from which on a node counts as dense: less than 1 by more than round-off."""


@cache
def loose(real: type) -> SimpleNamespace:
    """Warp function `volume(ln_j, first, f, nodes, grid)` in precision `real`: ln J of a particle that bears no stress.

    `first` is the lowest of its 27 nodes, `f` its offset from there [cells], and the fourth number of `nodes` is the
    density over that of an undisturbed bed. With a dense node among them the particle is at a surface, or next to a
    body, where the mean density says how much soil is missing around it and nothing about the particle: its own ln J
    holds.
    """
    vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)
    Grid, weights = grid_struct(real), splines(real).weights

    @wp.func
    def volume(ln_j: real, first: int, f: vec3, nodes: wp.array(dtype=vec4), grid: Grid):
        wx = weights(f[0])
        wy = weights(f[1])
        wz = weights(f[2])
        mean = real(0.0)
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    density = nodes[first + (i * grid.ny + j) * grid.nz + k][3]
                    if density > real(DENSE):
                        return ln_j
                    mean += wx[i] * wy[j] * wz[k] * density
        return -wp.log(wp.max(mean, real(1.0e-6)))

    return SimpleNamespace(volume=volume)
