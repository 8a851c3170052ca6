"""The body of a recorded scene as points, triangles, and as it looks along an axis."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from mpm_warp.poses import in_world_frame
from sgns.model.features import is_wheel

CUBE = np.array(list(itertools.product((0.0, 1.0), repeat=3)))
"""Corners, shape (8, 3)."""
# A mesh of more triangles is drawn on a lattice: corners in the same one of so many cells of its longest side are one.
MOST_TRIANGLES = 20_000
CELLS = 64


def body_corners(run: Any, frame: int) -> np.ndarray:
    """Points [m] of the body at a frame, shape (k, 3), world frame.

    The corners of the scene's blade, points along the rims of its wheel, the vertices of the mesh that the run holds,
    else the recorded body points. Of all but the mesh, the body is their convex hull.
    """
    scene = run.scene
    blade = scene.get("blade")
    if is_wheel(scene) and "width" in scene:
        rim = np.insert(circle(float(scene["diameter"]), 24), 1, 0.5 * float(scene["width"]), axis=1)
        corners = np.concatenate([rim, rim * [1.0, -1.0, 1.0]])
    elif isinstance(blade, Mapping):
        corners = (CUBE - 0.5) * np.array([blade["thickness"], blade["width"], blade["length"]], float)
    elif run.mesh is not None:
        corners = run.mesh[0]
    else:
        return np.asarray(run.body_points[frame])
    return in_world_frame(run.pose[[frame]], corners)[0]


def body_triangles(run: Any, frame: int) -> np.ndarray:
    """Triangles that the body is made of at a frame [m], shape (t, 3, 3), world frame; none where there is no body."""
    corners = body_corners(run, frame)
    if is_mesh(run):
        return simpler(corners[run.mesh[1]])
    return hull_triangles(corners) if len(corners) else np.empty((0, 3, 3))


def body_silhouette(run: Any, frame: int, axes: tuple[int, int] = (0, 2)) -> list[np.ndarray]:
    """Polygons (k, 2) [m] whose union is the body seen along the axis that is not in `axes`; from the side by default.

    The circle of the scene's wheel, the triangles of a mesh, else the hull of the body's corners.
    """
    if is_wheel(run.scene) and axes == (0, 2):
        return [run.pose[frame, [0, 2]] + circle(float(run.scene["diameter"]), 64)]
    if is_mesh(run):
        seen = body_triangles(run, frame)[..., axes]
        first, second = seen[:, 1] - seen[:, 0], seen[:, 2] - seen[:, 0]
        facing = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0] > 0.0  # the far side covers the same
        return list(seen[facing])
    corners = body_corners(run, frame)
    return [hull(corners[:, axes])] if len(corners) else []


def is_mesh(run: Any) -> bool:
    """Whether the body is the mesh that the run holds."""
    scene = run.scene
    return not is_wheel(scene) and not isinstance(scene.get("blade"), Mapping) and run.mesh is not None


def simpler(triangles: np.ndarray) -> np.ndarray:
    """A mesh (t, 3, 3) of at most some ten thousand triangles that looks the same, to a hundredth of its size."""
    if len(triangles) <= MOST_TRIANGLES:
        return triangles
    low = triangles.min(axis=(0, 1))
    cell = float(np.ptp(triangles, axis=(0, 1)).max()) / CELLS
    place = np.round((triangles - low) / cell).astype(np.int64) @ [1, 2 * CELLS, 4 * CELLS**2]
    distinct = (place[:, 0] != place[:, 1]) & (place[:, 1] != place[:, 2]) & (place[:, 2] != place[:, 0])
    _, kept = np.unique(np.sort(place[distinct], axis=1), axis=0, return_index=True)
    return low + cell * np.round((triangles[distinct][kept] - low) / cell)


def circle(diameter: float, count: int) -> np.ndarray:
    """Points along a circle [m], shape (count, 2)."""
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    return 0.5 * diameter * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def hull(points: np.ndarray) -> np.ndarray:
    """Corners of the convex hull of points (k, 2), counter-clockwise; the two ends if they lie on a line."""
    try:
        return points[ConvexHull(points).vertices]
    except QhullError:
        return np.unique(np.round(points, 9), axis=0)[[0, -1]]


def hull_triangles(points: np.ndarray) -> np.ndarray:
    """Triangles that make up the convex hull of points (k, 3), shape (t, 3, 3).

    Of points in a plane they make up one face, of points on a line there are none.
    """
    try:
        return points[ConvexHull(points).simplices]
    except QhullError:
        middle = points.mean(axis=0)
        plane = np.linalg.svd(points - middle, full_matrices=False)[2][:2]
        ring = middle + hull((points - middle) @ plane.T) @ plane
        return np.stack([np.broadcast_to(ring[0], ring[2:].shape), ring[1:-1], ring[2:]], axis=1)
