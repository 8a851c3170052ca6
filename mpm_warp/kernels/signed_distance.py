"""Signed distances of bodies as Warp functions, compiled for one shape each."""

from functools import cache

import numpy as np
import warp as wp

from ..bodies import Tool
from ..launch import SceneKernel

OUT_OF_REACH = 1.0e6  # [m], for points that cannot touch
ALONG = -0.95  # most cosine between the normals of a wall's two sides: what tapers faster is an edge


@cache
def shape_struct(real: type) -> type:
    """Struct of a body's sizes [m] in precision `real`; a shape sets and reads only some of them."""
    vec3 = wp.types.vector(3, real)

    @wp.struct
    class Size:
        half: vec3  # of a box; of the box that holds a mesh and everything in contact with it
        sides: wp.types.matrix((4, 4), real)  # of a plate's section: x, z and direction
        lengths: wp.types.vector(4, real)  # of these sides
        radius: real  # of a sphere or a cylinder; what follows, of a cylinder
        half_width: real
        grousers: int
        tip_radius: real
        grouser_half: real  # half the thickness
        grouser_offset: real  # added to the grousers' distance: they begin to act at a depth of their own
        id: wp.uint64  # of a mesh
        thickening: wp.array(
            dtype=wp.float32
        )  # at its vertices, or none: how far outside it the surface is taken

    return Size


def shape_data(
    body: Tool, real: type, margin: float, device: wp.Device, thickening: np.ndarray | None = None
) -> tuple[object, wp.Mesh | None]:
    """The filled struct of a body, and the mesh that has to be kept alive with it.

    Args:
        margin: distance at which contact begins, negative inside [m].
        thickening: of a mesh at its vertices [m], shape (k,), see `tool_geometry.thickening`.
    """
    data, mesh, half = shape_struct(real)(), None, body.half_size
    if body.surface == "cylinder":
        data.radius, data.half_width = 0.5 * body.diameter, 0.5 * body.width
        data.grousers, data.tip_radius = body.grousers, body.tip_radius
        data.grouser_half = 0.5 * body.grouser_thickness
        # A bar can be thinner than twice the depth at which contact begins; it then begins half-way to its middle.
        data.grouser_offset = min(0.0, margin + 0.25 * body.grouser_thickness)
    elif body.surface == "sphere":
        data.radius = body.reach
    elif body.surface == "plate":
        along = np.roll(body.section, -1, axis=0) - body.section
        lengths = np.linalg.norm(along, axis=1)
        data.sides = wp.types.matrix((4, 4), real)(np.hstack([body.section, along / lengths[:, None]]))
        data.lengths = wp.types.vector(4, real)(*lengths)
    elif body.surface == "mesh":
        vertices, triangles = body.mesh
        mesh = wp.Mesh(
            points=wp.array(vertices, dtype=wp.vec3, device=device),
            indices=wp.array(triangles.ravel(), dtype=int, device=device),
            support_winding_number=True,
        )
        data.id, half = mesh.id, half + max(0.0, margin)
        if thickening is not None:
            data.thickening = wp.array(thickening, dtype=wp.float32, device=device)
            half = half + float(thickening.max())
    data.half = wp.types.vector(3, real)(*half)
    return data, mesh


@cache
def signed_distance(real: type, shape: str) -> wp.Function:
    """Warp function (point in the body frame, struct of the shape) -> outward normal and, as the fourth number,
    signed distance [m], negative inside. Inside a corner the nearest face counts; inside a grouser's root the
    distance is a lower bound."""
    return {"box": _box, "plate": _plate, "cylinder": _cylinder, "sphere": _sphere, "mesh": _mesh}[shape](
        real
    )


@cache
def distance_kernel(shape: str) -> SceneKernel:
    """Kernel that finds the signed distances of points in the body frame, in double precision."""
    real = wp.float64
    vec3, Size, outward = wp.types.vector(3, real), shape_struct(real), signed_distance(real, shape)

    @SceneKernel
    def distance(i: int, points: wp.array(dtype=vec3), size: Size, found: wp.array(dtype=real)):
        found[i] = outward(points[i], size)[3]

    return distance


@cache
def wall_kernel() -> SceneKernel:
    """Kernel that finds how thick a mesh is along rays from its surface inwards [m]; infinite where the other side is
    further than `most` or does not run along with this one."""

    @SceneKernel
    def wall(
        i: int,
        begin: wp.array(dtype=wp.vec3),
        inwards: wp.array(dtype=wp.vec3),
        mesh: wp.uint64,
        most: wp.float32,
        found: wp.array(dtype=wp.float32),
    ):
        hit = wp.mesh_query_ray(mesh, begin[i], inwards[i], most)
        found[i] = wp.float32(wp.inf)
        if hit.result and wp.dot(wp.mesh_eval_face_normal(mesh, hit.face), -inwards[i]) < wp.static(ALONG):
            found[i] = hit.t

    return wall


@cache
def _nearest_face(real: type) -> wp.Function:
    vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)

    @wp.func
    def nearest_face(d: vec3):
        # d: signed distances from three faces at right angles. Outward normal and signed distance of their corner.
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
        return vec4(n[0], n[1], n[2], distance)

    return nearest_face


def _box(real: type) -> wp.Function:
    vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)
    Size = shape_struct(real)
    nearest_face = _nearest_face(real)

    @wp.func
    def box_distance(q: vec3, size: Size):
        half = size.half
        n = nearest_face(vec3(wp.abs(q[0]) - half[0], wp.abs(q[1]) - half[1], wp.abs(q[2]) - half[2]))
        return vec4(n[0] * wp.sign(q[0]), n[1] * wp.sign(q[1]), n[2] * wp.sign(q[2]), n[3])

    return box_distance


def _plate(real: type) -> wp.Function:
    vec2, vec3, vec4 = (wp.types.vector(n, real) for n in (2, 3, 4))
    Size = shape_struct(real)

    @wp.func
    def plate_distance(q: vec3, size: Size):
        # Of the section, which is convex: outside the nearest side counts, inside the nearest line.
        deepest = real(-OUT_OF_REACH)
        nearest = real(OUT_OF_REACH)
        normal = vec2()
        away = vec2()
        for k in range(4):
            along = vec2(size.sides[k, 2], size.sides[k, 3])
            r = vec2(q[0] - size.sides[k, 0], q[2] - size.sides[k, 1])
            n = vec2(along[1], -along[0])
            if wp.dot(r, n) > deepest:
                deepest = wp.dot(r, n)
                normal = n
            r -= wp.clamp(wp.dot(r, along), real(0.0), size.lengths[k]) * along
            if wp.length(r) < nearest:
                nearest = wp.length(r)
                away = r
        distance = deepest
        if deepest > real(0.0):
            distance = nearest
            normal = away / nearest
        end = wp.abs(q[1]) - size.half[1]
        side = wp.sign(q[1])
        if end > real(0.0) and distance > real(0.0):
            both = wp.sqrt(end * end + distance * distance)
            return vec4(distance / both * normal[0], end / both * side, distance / both * normal[1], both)
        if end > distance:
            return vec4(real(0.0), side, real(0.0), end)
        return vec4(normal[0], real(0.0), normal[1], distance)

    return plate_distance


def _cylinder(real: type) -> wp.Function:
    vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)
    Size = shape_struct(real)
    nearest_face = _nearest_face(real)

    @wp.func
    def cylinder_distance(q: vec3, size: Size):
        r = wp.sqrt(q[0] * q[0] + q[2] * q[2])
        end = wp.abs(q[1]) - size.half_width
        side = wp.sign(q[1])
        away = vec3(real(1.0), real(0.0), real(0.0))  # from the axis; on it any direction will do
        if r > real(0.0):
            away = vec3(q[0] / r, real(0.0), q[2] / r)
        rim = nearest_face(vec3(r - size.radius, end, -size.radius))
        normal = rim[0] * away
        distance = rim[3]
        normal[1] = rim[1] * side
        if size.grousers > 0:
            # The bar nearest in angle, which reaches from the axis to its tip: its foot is no surface.
            period = real(2.0) * real(wp.pi) / real(size.grousers)
            angle = period * wp.round(wp.atan2(q[2], q[0]) / period)
            along = vec3(wp.cos(angle), real(0.0), wp.sin(angle))
            across = vec3(-along[2], real(0.0), along[0])
            t = wp.dot(q, across)
            bar = nearest_face(vec3(wp.dot(q, along) - size.tip_radius, end, wp.abs(t) - size.grouser_half))
            if bar[3] + size.grouser_offset < distance:
                distance = bar[3] + size.grouser_offset
                normal = bar[0] * along + bar[2] * wp.sign(t) * across
                normal[1] = bar[1] * side
        return vec4(normal[0], normal[1], normal[2], distance)

    return cylinder_distance


def _sphere(real: type) -> wp.Function:
    vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)
    Size = shape_struct(real)

    @wp.func
    def sphere_distance(q: vec3, size: Size):
        away = wp.length(q)
        n = vec3(real(0.0), real(0.0), real(1.0))  # in the middle any direction will do
        if away > real(0.0):
            n = q / away
        return vec4(n[0], n[1], n[2], away - size.radius)

    return sphere_distance


def _mesh(real: type) -> wp.Function:
    vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)
    Size = shape_struct(real)

    @wp.func
    def mesh_distance(q: vec3, size: Size):
        half = size.half
        found = vec4(real(0.0), real(0.0), real(1.0), real(OUT_OF_REACH))
        if wp.abs(q[0]) < half[0] and wp.abs(q[1]) < half[1] and wp.abs(q[2]) < half[2]:
            # Warp's queries are single precision only.
            p = wp.vec3(wp.float32(q[0]), wp.float32(q[1]), wp.float32(q[2]))
            query = wp.mesh_query_point_sign_winding_number(size.id, p, wp.float32(OUT_OF_REACH))
            if query.result:
                away = p - wp.mesh_eval_position(size.id, query.face, query.u, query.v)
                distance = wp.length(away)
                # On the surface itself the difference has no direction, but the triangle has.
                n = wp.mesh_eval_face_normal(size.id, query.face)
                if distance > wp.float32(1.0e-6) * wp.length(p):
                    n = away * (query.sign / distance)
                distance *= query.sign
                if size.thickening.shape[0] > 0:
                    corners = wp.mesh_get(size.id).indices
                    k = 3 * query.face
                    distance -= (
                        query.u * size.thickening[corners[k]] + query.v * size.thickening[corners[k + 1]]
                    )
                    distance -= (wp.float32(1.0) - query.u - query.v) * size.thickening[corners[k + 2]]
                found = vec4(real(n[0]), real(n[1]), real(n[2]), real(distance))
        return found

    return mesh_distance
