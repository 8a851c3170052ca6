"""The soil's constants, its granular fluidity g = (rate of plastic shear) / mu at a single particle, and cooperative
flow, which carries g between neighbours on the grid."""

import math
from collections.abc import Sequence
from functools import cache
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..launch import Launch, SceneKernel, SideBySide, Threads
from ..material import Material
from .grid import GhostNodes, adding_up, grid_struct, particle_struct, splines

if TYPE_CHECKING:
    from ..effects import Effects


@cache
def soil_struct(real: type) -> type:
    """Struct of the soil constants in precision `real` (pressures in Pa, lengths in m)."""

    @wp.struct
    class Soil:
        shear_modulus: real
        bulk_modulus: real
        static_friction: real
        limit_friction: real
        cohesive_pressure: real  # p_c
        reference_rate: real  # I_0 sqrt(1 / rho_s) / d: G dt reference_rate sqrt(p) is the paper's alpha
        reference_inertial_number: real
        linear_rate_law: int  # 1: linear, 0: saturating
        fluidity_time: real  # t_0 [s]
        cooperative_length: real  # A d [m]
        least_slowing: real  # (A d / xi)^2 at the largest xi, the size of the bed

    return Soil


def soil_parameters(real: type, material: Material, bed_size: float) -> Any:
    """The struct filled with the constants of `material`.

    `bed_size` [m] bounds the cooperativity length, which has no bound at mu = mu_s.
    """
    soil = soil_struct(real)()
    soil.shear_modulus, soil.bulk_modulus = material.shear_modulus, material.bulk_modulus
    soil.static_friction, soil.limit_friction = material.static_friction, material.limit_friction
    soil.cohesive_pressure = material.cohesive_pressure
    soil.reference_rate = material.reference_inertial_number / (
        material.grain_diameter * math.sqrt(material.grain_density)
    )
    soil.reference_inertial_number = material.reference_inertial_number
    soil.linear_rate_law = int(material.rate_law == "linear")
    soil.fluidity_time = material.fluidity_time
    soil.cooperative_length = material.nonlocal_amplitude * material.grain_diameter
    soil.least_slowing = max((soil.cooperative_length / bed_size) ** 2, 1e-12)
    return soil


# --- The granular fluidity g = (rate of plastic shear) / mu at a single particle, as Warp functions -----
# Written with mu = tau / p (p + p_c for p in cohesive soil) and, for one step,
#
#     a = G dt / p          so that the stress with fluidity g is mu = mu_trial / (1 + a g),
#     c = I_0 sqrt(p / rho_s) / d,
#     D = mu_2 - mu_s,      m = D / (mu_2 - mu) (saturating law) or 1 (linear law).
#
# The local fluidity of the rate law mu(I) is g_loc = c m (mu - mu_s) / (D mu) above mu_s, otherwise 0.
#
# Two ways to find mu and g together at the end of the step, both without a limit on the step:
#
# - `friction_with_excess`: the fluidity is g_loc(mu) + q with a given excess q. A quadratic equation in mu, which for
#   q = 0 is the closed form of Dunatunga and Kamrin (J. Fluid Mech. 779, 2015).
# - `fluidity_step`: the fluidity has its own dynamics, t_0 dg/dt = g B with B = m (mu - mu_s) - D mu g / c. Over the
#   step g grows by exp(dt B / t_0) with B at its end. In y = ln g this is one equation whose left side rises with a
#   slope of 1 or more, so it has one root, and g stays positive.

SEED_INERTIAL_NUMBER = 1e-6
"""Soil sheared beyond mu_s has at least the fluidity SEED_INERTIAL_NUMBER sqrt(p / rho_s) / d: the dynamics leave
g = 0 unchanged, so flow must be seeded."""
LEAST_FLUIDITY = 1e-30
"""Of soil that does not flow [1/s]: a number whose log exists in float32. It means nothing else."""
LEAST_PRESSURE = 1e-12
"""Share of the shear modulus below which the pressure is not followed further in the coefficients a and c."""
LEAST_GAP = 1e-4
"""Smallest mu_2 - mu, as a share of mu_2, in the saturating law's rates."""
MAX_ITERATIONS = 60
"""Newton steps, or halvings where Newton would leave the bracket; three to eight are usual."""


@cache
def fluidity(real: type) -> SimpleNamespace:
    """Warp functions in precision `real`:

    - `coefficients(p, dt, soil)` -> a and c,
    - `local_fluidity(mu, c, soil)` -> g_loc [1/s],
    - `slowing(mu, soil)` -> m |mu - mu_s| = (A d / xi)^2, xi the cooperativity length [-],
    - `friction_with_excess(mu_trial, a, c, excess, soil)` -> mu,
    - `fluidity_step(mu_trial, a, c, g, dt, soil)` -> mu and g at the end of the step,
    - `fading(inverse_spacing, dt, soil)` -> share of what a grid cannot see of g that outlasts a step of cooperative
      flow: that of the shortest wave along an axis of the grid.
    """
    vec2 = wp.types.vector(2, real)
    Soil = soil_struct(real)
    negligible = wp.constant(1e-8 if real is wp.float32 else 1e-16)
    tolerance = wp.constant(1e-6 if real is wp.float32 else 1e-13)

    @wp.func
    def coefficients(p: real, dt: real, soil: Soil):
        pressure = wp.max(p, real(LEAST_PRESSURE) * soil.shear_modulus)
        return vec2(soil.shear_modulus * dt / pressure, soil.reference_rate * wp.sqrt(pressure))

    @wp.func
    def steepening(mu: real, soil: Soil):
        # m in the saturating law.
        gap = wp.max(soil.limit_friction - mu, real(LEAST_GAP) * soil.limit_friction)
        return (soil.limit_friction - soil.static_friction) / gap

    @wp.func
    def local_fluidity(mu: real, c: real, soil: Soil):
        if mu <= soil.static_friction:
            return real(0.0)
        g = c * (mu - soil.static_friction) / ((soil.limit_friction - soil.static_friction) * mu)
        if soil.linear_rate_law == 0:
            g = g * steepening(mu, soil)
        return g

    @wp.func
    def slowing(mu: real, soil: Soil):
        s = wp.abs(mu - soil.static_friction)
        if soil.linear_rate_law == 0:
            s = s * steepening(mu, soil)
        return wp.max(s, soil.least_slowing)

    @wp.func
    def friction_with_excess(mu_trial: real, a: real, c: real, excess: real, soil: Soil):
        mu_s = soil.static_friction
        mu_2 = soil.limit_friction
        q = real(1.0) + a * excess
        if q * mu_s >= mu_trial:
            # At mu_s or below: only the excess flows.
            return mu_trial / wp.max(q, real(1.0))
        ac = a * c
        mu = mu_trial
        if soil.linear_rate_law == 0:
            b = q * mu_2 + mu_trial + ac
            h = mu_2 * mu_trial + ac * mu_s
            mu = real(2.0) * h / (b + wp.sqrt(wp.max(b * b - real(4.0) * q * h, real(0.0))))
        else:
            k = ac / (mu_2 - mu_s)
            if q + k > real(0.0):
                mu = (mu_trial + k * mu_s) / (q + k)
        # A negative excess can take away all of the local fluidity, not more.
        return wp.min(mu, mu_trial)

    @wp.func
    def fluidity_step(mu_trial: real, a: real, c: real, g: real, dt: real, soil: Soil):
        mu_s = soil.static_friction
        mu_2 = soil.limit_friction
        steps = dt / soil.fluidity_time
        quadratic = (mu_2 - mu_s) / c
        if mu_trial <= mu_s and a * g < real(negligible):
            # At rest: g fades without a trace on the stress.
            fading = mu_trial - mu_s
            if soil.linear_rate_law == 0:
                fading = steepening(mu_trial, soil) * fading
            return vec2(mu_trial, wp.max(g * wp.exp(steps * fading), real(LEAST_FLUIDITY)))
        start = wp.max(g, real(LEAST_FLUIDITY))
        low = real(-1.0e4)
        high = low
        if mu_trial > mu_s:
            start = wp.max(start, real(SEED_INERTIAL_NUMBER) * c / soil.reference_inertial_number)
            high = wp.log((mu_trial / mu_s - real(1.0)) / a)  # there mu = mu_s
            if soil.linear_rate_law == 0 and mu_trial > mu_2:
                low = wp.log((mu_trial / mu_2 - real(1.0)) / a)  # there mu = mu_2
        y0 = wp.log(start)
        high = wp.max(high, y0)
        y = y0
        if y0 <= low:
            y = real(0.5) * (low + high)
        mu = mu_trial
        moved = real(1.0e6)
        for _ in range(wp.static(MAX_ITERATIONS)):
            g_now = wp.exp(y)
            flow = a * g_now
            mu = mu_trial / (real(1.0) + flow)
            growth = mu - mu_s
            slope = real(1.0)
            if soil.linear_rate_law == 0:
                m = steepening(mu, soil)
                growth = m * growth
                slope = m * m
            f = y - y0 - steps * (growth - quadratic * mu * g_now)
            slope = real(1.0) + steps * (slope + quadratic / a) * mu * flow / (real(1.0) + flow)
            # The slope is 1 or more, so the root is no further from y than f.
            if f > real(0.0):
                high = y
                low = wp.max(low, y - f)
            else:
                low = y
                high = wp.min(high, y - f)
            new = y - f / slope
            if new < low or new > high or wp.abs(new - y) > real(0.5) * moved:
                new = real(0.5) * (low + high)
            moved = wp.abs(new - y)
            y = new
            if moved <= real(tolerance) * (real(1.0) + wp.abs(y)):
                break
        g_new = wp.exp(wp.max(y, wp.log(real(LEAST_FLUIDITY))))
        return vec2(mu_trial / (real(1.0) + a * g_new), g_new)

    @wp.func
    def fading(inverse_spacing: real, dt: real, soil: Soil):
        length = soil.cooperative_length * inverse_spacing
        return real(1.0) / (real(1.0) + real(4.0) * length * length * dt / soil.fluidity_time)

    return SimpleNamespace(
        fading=fading,
        coefficients=coefficients,
        local_fluidity=local_fluidity,
        slowing=slowing,
        friction_with_excess=friction_with_excess,
        fluidity_step=fluidity_step,
    )


# --- Cooperative flow: the Laplacian of the fluidity, solved implicitly on the grid ----------------------
# Every dense particle brings its fluidity g and a rate s to the nodes, both as means weighted with its volume, so that
# constants come out as constants however many particles a cell holds. With W the filled volume of a node, G and s its
# means, the nodal value solves
#
#     s_i (g_i - G_i) = (A d / dx)^2 [ sum_j max(W_i, W_j) / W_i (g_j - g_i) - R_i g_i ]
#
# over the six neighbours j that hold soil: a weak form with a symmetric matrix and nothing across a free surface. R is
# WALL_CONDUCTANCE at floor and walls where g is to vanish there, otherwise 0.
#
# - `fluidity` on: G is the particles' fluidity and s = t_0 / dt, an implicit step of t_0 dg/dt = A^2 d^2 laplacian(g).
# - `fluidity` off: G is the local fluidity of the rate law and s = (A d / xi)^2, the steady form
#   g - xi^2 laplacian(g) = g_loc.
#
# Particles get g_i - G_i, not g_i. Were they given g_i, the way to the grid and back would smear the fluidity over a
# grid spacing, which is far more than the physics does where A d is small against it.
#
# With `fluidity` the particles of a cell must also be kept together: where the Laplacian drains a cell, those with
# more g would grow and the others die out, unseen by the grid. Of the difference between a particle's g and the grid's
# (sharpened, so that smooth fields lose nothing) only the share `fading` outlasts a step, as it does for
# the shortest wave the grid knows. It is 1 where A d is small against the spacing.
#
# The equations are relaxed by Jacobi sweeps, which keep g between 0 and the largest G. The steady form goes on from the
# last step's values, so that a few sweeps a step suffice.

WALL_CONDUCTANCE = 32.0
"""Of the layer between a wall's node and g = 0, in units of that between two nodes. It puts g = 0 a sixteenth of a
spacing behind the wall. A fixed g = 0 at the node would stop the flow of the soil within a spacing of the wall even
where A d is too small for the grid."""
LEAST_FILLED = 1e-20
"""Filled volume [cells] below which a node holds no soil. A particle just beyond the middle of its cell gives the next
nodes so little that in single precision 1 / W overflows, and one such node made the fluidity of all others NaN."""


def sweep_count(ratio: float, relaxation: float | None = None) -> int:
    """Jacobi sweeps per step, an even number, for `ratio` = (A d / dx)^2.

    - Dynamics, with s = `relaxation` everywhere: what brings the error of the step to a thousandth, 2 to 64.
    - Steady form (None), where s is the soil's and the sweeps go on from the last step: 2 to 16.
    """
    if relaxation is None:
        needed = 16.0 * math.sqrt(ratio)
    else:
        # A sweep reduces the error by 6 ratio / (s + 6 ratio) or more.
        needed = 0.5 * math.log(1000.0) / math.log1p(relaxation / (6.0 * ratio)) if ratio > 0.0 else 0.0
    return 2 * min(8 if relaxation is None else 32, max(1, math.ceil(needed)))


def wall_sink(shape: tuple[int, int, int], low: Sequence[int], high: Sequence[int]) -> np.ndarray:
    """R of each node of a grid where g vanishes at the nodes with an index <= low or >= high, flat."""
    sink = np.zeros(shape)
    for axis in range(3):
        nodes = np.moveaxis(sink, axis, 0)
        nodes[: max(0, low[axis] + 1)] = WALL_CONDUCTANCE
        nodes[max(0, high[axis]) :] = WALL_CONDUCTANCE
    return sink.ravel()


@cache
def nonlocal_kernels(real: type, effects: "Effects") -> SimpleNamespace:
    """Kernels in precision `real`:

    - `project`: volume, fluidity and s from the particles to `sums`,
    - `prepare`: `sums` to means in `field` (filled volume, G, s, g), clearing the sums,
    - `sweep`: one Jacobi sweep from one field to another,
    - `place`: what particles get to the nodes' `cooperation`.
    """
    vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)
    vec4s = wp.array(dtype=vec4)
    Soil, Grid, Particles = soil_struct(real), grid_struct(real), particle_struct(real)
    spline, law = splines(real), fluidity(real)
    base_and_offset, weights = spline.base_and_offset, spline.weights
    coefficients, local_fluidity, slowing = law.coefficients, law.local_fluidity, law.slowing
    fading = law.fading

    @wp.func
    def source(p: int, particles: Particles, dt: real, soil: Soil):
        # Weight 1, g and s of a dense particle; all 0 for one without stress.
        pressure = -soil.bulk_modulus * particles.log_volume[p]
        if wp.static(effects.cohesion):
            pressure += soil.cohesive_pressure
            if wp.static(effects.can_tear):
                if particles.log_volume[p] >= particles.bond[p]:
                    return vec3()
        if pressure <= real(0.0):
            return vec3()
        if wp.static(effects.fluidity):
            return vec3(real(1.0), particles.fluidity[p], soil.fluidity_time / dt)
        else:
            ac = coefficients(pressure, dt, soil)
            e = particles.elastic_strain[p]
            size = e[0] * e[0] + e[1] * e[1] + e[2] * e[2]
            size += real(2.0) * (e[3] * e[3] + e[4] * e[4] + e[5] * e[5])
            mu = wp.sqrt(real(2.0) * size) * ac[0] / dt
            return vec3(real(1.0), local_fluidity(mu, ac[1], soil), slowing(mu, soil))

    @SceneKernel
    def project(p: int, particles: Particles, grid: Grid, soil: Soil, sums: vec4s):
        found = source(p, particles, grid.dt, soil)
        if found[0] > real(0.0):
            base, f = base_and_offset(particles.home[p], grid)
            wx = weights(f[0])
            wy = weights(f[1])
            wz = weights(f[2])
            size = grid.inverse_spacing * grid.inverse_spacing * grid.inverse_spacing
            size = size * grid.particle_volume
            if p < grid.on_plane:
                size = real(0.5) * size
            amount = size * vec4(found[0], found[1], found[2], real(0.0))
            for i in range(3):
                for j in range(3):
                    row = ((base[0] + i) * grid.ny + base[1] + j) * grid.nz + base[2]
                    at = (wx[i] * wy[j]) * amount
                    wp.atomic_add(sums, row, wz[0] * at)
                    wp.atomic_add(sums, row + 1, wz[1] * at)
                    wp.atomic_add(sums, row + 2, wz[2] * at)

    @SceneKernel
    def prepare(n: int, sums: vec4s, field: vec4s):
        s = sums[n]
        filled = s[0]
        if filled > real(0.0):
            sums[n] = vec4()
        if filled > real(wp.static(LEAST_FILLED)):
            g = s[1] / filled
            start = g
            if wp.static(not effects.fluidity):
                if field[n][0] > real(0.0):
                    start = field[n][3]
            field[n] = vec4(filled, g, s[2] / filled, start)
        else:
            field[n] = vec4()

    @wp.func
    def stride(axis: int, grid: Grid):
        # Entries from a node to the next one along an axis.
        if axis == 0:
            return grid.ny * grid.nz
        if axis == 1:
            return grid.nz
        return 1

    @SceneKernel
    def sweep(
        n: int,
        ratio: real,  # (A d / dx)^2
        grid: Grid,
        sink: wp.array(dtype=real),  # R of each node
        field: vec4s,
        swept: vec4s,
    ):
        here = field[n]
        plane = stride(0, grid)
        # No soil lies in the outermost layers of the grid, so only the ends of the array need care.
        if here[0] > real(0.0) and n >= plane and n < field.shape[0] - plane:
            total = real(0.0)
            flux = real(0.0)
            for side in range(6):
                other = field[n + (2 * (side % 2) - 1) * stride(side // 2, grid)]
                if other[0] > real(0.0):
                    joint = wp.max(here[0], other[0])
                    total += joint
                    flux += joint * other[3]
            scale = ratio / here[0]
            here[3] = (here[2] * here[1] + scale * flux) / (here[2] + scale * total + ratio * sink[n])
        swept[n] = here

    @wp.func
    def sharpened(n: int, here: vec4, grid: Grid, field: vec4s):
        # G less the quarter of dx^2 laplacian(G) by which the way to the grid and back smooths it, along every axis
        # on which both neighbours hold soil. Ghost nodes have their G from the sweeps.
        sharp = here[1]
        for axis in range(3):
            before = field[n - stride(axis, grid)]
            after = field[n + stride(axis, grid)]
            if wp.min(before[0], after[0]) > real(0.25) * here[0]:
                sharp -= real(0.25) * (before[1] - real(2.0) * here[1] + after[1])
        return sharp

    @SceneKernel
    def place(n: int, grid: Grid, soil: Soil, field: vec4s, cooperation: vec4s):
        found = field[n]
        amount = real(0.0)
        if found[0] > real(0.0):
            amount = found[3] - found[1]
            if wp.static(effects.fluidity):
                plane = stride(0, grid)
                if n >= plane and n < field.shape[0] - plane:
                    lost = real(1.0) - fading(grid.inverse_spacing, grid.dt, soil)
                    amount += lost * sharpened(n, found, grid, field)
        cooperation[n] = vec4(amount, real(0.0), real(0.0), real(0.0))

    return SimpleNamespace(project=project, prepare=prepare, sweep=sweep, place=place)


def nonlocal_launches(
    real: type,
    effects: "Effects",
    sink: np.ndarray,
    particles: Any,
    grid: Any,
    soil: Any,
    field: wp.array,
    cooperation: wp.array,
    ghost_nodes: GhostNodes,
    threads: Threads,
) -> list[Launch | SideBySide]:
    """What computes the cooperative term: in order, after the grid step and before the particles read the grid.

    Args:
        sink: R of each node, see `wall_sink`.
        particles, grid, soil: the solver's structs.
        field: filled volume [cells], mean g or g_loc [1/s], s [-] and g [1/s] of the nodes, shape (nodes, 4).
        cooperation: of the nodes; its first number takes the answer.
        ghost_nodes: with plain signs: what is carried here has no direction, so a mirror does not turn it.
    """
    device, count = field.device, len(field)
    kernels = nonlocal_kernels(real, effects)
    sums, other = (wp.zeros_like(field) for _ in range(2))
    walls = wp.array(sink, dtype=real, device=device)
    ratio = (soil.cooperative_length / grid.spacing) ** 2
    relaxation = soil.fluidity_time / grid.dt if effects.fluidity else None

    def sweep(start: wp.array, end: wp.array) -> list[Launch | SideBySide]:
        given = [ratio, grid, walls, start, end]
        return [*ghost_nodes.unfold(start), *threads.share(count, (kernels.sweep, given))]

    own = threads.copies(sums)
    return [
        *threads.share(len(particles.home), (kernels.project, [particles, grid, soil, own])),
        *threads.share(count, *adding_up(own), owned="nodes"),
        *ghost_nodes.fold(sums),
        *threads.share(count, (kernels.prepare, [sums, field]), owned="nodes"),
        *[*sweep(field, other), *sweep(other, field)] * (sweep_count(ratio, relaxation) // 2),
        *threads.share(count, (kernels.place, [grid, soil, field, cooperation])),
    ]
