"""Contact between soil and a rigid body, and the motion of a body whose height, or all of it, is free.

A particle within the body is pushed out by a stiff damped spring along the body's normal. A second spring holds it back
along the surface; it is stretched by the sliding since contact began, no further than Coulomb friction allows (Cundall
& Strack 1979). Friction without such a memory could take no more from a particle than the momentum of its own sliding,
far too little where soil slides at millimetres per second under a load. The body receives the opposite of both.
Particles move with the soil, so the force changes smoothly as the body advances, while contact enforced at grid nodes
comes and goes with every cell the body crosses.

The grid spreads a push over the width of its B-splines, whose support reaches one and a half grid spacings, so a body
acts further out than it is. Contact therefore begins at a margin of -1/4 grid spacings: when the soil's edge, half a
particle spacing from a particle's centre, is that far inside. Wheels, which press on soil and hardly cut it, have none.

Bilateral contact holds the soil as well: within a layer half a grid spacing thick outside the place where the spring
begins, the damper takes away the particle's normal velocity relative to the body, towards it or away from it.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from ..launch import SceneKernel
from .grid import grid_struct, node_functions
from .signed_distance import shape_struct, signed_distance

HOLDING_LAYER = 0.5
"""Thickness of the layer of soil that bilateral contact holds [grid spacings]."""


@dataclass(frozen=True)
class ContactLaw:
    """What the contact kernel is compiled for."""

    shape: str = "box"
    """Of the body, see `Tool.surface`."""
    bilateral: bool = False
    """Soil in contact may not leave along the normal."""
    free: bool = False
    """The body's height is not prescribed but computed (see `axle_step`)."""
    torque: bool = True
    """The moment of the soil's push is added up."""
    loose: bool = False
    """All of the body's motion is computed (see `free_step`)."""
    at_nodes: bool = False
    """The body stops grid nodes (see `node_contact`) and not particles."""


@cache
def body_struct(real: type) -> type:
    """Struct of a body and its motion over the substeps of one frame."""
    vec3, quat = wp.types.vector(3, real), wp.types.quaternion(real)
    Shape = shape_struct(real)

    @wp.struct
    class Body:
        shape: Shape
        reach: real  # radius of a sphere that a particle in contact cannot leave within a substep [m]
        margin: real  # distance from the surface at which contact begins, negative inside [m]
        layer: real  # thickness of the layer that bilateral contact holds [m]
        stiffness: real  # of the spring [N/m]
        damping: real  # [N s/m]
        separation_speed: real  # no push on soil that leaves faster than this [m/s]
        friction: real
        position: wp.array(dtype=vec3)  # of the centre of mass at the start of each substep [m]
        rotation: wp.array(dtype=quat)
        velocity: wp.array(dtype=vec3)  # pose difference over the substep [m/s]
        spin: wp.array(dtype=vec3)  # angular velocity, world frame [rad/s]
        axle: wp.array(dtype=wp.float64)  # of a free body: height [m], its rate [m/s] in place of the above
        stick: wp.array(dtype=vec3)  # stretch of each particle's tangential spring, world frame [m]
        impulse: wp.array(dtype=vec3)  # by the soil on the body [N s]; with `torque` also its moment [N m s]

    return Body


@cache
def _taking(real: type, atomic: bool) -> wp.Function:
    """Warp function that takes an amount from a sum."""
    vec3 = wp.types.vector(3, real)

    # Warp's own sum would be rounded otherwise on a CPU, too: its product and sum are fused differently.
    @wp.func
    def take(total: wp.array(dtype=vec3), i: int, amount: vec3):
        if wp.static(atomic):
            wp.atomic_sub(total, i, amount)
        else:
            total[i] = total[i] - amount

    return take


@cache
def contact(real: type, law: ContactLaw, atomic: bool) -> wp.Function:
    """Warp function `push(p, x, v, mass, part, dt, s, body)` in precision `real`: impulse on particle p, of which
    `part` is computed, in substep s [N s].

    The opposite impulse is added to the body; `atomic` is needed where many threads do so at once (a GPU).
    """
    vec3 = wp.types.vector(3, real)
    Body = body_struct(real)
    outward = signed_distance(real, law.shape)
    bilateral, free, torque, loose = law.bilateral, law.free, law.torque, law.loose
    take = _taking(real, atomic)

    @wp.func
    def push(p: int, x: vec3, v: vec3, mass: real, part: real, dt: real, substep: int, body: Body):
        s = substep
        if wp.static(loose):
            s = 0
        centre = body.position[s]
        if wp.static(free):
            centre = vec3(centre[0], centre[1], real(body.axle[0]))
        arm = x - centre
        impulse = vec3()
        if wp.length_sq(arm) < body.reach * body.reach:
            rotation = body.rotation[s]
            found = outward(wp.quat_rotate_inv(rotation, arm), body.shape)
            overlap = body.margin - found[3]
            stretch = vec3()
            if overlap > -body.layer:
                normal = wp.quat_rotate(rotation, vec3(found[0], found[1], found[2]))
                velocity = body.velocity[s]
                if wp.static(free):
                    velocity = vec3(velocity[0], velocity[1], real(body.axle[1]))
                relative = v - velocity - wp.cross(body.spin[s], arm)
                leaving = wp.dot(relative, normal)
                stiffness = part * body.stiffness
                damping = part * body.damping
                hold = wp.min(dt * damping, mass)  # dampers may stop the particle, not turn it back
                pressed = real(0.0)
                if wp.static(bilateral):
                    pressed = dt * stiffness * wp.max(overlap, real(0.0)) - hold * leaving
                elif leaving < body.separation_speed:
                    pressed = wp.max(dt * (stiffness * overlap - damping * leaving), real(0.0))
                if pressed != real(0.0):
                    sliding = relative - leaving * normal
                    stretch = body.stick[p]
                    stretch += dt * sliding - wp.dot(stretch, normal) * normal
                    grip = dt * stiffness * stretch + hold * sliding
                    size = wp.length(grip)
                    most = body.friction * wp.abs(pressed)
                    if size > most:
                        grip = grip * (most / size)
                        stretch = grip / (dt * stiffness)
                    impulse = pressed * normal - grip
                    take(body.impulse, 0, impulse)
                    if wp.static(torque):
                        take(body.impulse, 1, wp.cross(arm, impulse))
            body.stick[p] = stretch
        return impulse

    return push


@cache
def node_contact(real: type, law: ContactLaw, symmetric: bool, atomic: bool) -> SceneKernel:
    """Kernel on the nodes, after `grid_step`, for a plate of prescribed motion: a node nearer than the margin does not
    move further into the plate, and rubs along it as along a wall. There is no memory of sliding. Nodes less than a
    grid spacing above its square end are pressed along the end's normal, others along that of the nearest face. With
    `symmetric` a node in the plate's own plane counts half."""
    vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)
    Grid, Body, functions = grid_struct(real), body_struct(real), node_functions(real)
    outward, take = signed_distance(real, law.shape), _taking(real, atomic)
    place, rub, torque = functions.place, functions.rub, law.torque

    @SceneKernel
    def step(
        n: int,
        grid: Grid,
        body: Body,
        velocity: wp.array(dtype=vec4),
        inverse_mass: wp.array(dtype=real),
    ):
        s = grid.substep[0] - 1
        if inverse_mass[n] > real(0.0):
            at = place(n, grid)
            x = grid.origin + grid.spacing * vec3(real(at[0]), real(at[1]), real(at[2]))
            arm = x - body.position[s]
            if wp.length_sq(arm) < body.reach * body.reach:
                rotation = body.rotation[s]
                q = wp.quat_rotate_inv(rotation, arm)
                found = outward(q, body.shape)
                if found[3] < body.margin:
                    out = vec3(found[0], found[1], found[2])
                    if q[2] + body.shape.half[2] < grid.spacing:
                        out = vec3(real(0.0), real(0.0), real(-1.0))
                    normal = wp.quat_rotate(rotation, out)
                    now = velocity[n]
                    own = body.velocity[s] + wp.cross(body.spin[s], arm)
                    before = vec3(now[0], now[1], now[2]) - own
                    after = rub(before, normal, body.friction)
                    mass = real(1.0) / inverse_mass[n]
                    if wp.static(symmetric):
                        if wp.abs(arm[1]) < real(1.0e-3) * grid.spacing:
                            mass = real(0.5) * mass
                    impulse = mass * (after - before)
                    after = after + own
                    velocity[n] = vec4(after[0], after[1], after[2], now[3])
                    take(body.impulse, 0, impulse)
                    if wp.static(torque):
                        take(body.impulse, 1, wp.cross(arm, impulse))

    return step


@cache
def axle_step(real: type) -> SceneKernel:
    """Kernel of one thread, which moves a body of free height (rigid_body.py): symplectic Euler with the damping taken
    implicitly."""
    vec3 = wp.types.vector(3, real)

    @SceneKernel
    def step(
        _: int,
        axle: wp.array(dtype=wp.float64),  # height [m], its rate [m/s], vertical impulse of this frame [N s]
        impulse: wp.array(dtype=vec3),
        dt: wp.float64,
        mass: wp.float64,
        fall: wp.array(dtype=wp.float64),  # acceleration without soil [m/s^2]
        damping: wp.float64,
    ):
        total = wp.float64(impulse[0][2])
        gained = total - axle[2]
        axle[2] = total
        axle[1] = (axle[1] + gained / mass - dt * fall[0]) / (wp.float64(1.0) + dt * damping)
        axle[0] = axle[0] + dt * axle[1]

    return step


# Of `free_step`'s array, where each begins.
TURNED, SPEED, SPIN, GAINED, COUNT = 3, 7, 10, 13, 19


@cache
def free_step(real: type) -> SceneKernel:
    """Kernel of one thread, which moves a free body of six degrees of freedom (rigid_body.py): symplectic Euler; the
    rotation by that of half a step on, so that what turns without torque keeps its energy to second order, and its
    angular momentum to rounding."""
    vec3, quat = wp.types.vector(3, real), wp.types.quaternion(real)
    Body = body_struct(real)

    @wp.func
    def spin(q: wp.quatd, momentum: wp.vec3d, inverse_inertia: wp.mat33d):
        return wp.quat_rotate(q, inverse_inertia * wp.quat_rotate_inv(q, momentum))

    @wp.func
    def turned(q: wp.quatd, w: wp.vec3d, dt: wp.float64):
        rate = wp.length(w)
        if rate == wp.float64(0.0):
            return q
        return wp.normalize(wp.quat_from_axis_angle(w / rate, rate * dt) * q)

    @wp.func
    def at(motion: wp.array(dtype=wp.float64), i: int):
        return wp.vec3d(motion[i], motion[i + 1], motion[i + 2])

    @wp.func
    def put(motion: wp.array(dtype=wp.float64), i: int, v: wp.vec3d):
        for axis in range(3):
            motion[i + axis] = v[axis]

    @SceneKernel
    def step(
        _: int,
        body: Body,
        # Place [m], quaternion, velocity [m/s], angular momentum [kg m^2/s]; of this frame the soil's impulse [N s] and
        # its moment [N m s].
        motion: wp.array(dtype=wp.float64),
        dt: wp.float64,
        mass: wp.float64,
        inverse_inertia: wp.mat33d,  # about the body's axes [1 / (kg m^2)]
        gravity: wp.vec3d,
    ):
        push = wp.vec3d(body.impulse[0])
        moment = wp.vec3d(body.impulse[1])
        v = at(motion, SPEED) + (push - at(motion, GAINED)) / mass + dt * gravity
        momentum = at(motion, SPIN) + moment - at(motion, GAINED + 3)
        x = at(motion, 0) + dt * v
        q = wp.quatd(motion[TURNED], motion[TURNED + 1], motion[TURNED + 2], motion[TURNED + 3])
        half = turned(q, spin(q, momentum, inverse_inertia), wp.float64(0.5) * dt)
        q = turned(q, spin(half, momentum, inverse_inertia), dt)
        put(motion, 0, x)
        for i in range(4):
            motion[TURNED + i] = q[i]
        put(motion, SPEED, v)
        put(motion, SPIN, momentum)
        put(motion, GAINED, push)
        put(motion, GAINED + 3, moment)
        body.position[0] = vec3(x)
        body.rotation[0] = quat(q)
        body.velocity[0] = vec3(v)
        body.spin[0] = vec3(spin(q, momentum, inverse_inertia))

    return step
