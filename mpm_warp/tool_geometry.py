"""Distances of points from a tool's surface, and how thick the walls of a mesh are."""

from __future__ import annotations

import numpy as np
import warp as wp

from .bodies import MeshBody, Tool
from .kernels.signed_distance import distance_kernel, shape_data, wall_kernel
from .launch import Launch, find_device

HOLDS = 0.1
"""How far a wall's middle has to be beyond where contact begins for it to hold soil [grid spacings]
(experiments/stability/thin_walls.csv)."""
_SAMPLES = [(1 / 3, 1 / 3), *((u / 8, v / 8) for u in (1, 3, 6) for v in (1, 3, 6) if u + v < 8)]
"""Places in a triangle, as the shares of its first two corners."""
_MANY_TRIANGLES = 20_000
"""So many are small: one ray from each is enough."""


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
    `most` [m]: no other side that runs along with the triangle, as at edges that taper."""
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
