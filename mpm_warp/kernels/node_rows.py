"""The nodes that a particle touches: quadratic B-splines, and rows of nodes as one wide vector."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from .grid import grid_struct


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


# --- Rows of grid nodes: the three nodes along z that a particle touches, handled as one wide vector ----
# The transfers are sums over 27 nodes of four numbers. Warp turns the arithmetic of its vectors into single
# numbers, and the C++ compiler does not put them together again. On the CPU these few operations therefore use
# the compiler's own vector type, which it maps to whatever registers the processor has. On a GPU a thread works
# on single numbers anyway, so plain Warp code does the same there.


@cache
def row_operations(real: type, gpu: bool) -> SimpleNamespace:
    """Type `row` of four nodes (16 numbers, the last node is padding) in precision `real`, and Warp functions

    - `plus(a, w, b)` -> a + w b,
    - `gather(nodes, at)` -> the row that begins at node `at`,
    - `scatter(nodes, at, r)` adds row r to the nodes from `at` on,
    - `spread(w, a, step)` -> row of w_k (a + k step), k = 0, 1, 2,
    - `fold(w, r)` -> sum of w_k times node k.

    On the CPU `gather` and `scatter` touch the padding, so an array needs one node beyond the last row.
    """
    if gpu:
        return _plain(real)
    vec3, vec4, row = wp.types.vector(3, real), wp.types.vector(4, real), wp.types.vector(16, real)
    number = f"wp::{real.__name__}"
    types = f"""
        typedef {number} node __attribute__((vector_size(4 * sizeof({number}))));
        typedef {number} lanes __attribute__((vector_size(16 * sizeof({number}))));
    """

    @wp.func_native(f"""{types}
        lanes x, y;
        __builtin_memcpy(&x, &a, sizeof(x));
        __builtin_memcpy(&y, &b, sizeof(y));
        x += w * y;
        wp::vec_t<16, {number}> sum;
        __builtin_memcpy(&sum, &x, sizeof(x));
        return sum;
    """)
    def plus(a: row, w: real, b: row) -> row: ...

    @wp.func_native(f"""{types}
        wp::vec_t<16, {number}> r;
        __builtin_memcpy(&r, nodes.data + at, sizeof(lanes));
        return r;
    """)
    def gather(nodes: wp.array(dtype=vec4), at: int) -> row: ...

    # A plain sum: one thread runs the kernel.
    @wp.func_native(f"""{types}
        lanes x, y;
        __builtin_memcpy(&x, nodes.data + at, sizeof(x));
        __builtin_memcpy(&y, &r, sizeof(y));
        x += y;
        __builtin_memcpy(nodes.data + at, &x, sizeof(x));
    """)
    def scatter(nodes: wp.array(dtype=vec4), at: int, r: row): ...

    @wp.func_native(f"""{types}
        node x, d, n[4] = {{}};
        __builtin_memcpy(&x, &a, sizeof(x));
        __builtin_memcpy(&d, &step, sizeof(d));
        n[0] = w[0] * x;
        n[1] = w[1] * (x + d);
        n[2] = w[2] * (x + d + d);
        wp::vec_t<16, {number}> r;
        __builtin_memcpy(&r, n, sizeof(n));
        return r;
    """)
    def spread(w: vec3, a: vec4, step: vec4) -> row: ...

    @wp.func_native(f"""{types}
        node n[4];
        __builtin_memcpy(n, &r, sizeof(n));
        node x = w[0] * n[0] + w[1] * n[1] + w[2] * n[2];
        wp::vec_t<4, {number}> sum;
        __builtin_memcpy(&sum, &x, sizeof(x));
        return sum;
    """)
    def fold(w: vec3, r: row) -> vec4: ...

    return SimpleNamespace(row=row, plus=plus, gather=gather, scatter=scatter, spread=spread, fold=fold)


def _plain(real: type) -> SimpleNamespace:
    vec3, vec4, row = wp.types.vector(3, real), wp.types.vector(4, real), wp.types.vector(16, real)

    @wp.func
    def join(a: vec4, b: vec4, c: vec4):
        zero = real(0.0)
        return row(
            a[0], a[1], a[2], a[3], b[0], b[1], b[2], b[3], c[0], c[1], c[2], c[3], zero, zero, zero, zero
        )  # fmt: skip

    @wp.func
    def node(r: row, k: int):
        return vec4(r[4 * k], r[4 * k + 1], r[4 * k + 2], r[4 * k + 3])

    @wp.func
    def plus(a: row, w: real, b: row):
        return a + w * b

    @wp.func
    def gather(nodes: wp.array(dtype=vec4), at: int):
        return join(nodes[at], nodes[at + 1], nodes[at + 2])

    @wp.func
    def scatter(nodes: wp.array(dtype=vec4), at: int, r: row):
        wp.atomic_add(nodes, at, node(r, 0))
        wp.atomic_add(nodes, at + 1, node(r, 1))
        wp.atomic_add(nodes, at + 2, node(r, 2))

    @wp.func
    def spread(w: vec3, a: vec4, step: vec4):
        return join(w[0] * a, w[1] * (a + step), w[2] * (a + step + step))

    @wp.func
    def fold(w: vec3, r: row):
        return w[0] * node(r, 0) + w[1] * node(r, 1) + w[2] * node(r, 2)

    return SimpleNamespace(row=row, plus=plus, gather=gather, scatter=scatter, spread=spread, fold=fold)
