"""Contact between soil particles and a rigid body.

A particle within the body is pushed out by a stiff damped spring along the body's normal and held back by Coulomb
friction; the body receives the opposite. Particles move with the soil, so the force changes smoothly as the body
advances, while contact enforced at grid nodes comes and goes with every cell the body crosses.

The grid spreads a push over the width of its B-splines, so a body acts about half a grid spacing further out than it
is. Contact therefore begins at a margin of -1/2 grid spacings: when a particle's centre is that far inside.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

__all__ = ["body_struct", "contact"]


@cache
def body_struct(real: type) -> type:
    """Struct of a box-shaped body and its prescribed motion over the substeps of one frame."""
    vec3, quat = wp.types.vector(3, real), wp.types.quaternion(real)

    @wp.struct
    class Body:
        half_size: vec3  # [m]
        reach: real  # radius of the sphere around the box and everything in contact with it [m]
        margin: real  # distance from the surface at which contact begins, negative inside [m]
        stiffness: real  # of the spring [N/m]
        damping: real  # [N s/m]
        separation_speed: real  # no push on soil that leaves faster than this [m/s]
        friction: real
        position: wp.array(dtype=vec3)  # of the centre of mass at the start of each substep [m]
        rotation: wp.array(dtype=quat)
        velocity: wp.array(dtype=vec3)  # pose difference over the substep [m/s]
        spin: wp.array(dtype=vec3)  # angular velocity, world frame [rad/s]
        impulse: wp.array(
            dtype=vec3
        )  # [0] by the soil on the body [N s], [1] its moment about the centre of mass

    return Body


@cache
def contact(real: type, atomic: bool) -> SimpleNamespace:
    """Warp function `push(x, v, mass, dt, s, body)` -> impulse on a particle [N s] in substep s, in precision `real`.

    The opposite impulse is added to the body; `atomic` is needed where many threads do so at once (a GPU).
    """
    vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)
    Body = body_struct(real)

    @wp.func
    def outward(q: vec3, half: vec3):
        # Outward normal of a box at a point in the body frame, and the signed distance as the fourth number.
        d = vec3(wp.abs(q[0]) - half[0], wp.abs(q[1]) - half[1], wp.abs(q[2]) - half[2])
        out = vec3(wp.max(d[0], real(0.0)), wp.max(d[1], real(0.0)), wp.max(d[2], real(0.0)))
        distance = wp.length(out)
        if distance > real(0.0):
            n = out / distance
        else:
            distance = wp.max(d[0], wp.max(d[1], d[2]))
            n = vec3(real(1.0), real(0.0), real(0.0))
            if d[1] > d[0] and d[1] >= d[2]:
                n = vec3(real(0.0), real(1.0), real(0.0))
            if d[2] > d[0] and d[2] > d[1]:
                n = vec3(real(0.0), real(0.0), real(1.0))
        return vec4(n[0] * wp.sign(q[0]), n[1] * wp.sign(q[1]), n[2] * wp.sign(q[2]), distance)

    @wp.func
    def push(x: vec3, v: vec3, mass: real, dt: real, s: int, body: Body):
        arm = x - body.position[s]
        impulse = vec3()
        if wp.length_sq(arm) < body.reach * body.reach:
            rotation = body.rotation[s]
            found = outward(wp.quat_rotate_inv(rotation, arm), body.half_size)
            overlap = body.margin - found[3]
            if overlap > real(0.0):
                normal = wp.quat_rotate(rotation, vec3(found[0], found[1], found[2]))
                relative = v - body.velocity[s] - wp.cross(body.spin[s], arm)
                leaving = wp.dot(relative, normal)
                if leaving < body.separation_speed:
                    pressed = dt * (body.stiffness * overlap - body.damping * leaving)
                    if pressed > real(0.0):
                        impulse = pressed * normal
                        sliding = relative - leaving * normal
                        speed = wp.length(sliding)
                        if speed > real(0.0):
                            impulse -= wp.min(body.friction * pressed, mass * speed) / speed * sliding
                        if wp.static(atomic):
                            wp.atomic_sub(body.impulse, 0, impulse)
                            wp.atomic_sub(body.impulse, 1, wp.cross(arm, impulse))
                        else:
                            body.impulse[0] = body.impulse[0] - impulse
                            body.impulse[1] = body.impulse[1] - wp.cross(arm, impulse)
        return impulse

    return SimpleNamespace(push=push)
