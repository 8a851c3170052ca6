"""The background grid and the particles on it: their arrays, the nodes that a particle touches, and the grid's step:
momentum to velocity, gravity, floor and walls."""

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from ..launch import Launch, SceneKernel


@cache
def grid_struct(real: type) -> type:
    """Struct of the grid and the step in precision `real`."""
    vec3 = wp.types.vector(3, real)

    @wp.struct
    class Grid:
        origin: vec3  # position of node (0, 0, 0) [m]
        spacing: real  # dx [m]
        inverse_spacing: real  # 1 / dx [1/m]
        nx: int
        ny: int
        nz: int
        dt: real  # [s]
        substep: wp.array(dtype=int)  # how many steps of the frame are done, (1,)
        volume_averaging: real  # share of a particle's own volume change that the mean replaces
        forgetting: real  # share of recent volume changes that a step forgets
        damping: real  # viscous time of the elastic strain / dt
        gravity: vec3  # [m/s^2]
        # Nodes with index <= low or >= high belong to the floor and the walls.
        low: wp.vec3i
        high: wp.vec3i
        wall_friction: vec3  # Coulomb coefficient of x walls, y walls and floor, where they have one
        particle_mass: real  # [kg]
        particle_volume: real  # at the critical density [m^3]
        on_plane: int  # so many particles, the first ones, lie on a plane of symmetry and count half
        density_per_mass: real  # of a node: soil's density there over that of an undisturbed bed [1/kg]
        beyond_walls: vec3  # whole around a node on an x wall, a y wall, the floor over its part in the bin
        speed_limit: real  # one cell per step [m/s]

    return Grid


@cache
def particle_struct(real: type) -> type:
    """Struct of the particles' arrays in precision `real`."""
    vec3, vec4, vec6 = (wp.types.vector(size, real) for size in (3, 4, 6))
    mat33 = wp.types.matrix((3, 3), real)

    @wp.struct
    class Particles:
        position: wp.array(dtype=vec3)  # [m]
        home: wp.array(dtype=vec3)  # position at the last remap [m]
        velocity: wp.array(dtype=vec3)  # at the last remap [m/s]
        felt_velocity: wp.array(dtype=vec4)  # of the grid at `home` [m/s], and the mean of `swelling` there
        velocity_gradient: wp.array(dtype=mat33)  # [1/s]
        elastic_strain: wp.array(dtype=vec6)  # deviatoric part
        log_volume: wp.array(dtype=real)  # ln J
        stress: wp.array(dtype=vec6)  # Kirchhoff [Pa]
        swelling: wp.array(dtype=real)  # sum of the recent volume changes
        fluidity: wp.array(dtype=real)  # [1/s], with the effect `fluidity`
        excess: wp.array(dtype=real)  # fluidity that cooperative flow adds [1/s], with `nonlocality`
        bond: wp.array(dtype=real)  # ln J up to which soil bears stress, with `cohesion` and `separation`

    return Particles


# --- The nodes that a particle touches: quadratic B-splines ---------------------------------------------


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


# --- The step of the grid: momentum to velocity, gravity, floor and walls -------------------------------


@cache
def node_functions(real: type) -> SimpleNamespace:
    """Warp functions on a node in precision `real`: `place`, its three indices from its number; `rub`, its velocity
    after what it touches, a wall or a body, from that relative to it, the normal out of it and Coulomb's coefficient.
    """
    vec3, Grid = wp.types.vector(3, real), grid_struct(real)

    @wp.func
    def place(n: int, grid: Grid):
        # `/` of whole numbers is one instruction; `//` and `%` follow Python's rule for negative numbers.
        column = n / grid.nz
        i = column / grid.ny
        return wp.vec3i(i, column - i * grid.ny, n - column * grid.nz)

    @wp.func
    def rub(v: vec3, inward: vec3, friction: real):
        # What moves into the wall is stopped, and slowed along the wall by Coulomb friction.
        into = wp.dot(v, inward)
        if into >= real(0.0):
            return v
        sliding = v - into * inward
        speed = wp.length(sliding)
        if speed <= -friction * into:
            return vec3()
        return sliding * (real(1.0) + friction * into / speed)

    return SimpleNamespace(place=place, rub=rub)


@cache
def grid_step(real: type, walls: tuple[str, str, str]) -> SimpleNamespace:
    """Kernels on the nodes in precision `real`.

    - `begin`: momentum and mass to velocity, 1 / mass and the density over that of an undisturbed bed after a remap.
      A node on a wall sees but a part of what is around it; soil is taken to go on beyond.
    - `step`: velocity from the step's impulse and gravity, walls and floor; counts the step.

    Both clear what they have used for the next sum. `walls` are the kinds of x walls, y walls and floor
    (`Walls.conditions`); the kernels hold no code of other kinds.
    """
    vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)
    Grid, vec4s, reals = grid_struct(real), wp.array(dtype=vec4), wp.array(dtype=real)
    place, rub = node_functions(real).place, node_functions(real).rub

    @wp.func
    def no_slip(v: vec3, inward: vec3, friction: real):
        return vec3()

    @wp.func
    def slip(v: vec3, inward: vec3, friction: real):
        return v - wp.dot(v, inward) * inward

    conditions = {"no_slip": no_slip, "slip": slip, "friction": rub, "periodic": slip}
    at_x, at_y, at_floor = (conditions[kind] for kind in walls)

    @wp.func
    def walls_seen(n: int, grid: Grid):
        at = place(n, grid)
        share = real(1.0)
        for axis in range(3):
            if at[axis] == grid.low[axis] or at[axis] == grid.high[axis]:
                share *= grid.beyond_walls[axis]
        return share

    @SceneKernel
    def begin(
        n: int,
        grid: Grid,
        momentum: vec4s,
        velocity: vec4s,
        before: vec4s,
        inverse_mass: reals,
        impulse: vec4s,
    ):
        node = momentum[n]
        mass = node[3]
        result = vec4()
        inverse = real(0.0)
        # A node that a particle on a cell's face barely touches has no mass to speak of, and 1 / mass no value.
        if mass > real(1.0e-20) * grid.particle_mass:
            inverse = real(1.0) / mass
            result = vec4(node[0] / mass, node[1] / mass, node[2] / mass, real(0.0))
        momentum[n] = vec4()
        impulse[n] = vec4()
        velocity[n] = result
        result[3] = mass * grid.density_per_mass * walls_seen(n, grid)
        before[n] = result
        inverse_mass[n] = inverse

    @SceneKernel
    def step(n: int, grid: Grid, velocity: vec4s, inverse_mass: reals, impulse: vec4s):
        # `static` around the walls' functions: Warp knows a kernel by its text and its functions, but not under which
        # names it calls these. Without, walls x slip, y no_slip would get the kernel of x no_slip, y slip.
        if n == 0:
            grid.substep[0] = grid.substep[0] + 1
        inverse = inverse_mass[n]
        if inverse > real(0.0):
            change = impulse[n]
            now = velocity[n] + inverse * change
            impulse[n] = vec4()
            v = vec3(now[0], now[1], now[2]) + grid.dt * grid.gravity
            at = place(n, grid)
            low = grid.low
            high = grid.high
            rough = grid.wall_friction
            if wp.static(walls[0] != "periodic"):
                if at[0] <= low[0]:
                    v = wp.static(at_x)(v, vec3(real(1.0), real(0.0), real(0.0)), rough[0])
                if at[0] >= high[0]:
                    v = wp.static(at_x)(v, vec3(real(-1.0), real(0.0), real(0.0)), rough[0])
            if wp.static(walls[1] != "periodic"):
                if at[1] <= low[1]:
                    v = wp.static(at_y)(v, vec3(real(0.0), real(1.0), real(0.0)), rough[1])
                if at[1] >= high[1]:
                    v = wp.static(at_y)(v, vec3(real(0.0), real(-1.0), real(0.0)), rough[1])
            if at[2] <= low[2]:
                v = wp.static(at_floor)(v, vec3(real(0.0), real(0.0), real(1.0)), rough[2])
            velocity[n] = vec4(v[0], v[1], v[2], inverse * change[3])

    return SimpleNamespace(begin=begin, step=step)


@cache
def _adding(number: type) -> SceneKernel:
    @SceneKernel
    def add(i: int, total: wp.array(dtype=number), own: wp.array(dtype=number)):
        total[i] = total[i] + own[i]
        own[i] = number()

    return add


def adding_up(arrays: list[wp.array]) -> list[tuple[SceneKernel, list[wp.array]]]:
    """Kernels with their arguments that add what other threads have in theirs to the first one's array, and clear
    theirs (`Threads.copies`)."""
    total, *others = arrays
    return [(_adding(total.dtype), [total, own]) for own in others]


# --- Ghost nodes: those beyond a mirror or a periodic side ----------------------------------------------


_REACH = 2  # layers of ghost nodes: one more than the splines of a particle on the plane reach


def mirror_layers(sum_of_indices: int) -> np.ndarray:
    """Ghost layers and their images, shape (m, 2), where layers j and `sum_of_indices` - j mirror each other."""
    first = (sum_of_indices + 1) // 2 - _REACH
    return np.array([(j, sum_of_indices - j) for j in range(first, sum_of_indices // 2 + 1)])


def periodic_layers(low: int, cells: int) -> np.ndarray:
    """Ghost layers and their images, shape (m, 2), where layers j and j + `cells` are the same and layer `low` is
    the first of the period."""
    before = [(low - j, low - j + cells) for j in range(1, _REACH + 1)]
    after = [(low + cells + j, low + j) for j in range(_REACH)]
    return np.array(before + after)


@cache
def ghost_kernels(real: type) -> SimpleNamespace:
    """Kernels `fold`, `unfold` (one thread per row of nodes across the plane) and `wrap` in precision `real`."""
    vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)
    vec4s, layers = wp.array(dtype=vec4), wp.array(dtype=wp.vec2i)

    @wp.func
    def node_of(row: int, layer: int, stride: int, extent: int):
        return (row // stride) * stride * extent + row % stride + layer * stride

    @SceneKernel
    def fold(row: int, nodes: vec4s, pairs: layers, sign: vec4, stride: int, extent: int):
        """Add ghost layers to their images; `sign` mirrors a node's momentum, `stride` and `extent` are the axis'."""
        for q in range(pairs.shape[0]):
            ghost = node_of(row, pairs[q][0], stride, extent)
            image = node_of(row, pairs[q][1], stride, extent)
            amount = wp.cw_mul(sign, nodes[ghost])
            nodes[image] = nodes[image] + amount
            if ghost != image:
                nodes[ghost] = vec4()

    @SceneKernel
    def unfold(row: int, velocity: vec4s, pairs: layers, sign: vec4, stride: int, extent: int):
        """Give ghost layers the velocity of their images."""
        for q in range(pairs.shape[0]):
            ghost = node_of(row, pairs[q][0], stride, extent)
            image = node_of(row, pairs[q][1], stride, extent)
            velocity[ghost] = wp.cw_mul(sign, velocity[image])

    @SceneKernel
    def wrap(p: int, x: wp.array(dtype=vec3), turns: wp.array(dtype=int), axis: int, length: real):
        """Bring particles back into 0 <= x < length along an axis and count the turns."""
        at = x[p]
        if at[axis] < real(0.0):
            at[axis] = at[axis] + length
            turns[p] = turns[p] - 1
            x[p] = at
        elif at[axis] >= length:
            at[axis] = at[axis] - length
            turns[p] = turns[p] + 1
            x[p] = at

    return SimpleNamespace(fold=fold, unfold=unfold, wrap=wrap)


class GhostNodes:
    """Launches that keep ghost nodes and their images in agreement.

    `layers` are those of an axis and their images, shape (m, 2). With `mirrored` the layers along y are mirror images;
    all others are one period apart.
    """

    def __init__(
        self, real: type, device: wp.Device, grid: Any, layers: dict[int, np.ndarray], mirrored: bool
    ) -> None:
        vec4 = wp.types.vector(4, real)
        self._kernels, self._device, self._axes = ghost_kernels(real), device, []
        for axis, pairs in layers.items():
            extent, stride = ((grid.nx, grid.ny * grid.nz), (grid.ny, grid.nz))[axis]
            sign = vec4(1.0, -1.0 if mirrored and axis == 1 else 1.0, 1.0, 1.0)
            rows = grid.nx * grid.ny * grid.nz // extent
            self._axes.append((rows, wp.array(pairs, dtype=wp.vec2i, device=device), sign, stride, extent))

    def fold(self, nodes: wp.array) -> list[Launch]:
        """Add ghost layers to their images."""
        return [Launch(self._kernels.fold, rows, [nodes, *axis], self._device) for rows, *axis in self._axes]

    def unfold(self, nodes: wp.array) -> list[Launch]:
        """Give ghost layers the values of their images."""
        axes = reversed(self._axes)
        return [Launch(self._kernels.unfold, rows, [nodes, *axis], self._device) for rows, *axis in axes]
