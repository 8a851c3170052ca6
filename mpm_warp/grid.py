"""The background grid: momentum to velocity, gravity, floor and walls."""

from functools import cache
from types import SimpleNamespace

import warp as wp

__all__ = ["grid_step", "grid_struct"]


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
        gravity: real  # [m/s^2]
        # Nodes with index <= low or >= high belong to the floor and the walls.
        low: wp.vec3i
        high: wp.vec3i
        particle_mass: real  # [kg]
        particle_volume: real  # at the critical density [m^3]
        speed_limit: real  # one cell per step [m/s]

    return Grid


@cache
def grid_step(real: type) -> SimpleNamespace:
    """Kernels on the nodes in precision `real`.

    - `begin`: momentum and mass to velocity and 1 / mass after a remap; floor and
      walls hold their nodes by a 1 / mass of 0.
    - `step`: velocity from the step's impulse and gravity; counts the step.

    Both clear what they have used for the next sum.
    """
    vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)
    Grid = grid_struct(real)

    @wp.kernel(module="unique", enable_backward=False)
    def begin(
        grid: Grid,
        momentum: wp.array(dtype=vec4),
        velocity: wp.array(dtype=vec4),
        before: wp.array(dtype=vec4),
        impulse: wp.array(dtype=vec4),
    ):
        n = wp.tid()
        node = momentum[n]
        mass = node[3]
        v = vec3()
        inverse_mass = real(0.0)
        # A node that a particle on a cell's face barely touches has no mass to speak of, and 1 / mass no value.
        if mass > real(1.0e-20) * grid.particle_mass:
            v = vec3(node[0], node[1], node[2]) / mass
            inverse_mass = real(1.0) / mass
        momentum[n] = vec4()
        before[n] = vec4(v[0], v[1], v[2], real(0.0))
        # `/` of whole numbers is one instruction; `//` and `%` follow Python's rule for negative numbers.
        column = n / grid.nz
        i = column / grid.ny
        j = column - i * grid.ny
        k = n - column * grid.nz
        low = grid.low
        high = grid.high
        if i <= low[0] or j <= low[1] or k <= low[2] or i >= high[0] or j >= high[1] or k >= high[2]:
            v = vec3()
            inverse_mass = real(0.0)
        impulse[n] = vec4()
        velocity[n] = vec4(v[0], v[1], v[2], inverse_mass)

    @wp.kernel(module="unique", enable_backward=False)
    def step(
        grid: Grid,
        velocity: wp.array(dtype=vec4),
        impulse: wp.array(dtype=vec4),
        substep: wp.array(dtype=int),
    ):
        n = wp.tid()
        if n == 0:
            substep[0] = substep[0] + 1
        v = velocity[n]
        inverse_mass = v[3]
        if inverse_mass > real(0.0):
            change = inverse_mass * impulse[n]
            impulse[n] = vec4()
            fall = grid.gravity * grid.dt
            velocity[n] = vec4(v[0] + change[0], v[1] + change[1], v[2] + change[2] - fall, inverse_mass)

    return SimpleNamespace(begin=begin, step=step)
