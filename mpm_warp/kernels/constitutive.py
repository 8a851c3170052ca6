"""The stress update of granular soil as Warp functions.

State per particle: the deviatoric part e of the elastic spatial log (Hencky) strain, six components
(xx, yy, zz, xy, xz, yz), and ln J, the log of volume over volume at the critical density. Plastic flow
keeps volume, so the elastic volume strain is ln J itself and the pressure is p = -K ln J. Both are small
numbers stored as such, which is what keeps float32 accurate: a bed at rest strains by 1e-4.

Cohesion holds grains together as a pressure p_c does: p + p_c then stands for p in yield and flow. Soil bears tension
until it yields; then it tears, and bears none until it is compressed again.

The trial strain is half the log of b = (I + A) exp(2 e) (I + A)^T with A = dt L, without a decomposition on the
hot path. There are three ranges, by the size s of e and A (Frobenius norm of both):

- s up to 0.01: the expansion of the log to second order, e + d + w e - e w + A A^T / 2 - d^2 with d and w the
  symmetric and skew parts of A. What is left out is of third order, s^2 times the step.
- b - I up to 0.05: series of exp and log to fourth order, from b - I itself, so nothing cancels.
- beyond: eigenvalues.
"""

from functools import cache
from types import SimpleNamespace
from typing import TYPE_CHECKING

import warp as wp

from .fluidity import fluidity, soil_struct
from .grid import grid_struct, splines

if TYPE_CHECKING:
    from ..effects import Effects

SECOND_ORDER_LIMIT = 0.01
"""Size of strain and step up to which the second-order expansion is used: it misses at most 1e-4 of the step."""
SERIES_LIMIT = 0.05
"""Frobenius norm of b - I up to which the four-term log series is used: its relative error is then below 2e-6."""


@cache
def constitutive(real: type, effects: "Effects") -> SimpleNamespace:
    """Warp functions in precision `real`, with only the physics in `effects`.

    Returns a namespace of

    - `strain_trial(e, A)` -> deviatoric trial strain (6),
    - `volume_step(A)` -> ln det(I + A),
    - `yield_stress(tau_trial, p, dt, soil)` -> equivalent shear stress after the plastic return,
    - `update(e, ln_j, A, dt, soil, g, bond)` -> new e (6), ln J and g as an 8-vector, where it can tear the bond as a
      ninth number. `g` means something with two effects: with `nonlocality` alone the excess of the fluidity over its
      local value, which stays; with `fluidity` the particle's fluidity [1/s]. `bond` is the ln J up to which soil
      bears stress: p_c / K, 0 where it is torn and without cohesion,
    - `kirchhoff(e, ln_j, bond, soil)` -> Kirchhoff stress (3 x 3) [Pa].
    """
    vec3 = wp.types.vector(3, real)
    vec6 = wp.types.vector(6, real)
    mat33 = wp.types.matrix((3, 3), real)
    Soil = soil_struct(real)
    can_tear = effects.can_tear
    State = wp.types.vector(9 if can_tear else 8, real)
    fluid = fluidity(real)
    coefficients, fluidity_step = fluid.coefficients, fluid.fluidity_step
    friction_with_excess = fluid.friction_with_excess
    second_order_limit = wp.constant(SECOND_ORDER_LIMIT**2)
    series_limit = wp.constant(SERIES_LIMIT**2)

    @wp.func
    def full(s: vec6):
        return mat33(s[0], s[3], s[4], s[3], s[1], s[5], s[4], s[5], s[2])

    @wp.func
    def commuting_product(a: vec6, b: vec6):
        # Product of two symmetric matrices that commute, hence symmetric.
        return vec6(
            a[0] * b[0] + a[3] * b[3] + a[4] * b[4],
            a[3] * b[3] + a[1] * b[1] + a[5] * b[5],
            a[4] * b[4] + a[5] * b[5] + a[2] * b[2],
            a[0] * b[3] + a[3] * b[1] + a[4] * b[5],
            a[0] * b[4] + a[3] * b[5] + a[4] * b[2],
            a[3] * b[4] + a[1] * b[5] + a[5] * b[2],
        )

    @wp.func
    def norm_squared(s: vec6):
        return s[0] * s[0] + s[1] * s[1] + s[2] * s[2] + real(2.0) * (s[3] * s[3] + s[4] * s[4] + s[5] * s[5])

    @wp.func
    def deviator(s: vec6):
        third = (s[0] + s[1] + s[2]) / real(3.0)
        return vec6(s[0] - third, s[1] - third, s[2] - third, s[3], s[4], s[5])

    @wp.func
    def half_log_exact(x: vec6):
        # Half the log of I + x by eigenvalues. Negative or zero eigenvalues (an inverted particle) are floored,
        # which gives a huge strain that the plastic return or the non-finite guard deals with.
        q, d = wp.eig3(full(x))
        h0 = real(0.5) * wp.log(wp.max(real(1.0) + d[0], real(1e-6)))
        h1 = real(0.5) * wp.log(wp.max(real(1.0) + d[1], real(1e-6)))
        h2 = real(0.5) * wp.log(wp.max(real(1.0) + d[2], real(1e-6)))
        h = q * wp.diag(vec3(h0, h1, h2)) * wp.transpose(q)
        return vec6(h[0, 0], h[1, 1], h[2, 2], h[0, 1], h[0, 2], h[1, 2])

    @wp.func
    def half_log(x: vec6):
        if norm_squared(x) > real(series_limit):
            return half_log_exact(x)
        x2 = commuting_product(x, x)
        x3 = commuting_product(x2, x)
        x4 = commuting_product(x2, x2)
        return real(0.5) * x - real(0.25) * x2 + x3 / real(6.0) - real(0.125) * x4

    @wp.func
    def exp_twice_minus_one_exact(e: vec6):
        q, d = wp.eig3(full(e))
        m0 = wp.exp(real(2.0) * wp.min(d[0], real(10.0))) - real(1.0)
        m1 = wp.exp(real(2.0) * wp.min(d[1], real(10.0))) - real(1.0)
        m2 = wp.exp(real(2.0) * wp.min(d[2], real(10.0))) - real(1.0)
        m = q * wp.diag(vec3(m0, m1, m2)) * wp.transpose(q)
        return vec6(m[0, 0], m[1, 1], m[2, 2], m[0, 1], m[0, 2], m[1, 2])

    @wp.func
    def exp_twice_minus_one(e: vec6):
        if real(4.0) * norm_squared(e) > real(series_limit):
            return exp_twice_minus_one_exact(e)
        e2 = commuting_product(e, e)
        e3 = commuting_product(e2, e)
        return real(2.0) * e + real(2.0) * e2 + real(4.0) / real(3.0) * e3

    @wp.func
    def symmetric(a: mat33):
        half = real(0.5)
        return vec6(
            a[0, 0], a[1, 1], a[2, 2],
            half * (a[0, 1] + a[1, 0]), half * (a[0, 2] + a[2, 0]), half * (a[1, 2] + a[2, 1]),
        )  # fmt: skip

    @wp.func
    def second_order(e: vec6, a: mat33):
        d = symmetric(a)
        w3 = a[0, 1] - d[3]
        w4 = a[0, 2] - d[4]
        w5 = a[1, 2] - d[5]
        # Sum of d and twice the spin term's sources: (w e + (w e)^T) for e, half of it for d.
        f = e + real(0.5) * d
        # A A^T / 2 - d^2 = (w d - d w - d^2 - w^2) / 2
        return vec6(
            e[0] + d[0] + real(2.0) * (w3 * f[3] + w4 * f[4])
            - real(0.5) * (d[0] * d[0] + d[3] * d[3] + d[4] * d[4] - w3 * w3 - w4 * w4),
            e[1] + d[1] + real(2.0) * (w5 * f[5] - w3 * f[3])
            - real(0.5) * (d[1] * d[1] + d[3] * d[3] + d[5] * d[5] - w3 * w3 - w5 * w5),
            e[2] + d[2] - real(2.0) * (w4 * f[4] + w5 * f[5])
            - real(0.5) * (d[2] * d[2] + d[4] * d[4] + d[5] * d[5] - w4 * w4 - w5 * w5),
            e[3] + d[3] + w3 * (f[1] - f[0]) + w4 * f[5] + w5 * f[4]
            - real(0.5) * (d[0] * d[3] + d[3] * d[1] + d[4] * d[5] - w4 * w5),
            e[4] + d[4] + w4 * (f[2] - f[0]) + w3 * f[5] - w5 * f[3]
            - real(0.5) * (d[0] * d[4] + d[3] * d[5] + d[4] * d[2] + w3 * w5),
            e[5] + d[5] + w5 * (f[2] - f[1]) - w3 * f[4] - w4 * f[3]
            - real(0.5) * (d[3] * d[4] + d[1] * d[5] + d[5] * d[2] - w3 * w4),
        )  # fmt: skip

    @wp.func
    def strain_trial(e: vec6, a: mat33):
        if norm_squared(e) + wp.ddot(a, a) < real(second_order_limit):
            return deviator(second_order(e, a))
        # b - I = M + Y + Y^T + Y A^T with M = exp(2 e) - I and Y = A (I + M): no cancellation.
        m6 = exp_twice_minus_one(e)
        m = full(m6)
        y = a + a * m
        z = y * wp.transpose(a)
        x = vec6(
            m6[0] + real(2.0) * y[0, 0] + z[0, 0],
            m6[1] + real(2.0) * y[1, 1] + z[1, 1],
            m6[2] + real(2.0) * y[2, 2] + z[2, 2],
            m6[3] + y[0, 1] + y[1, 0] + z[0, 1],
            m6[4] + y[0, 2] + y[2, 0] + z[0, 2],
            m6[5] + y[1, 2] + y[2, 1] + z[1, 2],
        )
        return deviator(half_log(x))

    @wp.func
    def volume_step(a: mat33):
        # ln det(I + A) from det - 1, which a float32 difference would lose.
        t = a[0, 0] + a[1, 1] + a[2, 2]
        second = (
            a[0, 0] * a[1, 1] + a[1, 1] * a[2, 2] + a[0, 0] * a[2, 2]
            - a[0, 1] * a[1, 0] - a[1, 2] * a[2, 1] - a[0, 2] * a[2, 0]
        )  # fmt: skip
        g = t + second + wp.determinant(a)
        if wp.abs(g) < real(0.01):
            return g * (real(1.0) - g * (real(0.5) - g * (real(1.0) / real(3.0) - g * real(0.25))))
        return wp.log(wp.max(real(1.0) + g, real(1e-6)))

    @wp.func
    def yield_stress(tau: real, p: real, dt: real, soil: Soil):
        s0 = soil.static_friction * p
        if tau <= s0:
            return tau
        if wp.static(effects.rate_dependence):
            # Closed-form implicit mu(I): Dunatunga and Kamrin, J. Fluid Mech. 779 (2015).
            s2 = soil.limit_friction * p
            alpha = soil.shear_modulus * dt * soil.reference_rate * wp.sqrt(p)
            if soil.linear_rate_law != 0:
                k = alpha / ((soil.limit_friction - soil.static_friction) * p)
                return (tau + k * s0) / (real(1.0) + k)
            b = s2 + tau + alpha
            h = s2 * tau + s0 * alpha
            return real(2.0) * h / (b + wp.sqrt(wp.max(b * b - real(4.0) * h, real(0.0))))
        return s0

    @wp.func
    def state_of(e: vec6, ln_j: real, g: real, bond: real):
        if wp.static(can_tear):
            return State(e[0], e[1], e[2], e[3], e[4], e[5], ln_j, g, bond)
        else:
            return State(e[0], e[1], e[2], e[3], e[4], e[5], ln_j, g)

    @wp.func
    def separated_fluidity(a: mat33, dt: real, soil: Soil):
        # Soil that comes back into contact flows as it did apart.
        return wp.sqrt(real(2.0) * norm_squared(deviator(symmetric(a)))) / (dt * soil.static_friction)

    @wp.func
    def holds(e: vec6, ln_j: real, soil: Soil):
        # Whether soil in tension stays within the cone.
        strength = soil.static_friction * (soil.cohesive_pressure - soil.bulk_modulus * ln_j)
        return soil.shear_modulus * wp.sqrt(real(2.0) * norm_squared(e)) < strength

    @wp.func
    def update(e: vec6, ln_j: real, a: mat33, dt: real, soil: Soil, g: real, bond: real):
        new_ln_j = ln_j + volume_step(a)
        new_g = g
        if wp.static(effects.separation):
            loose = new_ln_j >= bond
            if wp.static(can_tear):
                if new_ln_j >= real(0.0) and new_ln_j < bond:
                    loose = not holds(strain_trial(e, a), new_ln_j, soil)
            if loose:
                if wp.static(effects.fluidity):
                    new_g = separated_fluidity(a, dt, soil)
                return state_of(vec6(), new_ln_j, new_g, real(0.0))
        t = strain_trial(e, a)
        if wp.static(effects.yielding):
            p = -soil.bulk_modulus * new_ln_j
            if wp.static(effects.cohesion):
                p += soil.cohesive_pressure
            if p <= real(0.0):
                t = vec6()
            else:
                tau = soil.shear_modulus * wp.sqrt(real(2.0) * norm_squared(t))
                if wp.static(effects.fluidity):
                    ac = coefficients(p, dt, soil)
                    mu = tau * ac[0] / (soil.shear_modulus * dt)
                    found = fluidity_step(mu, ac[0], ac[1], g, dt, soil)
                    if mu > real(0.0):
                        t = t * (found[0] / mu)
                    new_g = found[1]
                elif wp.static(effects.nonlocality):
                    if tau > real(0.0):
                        ac = coefficients(p, dt, soil)
                        mu = tau * ac[0] / (soil.shear_modulus * dt)
                        t = t * (friction_with_excess(mu, ac[0], ac[1], g, soil) / mu)
                else:
                    if tau > soil.static_friction * p:
                        t = t * (yield_stress(tau, p, dt, soil) / tau)
        return state_of(t, new_ln_j, new_g, soil.cohesive_pressure / soil.bulk_modulus)

    @wp.func
    def kirchhoff(e: vec6, ln_j: real, bond: real, soil: Soil):
        if wp.static(effects.separation):
            if ln_j >= bond:
                return mat33()
        return real(2.0) * soil.shear_modulus * full(e) + wp.diag(vec3(soil.bulk_modulus * ln_j))

    return SimpleNamespace(
        strain_trial=strain_trial,
        volume_step=volume_step,
        yield_stress=yield_stress,
        update=update,
        kirchhoff=kirchhoff,
        vec6=vec6,
        mat33=mat33,
    )


# --- Soil below its critical density --------------------------------------------------------------------


LOOSE, DENSE = 0.9, 0.98
"""Shares of an undisturbed bed's density between which a node comes to count as dense: at rest it does, whatever
the round-off, and nothing jumps where soil comes apart."""
APART = 0.005
"""ln J above its bond from which on soil has no say at all in the mean volume change."""
FAR = 0.1
"""ln J from which on the grid alone says how loose soil near dense soil is; from `APART` on it has a say."""


@cache
def loose_soil(real: type) -> SimpleNamespace:
    """Warp functions in precision `real` for particles whose ln J is above their bond, which bear no stress:

    - `apart(above)`: 0 for dense soil to 1 for soil that is loose for good, by ln J above its bond,
    - `volume(ln_j, base, f, nodes, grid)`: its ln J.

    `base` is the lowest of its 27 nodes, `f` its offset from there [cells], and the fourth number of `nodes` is the
    density over that of an undisturbed bed. With a dense node among them the particle is at a surface, or next to a
    body, and the mean density says how much soil is missing around it, too: it is taken to be in a half space of one
    density, whose surface is as near as the slope of the density tells. That is right to 10 % in the topmost layer. So
    it tells how loose a particle is that has been far from the others, and sets a bound to the ln J of one that has
    not, which would grow from bounce to bounce.
    """
    vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)
    Grid, weights = grid_struct(real), splines(real).weights

    @wp.func
    def ramp(x: real, low: real, high: real):
        return wp.clamp((x - low) / (high - low), real(0.0), real(1.0))

    @wp.func
    def apart(above: real):
        return ramp(above, real(0.0), real(APART))

    @wp.func
    def slopes(f: real):
        return vec3(f - real(1.5), real(2.0) - real(2.0) * f, f - real(0.5))

    @wp.func
    def mirrored(at: int, low: int, high: int):
        # Soil goes on beyond a wall as its mirror image. `high` may be so large that twice of it is no whole number.
        return high - wp.abs(high - (low + wp.abs(at - low)))

    @wp.func
    def volume(ln_j: real, base: wp.vec3i, f: vec3, nodes: wp.array(dtype=vec4), grid: Grid):
        wx = weights(f[0])
        wy = weights(f[1])
        wz = weights(f[2])
        dx = slopes(f[0])
        dy = slopes(f[1])
        dz = slopes(f[2])
        mean = real(0.0)
        slope = vec3()
        densest = real(0.0)
        for i in range(3):
            x = mirrored(base[0] + i, grid.low[0], grid.high[0])
            for j in range(3):
                y = mirrored(base[1] + j, grid.low[1], grid.high[1])
                for k in range(3):
                    z = mirrored(base[2] + k, grid.low[2], grid.high[2])
                    density = nodes[(x * grid.ny + y) * grid.nz + z][3]
                    densest = wp.max(densest, density)
                    mean += wx[i] * wy[j] * wz[k] * density
                    slope += density * vec3(
                        dx[i] * wy[j] * wz[k], wx[i] * dy[j] * wz[k], wx[i] * wy[j] * dz[k]
                    )
        mean = wp.max(mean, real(1.0e-6))
        # Two splines smear a step into the normal distribution F of variance h^2 / 2, nearly: mean and slope are those
        # of density F and density F'. -ln F is r / 2 + 0.466 r^2 to 0.01, r = sqrt(1/2) F' / F.
        r = wp.sqrt(real(0.5)) * wp.length(slope) / mean
        found = wp.max(-wp.log(mean) - r * (real(0.5) + real(0.466) * r), real(APART))
        far = ramp(ln_j, real(APART), real(FAR))
        near_dense = far * found + (real(1.0) - far) * wp.min(ln_j, found)
        own = ramp(densest, real(LOOSE), real(DENSE))
        return own * near_dense - (real(1.0) - own) * wp.log(mean)

    return SimpleNamespace(apart=apart, volume=volume)
