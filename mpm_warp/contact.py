"""The grid step: gravity, the body, floor and walls."""

from functools import cache

import warp as wp

from .transfer import grid_struct

__all__ = ["body_struct", "grid_step"]


@cache
def body_struct(real: type) -> type:
    """Struct of a box-shaped body and its prescribed motion over the substeps of one frame."""
    vec3, quat = wp.types.vector(3, real), wp.types.quaternion(real)

    @wp.struct
    class Body:
        half_size: vec3  # with the contact margin [m]
        reach: real  # radius of the sphere around the box [m]
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
def grid_step(real: type, with_body: bool) -> wp.Kernel:
    """Kernel that turns momentum into velocity, applies gravity and contact, and clears the momentum."""
    vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)
    Grid, Body = grid_struct(real), body_struct(real)

    @wp.func
    def box_normal(q: vec3, half: vec3):
        # Outward normal of the face nearest to an inside point (body frame).
        dx = half[0] - wp.abs(q[0])
        dy = half[1] - wp.abs(q[1])
        dz = half[2] - wp.abs(q[2])
        n = vec3(wp.sign(q[0]), real(0.0), real(0.0))
        if dy < dx and dy <= dz:
            n = vec3(real(0.0), wp.sign(q[1]), real(0.0))
        if dz < dx and dz < dy:
            n = vec3(real(0.0), real(0.0), wp.sign(q[2]))
        return n

    @wp.func
    def after_contact(v: vec3, arm: vec3, s: int, body: Body):
        # Soil moving into the body loses its normal velocity relative to the body and at most the
        # Coulomb share of the tangential one; soil moving away is left alone.
        rotation = body.rotation[s]
        q = wp.quat_rotate_inv(rotation, arm)
        half = body.half_size
        if wp.abs(q[0]) < half[0] and wp.abs(q[1]) < half[1] and wp.abs(q[2]) < half[2]:
            normal = wp.quat_rotate(rotation, box_normal(q, half))
            body_velocity = body.velocity[s] + wp.cross(body.spin[s], arm)
            relative = v - body_velocity
            approach = wp.dot(relative, normal)
            if approach < real(0.0):
                tangential = relative - approach * normal
                slip = wp.length(tangential)
                if slip > real(0.0):
                    keep = wp.max(real(0.0), real(1.0) + body.friction * approach / slip)
                    return body_velocity + keep * tangential
                return body_velocity
        return v

    @wp.kernel(module="unique", enable_backward=False)
    def step(
        grid: Grid,
        body: Body,
        nodes: wp.array(dtype=vec4),
        velocity: wp.array(dtype=vec4),
        substep: wp.array(dtype=int),
    ):
        n = wp.tid()
        node = nodes[n]
        mass = node[3]
        if mass > real(0.0):
            nodes[n] = vec4()
            v = vec3(node[0], node[1], node[2]) / mass
            v = v - vec3(real(0.0), real(0.0), grid.gravity * grid.dt)
            k = n % grid.nz
            j = (n // grid.nz) % grid.ny
            i = n // (grid.nz * grid.ny)
            if wp.static(with_body):
                s = substep[0]
                at = grid.origin + grid.spacing * vec3(real(i), real(j), real(k))
                arm = at - body.position[s]
                if wp.length_sq(arm) < body.reach * body.reach:
                    touched = after_contact(v, arm, s, body)
                    impulse = mass * (v - touched)
                    if wp.length_sq(impulse) > real(0.0):
                        wp.atomic_add(body.impulse, 0, impulse)
                        wp.atomic_add(body.impulse, 1, wp.cross(arm, impulse))
                        v = touched
            low = grid.low
            high = grid.high
            if i <= low[0] or j <= low[1] or k <= low[2] or i >= high[0] or j >= high[1] or k >= high[2]:
                v = vec3()  # no slip on floor and walls
            velocity[n] = vec4(v[0], v[1], v[2], real(0.0))

    return step
