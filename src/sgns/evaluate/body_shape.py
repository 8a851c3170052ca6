"""What pictures of soil are drawn with: the body's shape, and a depth buffer for what is seen from above."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from mpm_warp import Box, Plate, Sphere
from mpm_warp.poses import in_world_frame
from sgns.model.features import is_wheel

CUBE = np.array(list(itertools.product((0.0, 1.0), repeat=3)))
"""Corners, shape (8, 3)."""
# A mesh of more triangles is drawn on a lattice: corners in the same one of so many cells of its longest side are one.
MOST_TRIANGLES = 20_000
CELLS = 64
ROUND_OR_SQUARE: dict[str, type[Box] | type[Sphere]] = {"sphere": Sphere, "box": Box}
FURTHER = ("#009e73", "#e69f00", "#cc79a7", "#56b4e9")
"""Colours of further bodies, of Okabe and Ito's palette as those of figures.py."""


class FurtherBody(NamedTuple):
    """One of scene.others, with what is asked here of a run about its own body."""

    scene: Mapping[str, Any]  # its entry in scene.others
    pose: np.ndarray
    force: np.ndarray
    torque: np.ndarray
    mesh: tuple[np.ndarray, np.ndarray] | None
    colour: str  # of its forces


def bodies(run: Any) -> list[Any]:
    """The run, which stands for its own body, and what stands for each of its further bodies likewise."""
    others, found = run.scene.get("others") or [], [run]
    for i, (one, mesh) in enumerate(zip(others, run.meshes[1:] if others else (), strict=False)):
        pose, force, torque = (values[:, i] for values in (run.other_pose, run.other_force, run.other_torque))
        found.append(FurtherBody(one, pose, force, torque, mesh, FURTHER[i % len(FURTHER)]))
    return found


def body_corners(run: Any, frame: int) -> np.ndarray:
    """Points [m] of the body at a frame, shape (k, 3), world frame.

    The corners of the scene's blade, points along the rims of its wheel or cylinder, the vertices of the mesh that the
    run holds, points of a sphere, else the recorded body points, the corners of a box. Of all but the mesh, the body is
    their convex hull and the `grousers`.
    """
    blade, drum, tool = run.scene.get("blade"), cylinder(run.scene), run.scene.get("tool")
    if drum:
        rim = np.insert(circle(float(drum["diameter"]), 64), 1, 0.5 * float(drum["width"]), axis=1)
        corners = np.concatenate([rim, rim * [1.0, -1.0, 1.0]])
    elif isinstance(blade, Mapping):
        sizes = {key: blade[key] for key in ("thickness", "width", "length", "edge") if key in blade}
        corners = Plate.from_dict(sizes).level_at(run.pose[0, 3:]).corners
    elif run.mesh is not None:
        corners = run.mesh[0]
    elif isinstance(tool, Mapping) and tool.get("shape") in ROUND_OR_SQUARE:
        corners = ROUND_OR_SQUARE[tool["shape"]].from_dict(tool).outline()
    else:
        return np.asarray(run.body_points[frame])
    return in_world_frame(run.pose[[frame]], corners)[0]


def cylinder(scene: Mapping[str, Any]) -> Mapping[str, Any]:
    """Where a scene has the sizes of its wheel or cylinder; empty without one."""
    if is_wheel(scene):
        return scene if "width" in scene else {}
    tool = scene.get("tool")
    return tool if isinstance(tool, Mapping) and tool.get("shape") == "cylinder" else {}


def grousers(run: Any, frame: int) -> np.ndarray:
    """Corners [m] of the grousers at a frame, shape (g, 8, 3), world frame: boxes from the axis to their tips."""
    drum = cylinder(run.scene)
    count = int(drum.get("grousers") or 0)
    if not count:
        return np.empty((0, 8, 3))
    tip = 0.5 * float(drum["diameter"]) + float(drum["grouser_height"])
    size = np.array([tip, drum["width"], drum["grouser_thickness"]], float)
    x, y, z = ((CUBE - [0.0, 0.5, 0.5]) * size).T  # of the first one, along the body's +x
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)[:, None]  # from +x towards +z
    c, s = np.cos(angle), np.sin(angle)
    bars = np.stack([c * x - s * z, np.broadcast_to(y, (count, 8)), s * x + c * z], axis=-1)
    return in_world_frame(run.pose[[frame]], bars.reshape(-1, 3))[0].reshape(bars.shape)


def body_triangles(run: Any, frame: int) -> np.ndarray:
    """Triangles that the body is made of at a frame [m], shape (t, 3, 3), world frame; none where there is no body."""
    corners = body_corners(run, frame)
    if is_mesh(run):
        return simpler(corners[run.mesh[1]])
    if not len(corners):
        return np.empty((0, 3, 3))
    return np.concatenate([hull_triangles(part) for part in (corners, *grousers(run, frame))])


def body_cut(run: Any, frame: int, y: float) -> np.ndarray:
    """The cut of a mesh with the plane at `y` [m] at a frame: its sides as x and z of two ends, shape (k, 2, 2).

    Their ends follow each other around the cut; there are none of a body that is no mesh.
    """
    if not is_mesh(run):
        return np.empty((0, 2, 2))
    corners = body_corners(run, frame)[run.mesh[1]]
    following = np.roll(corners, -1, axis=1)
    height, height_following = corners[..., 1] - y, following[..., 1] - y
    above, above_following = height >= 0.0, height_following >= 0.0
    ends = []
    for crossing in (above & ~above_following, ~above & above_following):  # one each per triangle that is cut
        share = height[crossing] / (height[crossing] - height_following[crossing])
        ends.append(corners[crossing] + share[:, None] * (following[crossing] - corners[crossing]))
    return np.stack(ends, axis=1)[..., [0, 2]]


def body_silhouette(run: Any, frame: int, axes: tuple[int, int] = (0, 2)) -> list[np.ndarray]:
    """Polygons (k, 2) [m] whose union is the body seen along the axis that is not in `axes`; from the side by default.

    The circle of the scene's wheel if that is not turned, the triangles of a mesh, else the hull of the body's corners;
    and the grousers.
    """
    bars = [hull(bar[:, axes]) for bar in grousers(run, frame)]
    if is_wheel(run.scene) and axes == (0, 2) and not run.scene.get("slip_angle"):
        return [run.pose[frame, [0, 2]] + circle(float(run.scene["diameter"]), 64), *bars]
    if is_mesh(run):
        seen = body_triangles(run, frame)[..., axes]
        first, second = seen[:, 1] - seen[:, 0], seen[:, 2] - seen[:, 0]
        facing = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0] > 0.0  # the far side covers the same
        return list(seen[facing])
    corners = body_corners(run, frame)
    return [hull(corners[:, axes]), *bars] if len(corners) else []


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


# --- A picture in which what is nearer hides the rest, in parallel projection ---------------------------


AZIMUTH, ELEVATION = np.radians([-60.0, 28.0])
"""Of the camera: about z, from +x towards +y, and above the horizon [rad]."""
TOWARD = np.array(
    [np.cos(ELEVATION) * np.cos(AZIMUTH), np.cos(ELEVATION) * np.sin(AZIMUTH), np.sin(ELEVATION)]
)
RIGHT = np.array([-np.sin(AZIMUTH), np.cos(AZIMUTH), 0.0])
CAMERA = np.stack([RIGHT, np.cross(TOWARD, RIGHT), TOWARD])
"""Unit vectors to the right, up and towards the camera, as rows, shape (3, 3)."""
# Where the light comes from, seen from the camera: right, up, towards it.
LIGHT = np.array([-0.35, 0.55, 0.76])


def project(points: np.ndarray) -> np.ndarray:
    """Points (..., 3) [m] as right, up and nearness [m], shape (..., 3)."""
    return np.asarray(points, dtype=np.float64) @ CAMERA.T


class DepthBuffer:
    """A picture that remembers how near each of its points is.

    Its lower left and upper right corner lie at `low` and `high`, right and up [m]; it has `width` columns.
    """

    def __init__(self, low: np.ndarray, high: np.ndarray, width: int) -> None:
        self.low = np.asarray(low, dtype=np.float64)
        self.pixel = float(high[0] - low[0]) / width
        """Edge of a picture point [m]."""
        height = max(1, round(float(high[1] - low[1]) / self.pixel))
        self.nearness = np.full((height, width), -np.inf)
        self.colour = np.ones((height, width, 3))

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, right, bottom and top [m]; row 0 is the bottom."""
        height, width = self.nearness.shape
        return (self.low[0], self.low[0] + width * self.pixel, self.low[1], self.low[1] + height * self.pixel)

    def spheres(self, centres: np.ndarray, radius: float, colours: np.ndarray) -> None:
        """Particles as shaded spheres of a radius [m].

        Their centres are right, up and nearness [m], their colours red, green and blue, shape (n, 3) each.
        """
        height, width = self.nearness.shape
        column, row = np.floor((centres[:, :2] - self.low) / self.pixel).astype(np.int64).T
        reach = max(1, int(np.ceil(radius / self.pixel)))
        for dy, dx in itertools.product(range(-reach, reach + 1), repeat=2):
            # The sphere's surface over this point: how far it bulges, and how it faces the light.
            x, y = dx * self.pixel / radius, dy * self.pixel / radius
            bulge = 1.0 - x * x - y * y
            if bulge < 0.0:
                continue
            normal = np.array([x, y, np.sqrt(bulge)])
            nearness = centres[:, 2] + radius * normal[2]
            i, j = row + dy, column + dx
            seen = np.flatnonzero((i >= 0) & (i < height) & (j >= 0) & (j < width))
            seen = seen[nearness[seen] > self.nearness[i[seen], j[seen]]]
            seen = seen[
                np.argsort(nearness[seen], kind="stable")
            ]  # where several meet, the nearest is written last
            self.nearness[i[seen], j[seen]] = nearness[seen]
            self.colour[i[seen], j[seen]] = brightness(normal) * colours[seen]

    def triangles(self, corners: np.ndarray, colour: np.ndarray) -> None:
        """Flat faces of one colour (3,); corners are right, up and nearness [m], shape (triangles, 3, 3)."""
        height, width = self.nearness.shape
        for triangle in corners:
            normal = np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0])
            length = float(np.linalg.norm(normal))
            place = (triangle[:, :2] - self.low) / self.pixel
            first = np.maximum(np.floor(place.min(axis=0)).astype(int), 0)
            last = np.minimum(np.ceil(place.max(axis=0)).astype(int), [width, height])
            edge_on = abs(normal[2]) < 1e-9 * max(length, 1e-12) or length == 0.0
            if edge_on or (last <= first).any():
                continue
            x, y = np.meshgrid(np.arange(first[0], last[0]) + 0.5, np.arange(first[1], last[1]) + 0.5)
            # Barycentric coordinates; what lies on a side shared by two triangles belongs to both.
            weights = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(np.c_[place, np.ones(3)])
            nearness = weights @ triangle[:, 2]
            window = np.s_[first[1] : last[1], first[0] : last[0]]
            seen = (weights >= -1e-9).all(axis=-1) & (nearness > self.nearness[window])
            self.nearness[window][seen] = nearness[seen]
            self.colour[window][seen] = brightness(normal * np.sign(normal[2]) / length) * np.asarray(colour)


def brightness(normal: np.ndarray) -> float:
    """Share of the light that a surface with this normal shows."""
    return 0.62 + 0.38 * max(0.0, float(normal @ LIGHT))
