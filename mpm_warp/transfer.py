"""Particle-grid transfers with quadratic B-splines, and the material update between them.

Momentum is carried to the grid only now and then (`to_grid`, a remap); in between the velocities live on the grid and
particles only feel them (`advance`), with the spline weights of the place they had at the remap, their `home`. A remap
smooths velocities over a grid spacing; done in every step that smoothing acts as a viscosity that grows with 1 / dt.

Kernels visit the 27 nodes around a particle. Node (i, j, k) is entry (i ny + j) nz + k of a flat array of 4-vectors.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from .constitutive import constitutive, soil_struct
from .contact import body_struct, contact
from .effects import Effects
from .grid import grid_struct

__all__ = ["ADVANCE", "FINISH", "START", "transfer"]

# What `advance` does: give the first forces after a remap; make a step and give the next forces; make the last step
# before a remap and take the velocity along.
START, ADVANCE, FINISH = range(3)


@cache
def transfer(real: type, effects: Effects, with_body: bool, atomic: bool) -> SimpleNamespace:
    """Kernels `to_grid` and `advance` in precision `real` with only the physics in `effects`.

    `atomic` is needed where many threads write to the grid at once (a GPU).
    """
    vec3 = wp.types.vector(3, real)
    vec4 = wp.types.vector(4, real)
    law = constitutive(real, effects)
    vec6, mat33 = law.vec6, law.mat33
    Soil, Grid, Body = soil_struct(real), grid_struct(real), body_struct(real)
    push = contact(real, atomic).push
    update, kirchhoff = law.update, law.kirchhoff
    first, last = wp.constant(START), wp.constant(FINISH)

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

    @wp.func
    def deposit(nodes: wp.array(dtype=vec4), at: int, amount: vec4):
        # On the CPU one thread runs the kernel, and a plain sum is faster than an atomic one.
        if wp.static(atomic):
            wp.atomic_add(nodes, at, amount)
        else:
            nodes[at] = nodes[at] + amount

    @wp.func
    def spread(
        corner: vec4,
        qx: vec4,
        qy: vec4,
        qz: vec4,
        base: wp.vec3i,
        wx: vec3,
        wy: vec3,
        wz: vec3,
        grid: Grid,
        nodes: wp.array(dtype=vec4),
    ):
        # Adds weight times an affine field: its value at the lowest node and its change per cell along x, y, z.
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
    def to_grid(
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        c: wp.array(dtype=mat33),
        home: wp.array(dtype=vec3),
        grid: Grid,
        momentum: wp.array(dtype=vec4),
        substep: wp.array(dtype=int),
        top_speed: wp.array(dtype=real),
        stray: wp.array(dtype=int),
    ):
        p = wp.tid()
        speed = wp.length(v[p])
        if not (speed < grid.speed_limit):  # true for a NaN, too
            if wp.atomic_add(stray, 0, 1) == 0:
                stray[1] = p
                stray[2] = substep[0]
                stray[3] = 0
            return
        wp.atomic_max(top_speed, 0, speed)
        home[p] = x[p]
        base, f = base_and_offset(x[p], grid)
        q = c[p] * (grid.particle_mass * grid.spacing)
        start = grid.particle_mass * v[p] - q * f
        spread(
            vec4(start[0], start[1], start[2], grid.particle_mass),
            vec4(q[0, 0], q[1, 0], q[2, 0], real(0.0)),
            vec4(q[0, 1], q[1, 1], q[2, 1], real(0.0)),
            vec4(q[0, 2], q[1, 2], q[2, 2], real(0.0)),
            base,
            weights(f[0]),
            weights(f[1]),
            weights(f[2]),
            grid,
            momentum,
        )

    @wp.kernel(module="unique", enable_backward=False)
    def advance(
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        c: wp.array(dtype=mat33),
        home: wp.array(dtype=vec3),
        e: wp.array(dtype=vec6),
        ln_j: wp.array(dtype=real),
        grid: Grid,
        soil: Soil,
        body: Body,
        velocity: wp.array(dtype=vec4),
        before: wp.array(dtype=vec4),
        impulse: wp.array(dtype=vec4),
        substep: wp.array(dtype=int),
        stray: wp.array(dtype=int),
        stage: int,
        keep: real,
    ):
        p = wp.tid()
        base, f = base_and_offset(home[p], grid)
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
        position = x[p]
        strain = e[p]
        volume = ln_j[p]
        if stage != first:
            position += grid.dt * speed
            g = (position - grid.origin) * grid.inverse_spacing
            inside = (
                g[0] >= real(0.5) and g[1] >= real(0.5) and g[2] >= real(0.5)
                and g[0] < real(grid.nx) - real(1.5)
                and g[1] < real(grid.ny) - real(1.5)
                and g[2] < real(grid.nz) - real(1.5)
            )  # fmt: skip
            near = wp.length_sq(position - home[p]) < grid.spacing * grid.spacing  # false for a NaN, too
            if not (inside and near):
                # The particle keeps its last good state; the solver stops at the end of the frame.
                if wp.atomic_add(stray, 0, 1) == 0:
                    stray[1] = p
                    stray[2] = substep[0]
                    stray[3] = wp.where(near, 1, 0)
                return
            state = update(strain, volume, grid.dt * gradient, grid.dt, soil)
            strain = vec6(state[0], state[1], state[2], state[3], state[4], state[5])
            volume = state[6]
            x[p] = position
            e[p] = strain
            ln_j[p] = volume
        if stage == last:
            # The particle's own velocity is changed by what changed on the grid; the part of it that the grid does not
            # resolve is kept in part.
            smooth = vec4()
            for i in range(3):
                plane = vec4()
                for j in range(3):
                    row = ((base[0] + i) * grid.ny + base[1] + j) * grid.nz + base[2]
                    plane += wy[j] * (wz[0] * before[row] + wz[1] * before[row + 1] + wz[2] * before[row + 2])
                smooth += wx[i] * plane
            v[p] = speed + keep * (v[p] - vec3(smooth[0], smooth[1], smooth[2]))
            c[p] = gradient
            return
        load = vec3()
        if wp.static(with_body):
            load = push(position, speed, grid.particle_mass, grid.dt, substep[0], body)
        # Impulse of one step at the nodes: -dt V D^-1 tau (x_i - x_p), D = dx^2 / 4, and the body's push.
        q = kirchhoff(strain, volume, soil) * (
            real(-4.0) * grid.dt * grid.particle_volume * grid.inverse_spacing
        )
        start = load - q * f
        spread(
            vec4(start[0], start[1], start[2], real(0.0)),
            vec4(q[0, 0], q[1, 0], q[2, 0], real(0.0)),
            vec4(q[0, 1], q[1, 1], q[2, 1], real(0.0)),
            vec4(q[0, 2], q[1, 2], q[2, 2], real(0.0)),
            base,
            wx,
            wy,
            wz,
            grid,
            impulse,
        )

    return SimpleNamespace(to_grid=to_grid, advance=advance)
