"""The whole bed in three dimensions with its tool."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize, to_rgb
from matplotlib.figure import Figure
from scipy.spatial import ConvexHull, QhullError

from sgns.evaluate.figures import DPI, PICTURE_WIDTH, TRUTH, new_figure, styled
from sgns.evaluate.metrics import particle_spacing
from sgns.evaluate.side_view import SPEED, STEEL, body_corners, draw_force, hull, nice

# --- Particles and a convex body in space, drawn into a depth buffer: what is nearer hides the rest -----
# Parallel projection, so that lengths along an axis are the same everywhere in the picture. Letters: n
# particles, k corners of the body, (h, w) rows and columns of the picture.

# Where the light comes from, seen from the camera: right, up, towards it.
LIGHT = np.array([-0.35, 0.55, 0.76])


@dataclass(frozen=True)
class Camera:
    """Direction of view."""

    azimuth: float = -60.0  # of the camera about z, from +x towards +y [degrees]
    elevation: float = 28.0  # of the camera above the horizon [degrees]

    @property
    def axes(self) -> np.ndarray:
        """Unit vectors to the right, up and towards the camera, as rows, shape (3, 3)."""
        a, e = np.radians([self.azimuth, self.elevation])
        toward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        right = np.array([-np.sin(a), np.cos(a), 0.0])
        return np.stack([right, np.cross(toward, right), toward])

    def project(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) [m] as right, up and nearness [m], shape (..., 3)."""
        return np.asarray(points, dtype=np.float64) @ self.axes.T


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
        reach = max(1, int(np.ceil(radius / self.pixel)))
        offsets = np.arange(-reach, reach + 1)
        column, row = (np.floor((centres[:, i] - self.low[i]) / self.pixel).astype(np.int64) for i in (0, 1))
        for dy, dx in itertools.product(offsets, offsets):
            # The sphere's surface over this point: how far it bulges, and how it faces the light.
            x, y = dx * self.pixel / radius, dy * self.pixel / radius
            bulge = 1.0 - x * x - y * y
            if bulge < 0.0:
                continue
            normal = np.array([x, y, np.sqrt(bulge)])
            shade = brightness(normal)
            self._put(row + dy, column + dx, centres[:, 2] + radius * normal[2], shade * colours)

    def _put(self, row: np.ndarray, column: np.ndarray, nearness: np.ndarray, colours: np.ndarray) -> None:
        """One point per particle (n,); where several meet, the nearest stays."""
        height, width = self.nearness.shape
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        row, column, nearness, colours = row[inside], column[inside], nearness[inside], colours[inside]
        seen = nearness > self.nearness[row, column]
        row, column, nearness, colours = row[seen], column[seen], nearness[seen], colours[seen]
        order = np.argsort(nearness, kind="stable")  # the last that is written stays
        self.nearness[row[order], column[order]] = nearness[order]
        self.colour[row[order], column[order]] = colours[order]

    def triangles(self, corners: np.ndarray, colour: np.ndarray) -> None:
        """Flat faces of one colour (3,); corners are right, up and nearness [m], shape (triangles, 3, 3)."""
        for triangle in corners:
            normal = np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0])
            length = float(np.linalg.norm(normal))
            if abs(normal[2]) < 1e-9 * max(length, 1e-12) or length == 0.0:
                continue  # seen edge-on
            normal = normal * np.sign(normal[2]) / length
            self._fill(triangle, brightness(normal) * np.asarray(colour))

    def _fill(self, triangle: np.ndarray, colour: np.ndarray) -> None:
        height, width = self.nearness.shape
        corners = (triangle[:, :2] - self.low) / self.pixel
        first = np.maximum(np.floor(corners.min(axis=0)).astype(int), 0)
        last = np.minimum(np.ceil(corners.max(axis=0)).astype(int), [width, height])
        if (last <= first).any():
            return
        x, y = np.meshgrid(np.arange(first[0], last[0]) + 0.5, np.arange(first[1], last[1]) + 0.5)
        # Barycentric coordinates; what lies on a side shared by two triangles belongs to both.
        weights = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(np.c_[corners, np.ones(3)])
        nearness = weights @ triangle[:, 2]
        window = np.s_[first[1] : last[1], first[0] : last[0]]
        seen = (weights >= -1e-9).all(axis=-1) & (nearness > self.nearness[window])
        self.nearness[window][seen] = nearness[seen]
        self.colour[window][seen] = colour


def brightness(normal: np.ndarray) -> float:
    """Share of the light that a surface with this normal shows."""
    return 0.62 + 0.38 * max(0.0, float(normal @ LIGHT))


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


# --- The whole bed with its tool: simulated, predicted, and their difference ---------------------------

# No error looks like the paper; the larger, the darker.
ERROR = LinearSegmentedColormap.from_list("error", ["#f2f2ee", "#9cc3dd", "#3d7fb1", "#22356f", "#0c0c26"])
# A force arrow of the larger force is this share of the picture's width long.
ARROW_SHARE = 0.25
# A tool is shown up to so much above the bed [m].
TOOL_ABOVE = 0.22


def solid_views(truth: Any, prediction: Any, frame: int, start: np.ndarray) -> Mapping[str, Figure]:
    """Three pictures of one moment: displacement, simulated and predicted, and the distance between them.

    `start` are the particles at rest [m], shape (n, 3).
    """
    true, predicted = (run.positions(slice(frame, frame + 1))[0] for run in (truth, prediction))
    moved, moved_predicted, error = (
        1e3 * np.linalg.norm(difference, axis=1)
        for difference in (true - start, predicted - start, predicted - true)
    )
    strongest = max(float(np.linalg.norm(run.force[frame])) for run in (truth, prediction))
    displacement = "displacement [mm]", ScalarMappable(upper_scale(moved), SPEED)
    distance = "distance from the simulated place [mm]", ScalarMappable(upper_scale(error), ERROR)
    return {
        title: solid_figure(
            f"{title}, t = {run.time[frame]:.2f} s", run, frame, positions, values, *colours, start, strongest
        )
        for title, run, positions, values, colours in (
            ("simulated (MPM)", truth, true, moved, displacement),
            ("network", prediction, predicted, moved_predicted, displacement),
            ("network, its error", prediction, predicted, error, distance),
        )
    }


def upper_scale(values: np.ndarray) -> Normalize:
    """From zero to about the largest of the values."""
    top = float(np.percentile(values, 99.5))
    return Normalize(0.0, nice(top) if top > 0.0 else 1.0)


@styled
def solid_figure(
    title: str,
    run: Any,
    frame: int,
    positions: np.ndarray,
    values: np.ndarray,
    label: str,
    colours: ScalarMappable,
    start: np.ndarray,
    strongest: float,
) -> Figure:
    """Particles (n, 3) [m] as spheres coloured by values (n,), and the body of a run with the force on it.

    The particles at rest, `start`, set the frame of the picture; the force `strongest` [N] has the longest arrow.
    """
    camera, spacing = Camera(), particle_spacing(start)
    low, high = start.min(axis=0) - spacing, start.max(axis=0) + spacing
    corners = body_corners(run, frame)
    high[2] = np.clip(corners[:, 2].max() + spacing, high[2], high[2] + TOOL_ABOVE)
    box = camera.project(
        np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), -1).reshape(-1, 3)
    )
    left_bottom, right_top = box[:, :2].min(axis=0), box[:, :2].max(axis=0)

    buffer = DepthBuffer(left_bottom, right_top, width=round(DPI * (PICTURE_WIDTH - 0.2)))
    buffer.spheres(camera.project(positions), 0.55 * spacing, colours.to_rgba(values)[:, :3])
    buffer.triangles(camera.project(hull_triangles(corners)), np.array(to_rgb(STEEL)))

    height, width = buffer.nearness.shape
    figure = new_figure(PICTURE_WIDTH, PICTURE_WIDTH * height / width + 0.95)
    axis = figure.subplots()
    axis.imshow(np.clip(buffer.colour, 0.0, 1.0), origin="lower", extent=buffer.extent)
    axis.set_axis_off()
    axis.set_title(title)
    draw_directions(axis, camera, left_bottom, right_top)
    if strongest > 0.0:
        scale = ARROW_SHARE * (right_top[0] - left_bottom[0]) / strongest
        foot = camera.project(run.pose[frame, :3])[:2]
        tip = foot + camera.project(run.force[frame])[:2] * scale
        draw_force(axis, run, run.force[frame], foot, tip, clip=False)
    bar = figure.colorbar(colours, ax=axis, location="bottom", shrink=0.9, aspect=40, pad=0.02)
    bar.set_label(label)
    return figure


def draw_directions(axis: Axes, camera: Camera, low: np.ndarray, high: np.ndarray) -> None:
    """The three axes in the lower left corner, as lines about a tenth of the picture's width long."""
    length = nice(0.07 * (high[0] - low[0]))
    ends = camera.project(length * np.eye(3))[:, :2]
    origin = low + np.array([0.02, 0.03]) * (high - low) - ends.min(axis=0, initial=0.0)
    for name, end in zip("xyz", ends, strict=True):
        axis.plot(*zip(origin, origin + end, strict=True), color=TRUTH, linewidth=1.2)
        axis.annotate(name, origin + 1.25 * end, fontsize=9, ha="center", va="center", annotation_clip=False)
    axis.annotate(
        f"{100.0 * length:g} cm",
        origin,
        xytext=(0, -4),
        textcoords="offset points",
        fontsize=8,
        ha="center",
        va="top",
    )
