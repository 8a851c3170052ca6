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
def grid_step(real: type):
    vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)
    Grid = grid_struct(real)

    @wp.kernel(module="unique", enable_backward=False)
    def start(
        grid: Grid,
        nodes: wp.array(dtype=vec4),
        velocity: wp.array(dtype=vec4),
        start_velocity: wp.array(dtype=vec4),
        forces: wp.array(dtype=vec4),
    ):
        n = wp.tid()
        node = nodes[n]
        mass = node[3]
        result = vec4()
        if mass > real(0.0):
            nodes[n] = vec4()
            k = n % grid.nz
            j = (n // grid.nz) % grid.ny
            i = n // (grid.nz * grid.ny)
            low = grid.low
            high = grid.high
            if i <= low[0] or j <= low[1] or k <= low[2] or i >= high[0] or j >= high[1] or k >= high[2]:
                forces[n] = vec4()
            else:
                result = vec4(node[0] / mass, node[1] / mass, node[2] / mass, real(1.0) / mass)
        velocity[n] = result
        start_velocity[n] = result

    @wp.kernel(module="unique", enable_backward=False)
    def step(
        grid: Grid,
        velocity: wp.array(dtype=vec4),
        forces: wp.array(dtype=vec4),
        substep: wp.array(dtype=int),
    ):
        n = wp.tid()
        if n == 0:
            substep[0] = substep[0] + 1
        v = velocity[n]
        inverse_mass = v[3]
        if inverse_mass > real(0.0):
            v += inverse_mass * forces[n]
            v[2] = v[2] - grid.gravity * grid.dt
            velocity[n] = vec4(v[0], v[1], v[2], inverse_mass)
            forces[n] = vec4()

    return start, step
