"""Particle-grid transfers with quadratic B-splines (APIC / MLS), and the material update between them.

Both kernels visit the 27 nodes around a particle. Node (i, j, k) is entry (i ny + j) nz + k of a flat array of
4-vectors: momentum and mass on the way to the grid, velocity on the way back, with what the effect `nonlocality`
adds to the fluidity as the fourth number.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from .constitutive import constitutive
from .contact import body_struct, contact
from .effects import Effects
from .fluidity import fluidity
from .grid import grid_struct
from .soil import soil_struct
from .splines import splines

__all__ = ["transfer"]


@cache
def transfer(real: type, effects: Effects, with_body: bool, atomic: bool) -> SimpleNamespace:
    """Kernels `to_grid` and `to_particles` in precision `real` with only the physics in `effects`.

    `atomic` is needed where many threads write to the grid at once (a GPU).
    """
    vec3 = wp.types.vector(3, real)
    vec4 = wp.types.vector(4, real)
    law = constitutive(real, effects)
    vec6, mat33 = law.vec6, law.mat33
    Soil, Grid, Body = soil_struct(real, effects.fluidity), grid_struct(real), body_struct(real)
    push = contact(real, atomic).push
    update, kirchhoff = law.update, law.kirchhoff
    fading = fluidity(real, effects).fading
    spline = splines(real)
    base_and_offset, weights, moments = spline.base_and_offset, spline.weights, spline.moments

    @wp.func
    def deposit(nodes: wp.array(dtype=vec4), at: int, amount: vec4):
        # On the CPU one thread runs the kernel, and a plain sum is faster than an atomic one.
        if wp.static(atomic):
            wp.atomic_add(nodes, at, amount)
        else:
            nodes[at] = nodes[at] + amount

    @wp.kernel(module="unique", enable_backward=False)
    def to_grid(
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        c: wp.array(dtype=mat33),
        e: wp.array(dtype=vec6),
        ln_j: wp.array(dtype=real),
        grid: Grid,
        soil: Soil,
        body: Body,
        nodes: wp.array(dtype=vec4),
        substep: wp.array(dtype=int),
    ):
        p = wp.tid()
        base, f = base_and_offset(x[p], grid)
        wx = weights(f[0])
        wy = weights(f[1])
        wz = weights(f[2])
        h = grid.spacing
        # Affine momentum m C - dt V D^-1 tau, D = dx^2 / 4, times dx: momentum change per cell.
        force = kirchhoff(e[p], ln_j[p], soil) * (
            real(-4.0) * grid.dt * grid.particle_volume * grid.inverse_spacing
        )
        q = c[p] * (grid.particle_mass * h) + force
        start = grid.particle_mass * v[p] - q * f
        if wp.static(with_body):
            start += push(x[p], v[p], grid.particle_mass, grid.dt, substep[0], body)
        qx = vec4(q[0, 0], q[1, 0], q[2, 0], real(0.0))
        qy = vec4(q[0, 1], q[1, 1], q[2, 1], real(0.0))
        qz = vec4(q[0, 2], q[1, 2], q[2, 2], real(0.0))
        corner = vec4(start[0], start[1], start[2], grid.particle_mass)
        plane = corner
        for i in range(3):
            at = plane
            for j in range(3):
                row = ((base[0] + i) * grid.ny + base[1] + j) * grid.nz + base[2]
                w = wx[i] * wy[j]
                deposit(nodes, row, (w * wz[0]) * at)
                deposit(nodes, row + 1, (w * wz[1]) * (at + qz))
                deposit(nodes, row + 2, (w * wz[2]) * (at + real(2.0) * qz))
                at += qy
            plane += qx

    @wp.kernel(module="unique", enable_backward=False)
    def to_particles(
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        c: wp.array(dtype=mat33),
        e: wp.array(dtype=vec6),
        ln_j: wp.array(dtype=real),
        grid: Grid,
        soil: Soil,
        velocity: wp.array(dtype=vec4),
        substep: wp.array(dtype=int),
        stray: wp.array(dtype=int),
    ):
        p = wp.tid()
        position = x[p]
        base, f = base_and_offset(position, grid)
        wx = weights(f[0])
        wy = weights(f[1])
        wz = weights(f[2])
        # Weights times the node's distance from the particle, for the velocity gradient.
        ax = moments(wx, f[0])
        ay = moments(wy, f[1])
        az = moments(wz, f[2])
        total = vec4()
        gx = vec4()
        gy = vec4()
        gz = vec4()
        for i in range(3):
            plane = vec4()
            plane_y = vec4()
            plane_z = vec4()
            for j in range(3):
                row = ((base[0] + i) * grid.ny + base[1] + j) * grid.nz + base[2]
                v0 = velocity[row]
                v1 = velocity[row + 1]
                v2 = velocity[row + 2]
                line = wz[0] * v0 + wz[1] * v1 + wz[2] * v2
                line_z = az[0] * v0 + az[1] * v1 + az[2] * v2
                plane += wy[j] * line
                plane_y += ay[j] * line
                plane_z += wy[j] * line_z
            total += wx[i] * plane
            gx += ax[i] * plane
            gy += wx[i] * plane_y
            gz += wx[i] * plane_z
        scale = real(4.0) * grid.inverse_spacing
        gradient = mat33(
            gx[0] * scale, gy[0] * scale, gz[0] * scale,
            gx[1] * scale, gy[1] * scale, gz[1] * scale,
            gx[2] * scale, gy[2] * scale, gz[2] * scale,
        )  # fmt: skip
        speed = vec3(total[0], total[1], total[2])
        moved = position + grid.dt * speed
        g = (moved - grid.origin) * grid.inverse_spacing
        inside = (
            g[0] >= real(0.5) and g[1] >= real(0.5) and g[2] >= real(0.5)
            and g[0] < real(grid.nx) - real(1.5)
            and g[1] < real(grid.ny) - real(1.5)
            and g[2] < real(grid.nz) - real(1.5)
        )  # fmt: skip
        slow = wp.length_sq(speed) < grid.speed_limit * grid.speed_limit  # false for a NaN, too
        if inside and slow:
            # What `update` means by its last number; total[3] is what cooperative flow adds (nonlocal_fluidity.py).
            g_now = real(0.0)
            if wp.static(effects.nonlocality):
                g_now = total[3]
            if wp.static(effects.fluidity):
                kept = real(1.0)
                if wp.static(effects.nonlocality):
                    kept = fading(grid.inverse_spacing, grid.dt, soil)
                g_now = wp.max(kept * soil.g[p] + g_now, real(0.0))
            state = update(e[p], ln_j[p], grid.dt * gradient, grid.dt, soil, g_now)
            if wp.static(effects.fluidity):
                soil.g[p] = state[7]
            x[p] = moved
            v[p] = speed
            c[p] = gradient
            e[p] = vec6(state[0], state[1], state[2], state[3], state[4], state[5])
            ln_j[p] = state[6]
        else:
            # The particle keeps its last good state; the solver stops at the end of the frame.
            if wp.atomic_add(stray, 0, 1) == 0:
                stray[1] = p
                stray[2] = substep[0]
                stray[3] = wp.where(slow, 1, 0)

    return SimpleNamespace(to_grid=to_grid, to_particles=to_particles)
