"""Particle-grid transfers with quadratic B-splines (APIC / MLS), and the material update.

Momentum is carried to the grid only now and then (`to_grid`, `from_grid`: a remap). In between the velocities live on
the grid: particles give impulses (`scatter`) and feel the velocity and its gradient (`gather`), with the spline weights
of the place they had at the remap, their `home`. A remap smooths velocities over a grid spacing; done in every step,
that smoothing acts as a viscosity that grows with 1 / dt.

The transfers visit the 27 nodes around a particle, as 9 rows along z. Node (i, j, k) is entry (i ny + j) nz + k of a
flat array of 4-vectors: momentum and mass, or impulse and mass times the particles' last volume change, or velocity and
its mean.
"""

from functools import cache, partial
from types import SimpleNamespace
from typing import TYPE_CHECKING

import warp as wp

from ..launch import SceneKernel
from .constitutive import constitutive, loose_soil
from .contact import ContactLaw, body_struct, contact
from .fluidity import fluidity, soil_struct
from .grid import grid_struct, particle_struct, row_operations, splines

if TYPE_CHECKING:
    from ..effects import Effects


@cache
def transfer(real: type, effects: "Effects", contact_law: ContactLaw | None, atomic: bool) -> SimpleNamespace:
    """Kernels in precision `real` with only the physics in `effects`: `to_grid` and `from_grid` at a remap;
    `scatter`, `gather` and `material` in every step, and `press` for the push of a further body.

    `contact_law` is that with a body, None without one; `atomic` is needed where many threads write to the grid at once
    (a GPU).
    """
    # Warp writes a product and the sum it goes into as two statements: without the flag they stay two instructions.
    flags = f"{wp.config.cpu_compiler_flags or '-march=native'} -ffp-contract=fast"
    fused_kernel = partial(SceneKernel, module_options={"cpu_compiler_flags": flags})
    vec3 = wp.types.vector(3, real)
    vec4 = wp.types.vector(4, real)
    law = constitutive(real, effects)
    vec6, mat33 = law.vec6, law.mat33
    Soil, Grid, Body = soil_struct(real), grid_struct(real), body_struct(real)
    Particles, vec4s, reals, ints = particle_struct(real), *(wp.array(dtype=t) for t in (vec4, real, int))
    with_body = contact_law is not None
    push = contact(real, contact_law or ContactLaw(), atomic)
    update, kirchhoff, can_tear = law.update, law.kirchhoff, effects.can_tear
    fading = fluidity(real).fading
    apart, loose_volume = loose_soil(real).apart, loose_soil(real).volume
    spline = splines(real)
    base_and_offset, weights, moments = spline.base_and_offset, spline.weights, spline.moments
    lanes = row_operations(real, gpu=atomic)
    row, plus, gather_row, scatter_row, spread, fold = (
        lanes.row, lanes.plus, lanes.gather, lanes.scatter, lanes.spread, lanes.fold
    )  # fmt: skip

    @wp.func
    def node_index(base: wp.vec3i, i: int, j: int, grid: Grid):
        return ((base[0] + i) * grid.ny + base[1] + j) * grid.nz + base[2]

    @wp.func
    def fail(fault: ints, p: int, substep: int, near_home: int):
        # The first faulty particle is remembered; the solver stops at the end of the frame.
        if wp.atomic_add(fault, 0, 1) == 0:
            fault[1] = p
            fault[2] = substep
            fault[3] = near_home

    @wp.func
    def bond_of(p: int, particles: Particles):
        if wp.static(can_tear):
            return particles.bond[p]
        else:
            return real(0.0)

    @wp.func
    def part(p: int, grid: Grid):
        # Of a particle that counts: half on a plane of symmetry.
        if wp.static(effects.symmetry):
            return wp.where(p < grid.on_plane, real(0.5), real(1.0))
        else:
            return real(1.0)

    @wp.func
    def deposit(base: wp.vec3i, f: vec3, corner: vec4, q: mat33, grid: Grid, nodes: vec4s):
        # Adds weight times an affine field: `corner` at the lowest node, the columns of q more with every cell along
        # x, y, z. The sum over a row is the same for all nine rows but for the weights.
        wx = weights(f[0])
        wy = weights(f[1])
        wz = weights(f[2])
        zero = real(0.0)
        plane = spread(wz, corner, vec4(q[0, 2], q[1, 2], q[2, 2], zero))
        row_x = spread(wz, vec4(q[0, 0], q[1, 0], q[2, 0], zero), vec4())
        row_y = spread(wz, vec4(q[0, 1], q[1, 1], q[2, 1], zero), vec4())
        for i in range(3):
            at = plane
            for j in range(3):
                scatter_row(nodes, node_index(base, i, j, grid), plus(row(), wx[i] * wy[j], at))
                at = plus(at, real(1.0), row_y)
            plane = plus(plane, real(1.0), row_x)

    @fused_kernel
    def to_grid(p: int, particles: Particles, grid: Grid, momentum: vec4s, top_speed: reals, fault: ints):
        x = particles.position[p]
        v = particles.velocity[p]
        speed = wp.length(v)
        if not (speed < grid.speed_limit):  # true for a NaN, too
            fail(fault, p, grid.substep[0], 0)
            return
        wp.atomic_max(top_speed, 0, speed)
        particles.home[p] = x
        base, f = base_and_offset(x, grid)
        mass = part(p, grid) * grid.particle_mass
        q = particles.velocity_gradient[p] * (mass * grid.spacing)
        start = mass * v - q * f
        deposit(base, f, vec4(start[0], start[1], start[2], mass), q, grid, momentum)

    @fused_kernel
    def scatter(p: int, particles: Particles, grid: Grid, body: Body, impulse: vec4s):
        base, f = base_and_offset(particles.home[p], grid)
        mass = part(p, grid) * grid.particle_mass
        # Of the stress: -dt V D^-1 tau (x_i - x_p), D = dx^2 / 4; q is per cell.
        t = particles.stress[p]
        q = mat33(t[0], t[3], t[4], t[3], t[1], t[5], t[4], t[5], t[2]) * (
            real(-4.0) * grid.dt * (part(p, grid) * grid.particle_volume) * grid.inverse_spacing
        )
        start = -(q * f)
        if wp.static(with_body):
            felt = particles.felt_velocity[p]
            u = vec3(felt[0], felt[1], felt[2])
            start += push(p, particles.position[p], u, mass, part(p, grid), grid.dt, grid.substep[0], body)
        swelling = mass * particles.swelling[p]
        deposit(base, f, vec4(start[0], start[1], start[2], swelling), q, grid, impulse)

    @fused_kernel
    def press(p: int, particles: Particles, grid: Grid, body: Body, impulse: vec4s):
        felt = particles.felt_velocity[p]
        u = vec3(felt[0], felt[1], felt[2])
        mass = part(p, grid) * grid.particle_mass
        given = push(p, particles.position[p], u, mass, part(p, grid), grid.dt, grid.substep[0], body)
        if wp.length_sq(given) > real(0.0):
            base, f = base_and_offset(particles.home[p], grid)
            deposit(base, f, vec4(given[0], given[1], given[2], real(0.0)), mat33(), grid, impulse)

    @fused_kernel
    def gather(p: int, particles: Particles, grid: Grid, velocity: vec4s, cooperation: vec4s, fault: ints):
        base, f = base_and_offset(particles.home[p], grid)
        wx = weights(f[0])
        wy = weights(f[1])
        wz = weights(f[2])
        # Weights times the node's distance from the particle, for the velocity gradient.
        ax = moments(wx, f[0])
        ay = moments(wy, f[1])
        az = moments(wz, f[2])
        all_v = row()
        all_x = row()
        all_y = row()
        for i in range(3):
            plane = row()
            plane_y = row()
            for j in range(3):
                v_row = gather_row(velocity, node_index(base, i, j, grid))
                plane = plus(plane, wy[j], v_row)
                plane_y = plus(plane_y, ay[j], v_row)
            all_v = plus(all_v, wx[i], plane)
            all_x = plus(all_x, ax[i], plane)
            all_y = plus(all_y, wx[i], plane_y)
        total = fold(wz, all_v)
        if wp.static(effects.nonlocality):
            around = row()
            for i in range(3):
                for j in range(3):
                    given = gather_row(cooperation, node_index(base, i, j, grid))
                    around = plus(around, wx[i] * wy[j], given)
            particles.excess[p] = fold(wz, around)[0]
        gx = fold(wz, all_x)
        gy = fold(wz, all_y)
        gz = fold(az, all_v)
        scale = real(4.0) * grid.inverse_spacing
        moved = particles.position[p] + grid.dt * vec3(total[0], total[1], total[2])
        g = (moved - grid.origin) * grid.inverse_spacing
        inside = (
            g[0] >= real(0.5) and g[1] >= real(0.5) and g[2] >= real(0.5)
            and g[0] < real(grid.nx) - real(1.5)
            and g[1] < real(grid.ny) - real(1.5)
            and g[2] < real(grid.nz) - real(1.5)
        )  # fmt: skip
        near = wp.length_sq(moved - particles.home[p]) < grid.spacing * grid.spacing  # false for a NaN, too
        if inside and near:
            particles.position[p] = moved
            particles.felt_velocity[p] = total
            particles.velocity_gradient[p] = mat33(
                gx[0] * scale, gy[0] * scale, gz[0] * scale,
                gx[1] * scale, gy[1] * scale, gz[1] * scale,
                gx[2] * scale, gy[2] * scale, gz[2] * scale,
            )  # fmt: skip
        else:
            particles.velocity_gradient[p] = mat33()  # the particle keeps its last good state
            fail(fault, p, grid.substep[0], wp.where(near, 1, 0))

    # A kernel of its own: in one with the transfer the C++ compiler makes both slower.
    @fused_kernel
    def material(p: int, particles: Particles, grid: Grid, soil: Soil):
        # What `update` means by its last number; the excess is what cooperative flow adds (fluidity.py).
        g = real(0.0)
        if wp.static(effects.nonlocality):
            g = particles.excess[p]
        if wp.static(effects.fluidity):
            kept = real(1.0)
            if wp.static(effects.nonlocality):
                kept = fading(grid.inverse_spacing, grid.dt, soil)
            g = wp.max(kept * particles.fluidity[p] + g, real(0.0))
        before = particles.elastic_strain[p]
        # Volume changes as the mean over the nodes around does: what a particle's own gradient says besides is noise,
        # and is taken back within the time a wave needs for a cell. `swelling` is the sum of its recent changes, and
        # `mean` the mean of that. Soil that bears no stress has no say in it and repeats the mean: its changes are
        # large, and shared out they would compress the dense soil that it falls on.
        recent = particles.swelling[p]
        mean = particles.felt_velocity[p][3]
        bond = bond_of(p, particles)
        averaged = grid.volume_averaging * grid.forgetting * (mean - recent)
        if wp.static(effects.separation):
            averaged *= real(1.0) - apart(particles.log_volume[p] - bond)
        volume_before = particles.log_volume[p] + averaged
        state = update(
            before, volume_before, grid.dt * particles.velocity_gradient[p], grid.dt, soil, g, bond
        )
        after = vec6(state[0], state[1], state[2], state[3], state[4], state[5])
        particles.elastic_strain[p] = after
        particles.log_volume[p] = state[6]
        if wp.static(can_tear):
            particles.bond[p] = state[8]
            bond = state[8]
        changes = (real(1.0) - grid.forgetting) * recent + state[6] - volume_before
        if wp.static(effects.separation):
            mean = (real(1.0) - grid.forgetting) * mean
            changes += apart(wp.max(volume_before, state[6]) - bond) * (mean - changes)
        particles.swelling[p] = changes
        if wp.static(effects.fluidity):
            particles.fluidity[p] = state[7]
        # Viscosity of the elastic strain: it damps waves that the grid hardly resolves and leaves steady flow alone. It
        # takes away at most half of the pressure, since soil can bear no tension, or no more than its bond.
        volume = state[6] + grid.damping * (state[6] - volume_before)
        if wp.static(effects.separation):
            volume = wp.where(state[6] < bond, wp.min(volume, real(0.5) * (state[6] + bond)), state[6])
        t = kirchhoff(after + grid.damping * (after - before), volume, bond, soil)
        particles.stress[p] = vec6(t[0, 0], t[1, 1], t[2, 2], t[0, 1], t[0, 2], t[1, 2])

    @wp.func
    def within_walls(x: vec3, grid: Grid):
        # A wall is a condition at nodes; between two remaps a particle on it may follow the node inside and get beyond.
        # Where there is none, `low` and `high` lie outside of the grid.
        for axis in range(3):
            x[axis] = wp.max(x[axis], grid.origin[axis] + real(grid.low[axis]) * grid.spacing)
            x[axis] = wp.min(x[axis], grid.origin[axis] + real(grid.high[axis]) * grid.spacing)
        return x

    @fused_kernel
    def from_grid(p: int, particles: Particles, grid: Grid, before: vec4s, keep: reals):
        # The particle's own velocity changes by what changed on the grid; of the part that the grid does not resolve
        # the share `keep` is left.
        base, f = base_and_offset(particles.home[p], grid)
        wx = weights(f[0])
        wy = weights(f[1])
        total = row()
        for i in range(3):
            for j in range(3):
                total = plus(total, wx[i] * wy[j], gather_row(before, node_index(base, i, j, grid)))
        smooth = fold(weights(f[2]), total)
        felt = particles.felt_velocity[p]
        u = vec3(felt[0], felt[1], felt[2])
        particles.position[p] = within_walls(particles.position[p], grid)
        ln_j = particles.log_volume[p]
        if wp.static(effects.separation):
            if ln_j > bond_of(p, particles):
                particles.log_volume[p] = loose_volume(ln_j, base, f, before, grid)
        v = particles.velocity[p]
        particles.velocity[p] = u + keep[0] * (v - vec3(smooth[0], smooth[1], smooth[2]))

    return SimpleNamespace(
        to_grid=to_grid, scatter=scatter, press=press, gather=gather, material=material, from_grid=from_grid
    )
