"""The background grid and its step: momentum to velocity, gravity, floor and walls."""

from functools import cache

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
def grid_step(real: type) -> wp.Kernel:
    """Kernel that turns momentum into velocity, applies gravity and the no-slip floor and walls, clears the
    momentum for the next step, and counts the step."""
    vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)
    Grid = grid_struct(real)

    @wp.kernel(module="unique", enable_backward=False)
    def step(
        grid: Grid,
        nodes: wp.array(dtype=vec4),
        velocity: wp.array(dtype=vec4),
        substep: wp.array(dtype=int),
    ):
        n = wp.tid()
        if n == 0:
            substep[0] = substep[0] + 1
        node = nodes[n]
        mass = node[3]
        if mass > real(0.0):
            nodes[n] = vec4()
            v = vec3(node[0], node[1], node[2]) / mass
            v = v - vec3(real(0.0), real(0.0), grid.gravity * grid.dt)
            # `/` of whole numbers is one instruction; `//` and `%` follow Python's rule for negative numbers.
            column = n / grid.nz
            i = column / grid.ny
            j = column - i * grid.ny
            k = n - column * grid.nz
            low = grid.low
            high = grid.high
            if i <= low[0] or j <= low[1] or k <= low[2] or i >= high[0] or j >= high[1] or k >= high[2]:
                v = vec3()
            velocity[n] = vec4(v[0], v[1], v[2], real(0.0))

    return step
