"""The soil's constants as a Warp struct."""

import math
from functools import cache
from typing import Any

import warp as wp

from .material import Material

__all__ = ["soil_parameters", "soil_struct"]


@cache
def soil_struct(real: type, with_fluidity: bool) -> type:
    """Struct of the soil constants in precision `real` (pressures in Pa, lengths in m), and with the effect
    `fluidity` the particles' fluidity."""

    @wp.struct
    class Soil:
        shear_modulus: real
        bulk_modulus: real
        static_friction: real
        limit_friction: real
        reference_rate: real  # I_0 sqrt(1 / rho_s) / d: G dt reference_rate sqrt(p) is the paper's alpha
        reference_inertial_number: real
        linear_rate_law: int  # 1: linear, 0: saturating
        fluidity_time: real  # t_0 [s]
        cooperative_length: real  # A d [m]
        least_slowing: real  # (A d / xi)^2 at the largest xi, the size of the bed
        if with_fluidity:
            g: wp.array(dtype=real)  # fluidity of each particle [1/s]

    return Soil


def soil_parameters(real: type, material: Material, bed_size: float, with_fluidity: bool) -> Any:
    """The struct filled with the constants of `material`, without its arrays.

    `bed_size` [m] bounds the cooperativity length, which has no bound at mu = mu_s.
    """
    soil = soil_struct(real, with_fluidity)()
    soil.shear_modulus, soil.bulk_modulus = material.shear_modulus, material.bulk_modulus
    soil.static_friction, soil.limit_friction = material.static_friction, material.limit_friction
    soil.reference_rate = material.reference_inertial_number / (
        material.grain_diameter * math.sqrt(material.grain_density)
    )
    soil.reference_inertial_number = material.reference_inertial_number
    soil.linear_rate_law = int(material.rate_law == "linear")
    soil.fluidity_time = material.fluidity_time
    soil.cooperative_length = material.nonlocal_amplitude * material.grain_diameter
    soil.least_slowing = max((soil.cooperative_length / bed_size) ** 2, 1e-12)
    return soil
