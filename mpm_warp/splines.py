"""Quadratic B-splines: which 27 nodes a particle touches, and with what weights."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from .grid import grid_struct

__all__ = ["splines"]


@cache
def splines(real: type) -> SimpleNamespace:
    """Warp functions in precision `real`:

    - `base_and_offset(x, grid)` -> lowest of the three nodes per axis, and the distance from it in cells,
    - `weights(f)` -> the three weights along an axis at distance f,
    - `moments(w, f)` -> weights times the node's distance from the particle.
    """
    vec3 = wp.types.vector(3, real)
    Grid = grid_struct(real)

    @wp.func
    def base_and_offset(x: vec3, grid: Grid):
        # Lowest of the three nodes per axis, and the particle's distance from it in cells, in [0.5, 1.5).
        # The index is bounded: a stray position must not write outside the grid (it would end the process).
        g = (x - grid.origin) * grid.inverse_spacing
        i = wp.clamp(int(g[0] - real(0.5)), 0, grid.nx - 3)
        j = wp.clamp(int(g[1] - real(0.5)), 0, grid.ny - 3)
        k = wp.clamp(int(g[2] - real(0.5)), 0, grid.nz - 3)
        return wp.vec3i(i, j, k), g - vec3(real(i), real(j), real(k))

    @wp.func
    def weights(f: real):
        a = real(1.5) - f
        b = f - real(1.0)
        c = f - real(0.5)
        return vec3(real(0.5) * a * a, real(0.75) - b * b, real(0.5) * c * c)

    @wp.func
    def moments(w: vec3, f: real):
        return vec3(-f * w[0], (real(1.0) - f) * w[1], (real(2.0) - f) * w[2])

    return SimpleNamespace(base_and_offset=base_and_offset, weights=weights, moments=moments)
