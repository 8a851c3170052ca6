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
from .node_rows import splines

LOOSE, DENSE = 0.9, 0.98
"""Shares of an undisturbed bed's density between which a node comes to count as dense: at rest it does, whatever
the round-off, and nothing jumps where soil comes apart."""
APART = 0.005
"""ln J from which on soil has no say at all in the mean volume change."""


@cache
def loose_soil(real: type) -> SimpleNamespace:
    """Warp functions in precision `real` for particles with ln J > 0, which bear no stress:

    - `apart(ln_j)`: 0 for dense soil to 1 for soil that is loose for good,
    - `volume(ln_j, first, f, nodes, grid)`: its ln J.

    `first` is the lowest of its 27 nodes, `f` its offset from there [cells], and the fourth number of `nodes` is the
    density over that of an undisturbed bed. With a dense node among them the particle is at a surface, or next to a
    body, where the mean density says how much soil is missing around it and nothing about the particle: its own ln J
    holds.
    """
    vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)
    Grid, weights = grid_struct(real), splines(real).weights

    @wp.func
    def ramp(x: real, low: real, high: real):
        return wp.clamp((x - low) / (high - low), real(0.0), real(1.0))

    @wp.func
    def apart(ln_j: real):
        return ramp(ln_j, real(0.0), real(APART))

    @wp.func
    def volume(ln_j: real, first: int, f: vec3, nodes: wp.array(dtype=vec4), grid: Grid):
        wx = weights(f[0])
        wy = weights(f[1])
        wz = weights(f[2])
        mean = real(0.0)
        densest = real(0.0)
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    density = nodes[first + (i * grid.ny + j) * grid.nz + k][3]
                    densest = wp.max(densest, density)
                    mean += wx[i] * wy[j] * wz[k] * density
        own = ramp(densest, real(LOOSE), real(DENSE))
        return own * ln_j - (real(1.0) - own) * wp.log(wp.max(mean, real(1.0e-6)))

    return SimpleNamespace(apart=apart, volume=volume)
