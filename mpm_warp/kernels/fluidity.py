"""The soil's constants and its granular fluidity g = (rate of plastic shear) / mu, as Warp functions."""

import math
from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..material import Material


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
