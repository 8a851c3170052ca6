"""Signed distances of bodies as Warp functions, compiled for one shape each; how thick the walls of a mesh are."""

from functools import cache

import numpy as np
import warp as wp

from ..bodies import MeshBody, Tool
from ..launch import Launch, SceneKernel, find_device

OUT_OF_REACH = 1.0e6  # [m], for points that cannot touch
ALONG = -0.95  # most cosine between the normals of a wall's two sides: what tapers faster is an edge
HOLDS = 0.1
"""How far a wall's middle has to be beyond where contact begins for it to hold soil [grid spacings]
(experiments/stability/thin_walls.csv)."""
_SAMPLES = [(1 / 3, 1 / 3), *((u / 8, v / 8) for u in (1, 3, 6) for v in (1, 3, 6) if u + v < 8)]
"""Places in a triangle, as the shares of its first two corners."""
_MANY_TRIANGLES = 20_000
"""So many are small: one ray from each is enough."""


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
        thickening: of a mesh at its vertices [m], shape (k,), see the function of that name.
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


# --- Of a whole tool ------------------------------------------------------------------------------------


def distances(
    body: Tool, points: np.ndarray, margin: float = 0.0, thickening: np.ndarray | None = None
) -> np.ndarray:
    """Distances of points (n, 3) from a tool's surface, negative inside, both in the body frame [m]; shape (n,).

    Args:
        margin: the largest distance that is of interest [m]; points beyond it may be said to be far away.
        thickening: of a mesh at its vertices, as the function of that name gives it [m].
    """
    device, real = find_device("cpu"), wp.float64
    shape, _lives_on = shape_data(body, real, margin, device, thickening)
    found = wp.zeros(len(points), dtype=real, device=device)
    given: wp.array = wp.array(points, dtype=wp.types.vector(3, real), device=device)
    Launch(distance_kernel(body.surface), len(points), [given, shape, found], device).launch()
    return found.numpy()


def mesh_asymmetry(body: MeshBody) -> float:
    """How far a mesh is from being its own mirror image about its plane y = 0 [m]: the farthest that the image of a
    corner, or of the middle of a triangle, is from its surface."""
    vertices, triangles = body.mesh
    points = np.concatenate([vertices, vertices[triangles].mean(axis=1)])
    return float(np.abs(distances(body, points * [1.0, -1.0, 1.0], margin=body.reach)).max())


# --- Walls of meshes: how thick they are, and what makes them hold soil ---------------------------------


def wall_thickness(body: MeshBody, most: float) -> np.ndarray:
    """How thick the mesh is below each of its triangles [m], shape (t,); infinite where there is no wall of at most
    `most` [m]: no other side that runs along with the triangle, as at edges that taper.

    A body keeps what was measured: several ask.
    """
    before, known = body.__dict__.get("_walls", (0.0, None))
    if most <= before:
        return np.where(known <= most, known, np.inf)
    device = find_device("cpu")

    def on_device(points: np.ndarray) -> wp.array:
        return wp.array(points, dtype=wp.vec3, device=device)

    vertices, triangles = body.mesh
    mesh = wp.Mesh(on_device(vertices), wp.array(triangles.ravel(), dtype=int, device=device))
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    thickness = np.full(len(triangles), np.inf)
    for u, v in _SAMPLES[: 1 if len(triangles) > _MANY_TRIANGLES else None]:
        begin = u * a + v * b + (1.0 - u - v) * c - 1e-6 * body.reach * normals
        found = wp.zeros(len(triangles), dtype=wp.float32, device=device)
        given = [on_device(begin), on_device(-normals), mesh.id, most, found]
        Launch(wall_kernel(), len(triangles), given, device).launch()
        thickness = np.minimum(thickness, found.numpy())
    body.__dict__["_walls"] = most, thickness
    return thickness


def thinnest(body: Tool, most: float) -> float:
    """How thick a tool is where it is thinnest [m]; of a mesh walls thinner than `most` [m] count."""
    whole = 2.0 * body.half_thickness
    return min(whole, float(wall_thickness(body, most).min())) if isinstance(body, MeshBody) else whole


def least_thickness(contact_distance: float, spacing: float) -> float:
    """Of a wall that holds soil with contact where it is, for a distance at which contact begins and a grid spacing
    [m]."""
    return max(0.0, 2.0 * (HOLDS * spacing - contact_distance))


def thickening(body: Tool, contact_distance: float, spacing: float) -> np.ndarray | None:
    """How far outside a mesh its surface has to be taken for thin walls to hold soil, at its vertices [m], shape (k,);
    None if nowhere.

    Soil is pushed back to the side that is nearer. So it goes through a wall as soon as it is pressed in to its middle.
    """
    if not isinstance(body, MeshBody):
        return None
    least = least_thickness(contact_distance, spacing)
    if least == 0.0:
        return None
    vertices, triangles = body.mesh
    missing = 0.5 * np.maximum(least - wall_thickness(body, least), 0.0)
    if not missing.any():
        return None
    found = np.zeros(len(vertices))
    np.maximum.at(found, triangles, missing[:, None])
    return found


def thin_walls(body: Tool, contact_distance: float, spacing: float) -> list[str]:
    """What a user should know of a tool's thin parts, with contact beginning at a distance on a grid [m]."""
    found, thickness = [], thinnest(body, 2.0 * spacing)
    if thickness < 1.999 * spacing:  # in single precision
        found.append(
            f"the tool's thinnest part is {1e3 * thickness:.3g} mm, {thickness / spacing:.2g} grid spacings; below 2 "
            "the soil on its two sides feels each other: use a smaller bed.spacing"
        )
    thicker = thickening(body, contact_distance, spacing)
    if thicker is not None:
        found.append(
            f"contact with the tool's thin walls begins up to {1e3 * thicker.max():.2g} mm further out, for soil not "
            f"to go through them; walls of {1e3 * least_thickness(contact_distance, spacing):.3g} mm need none"
        )
    return found
