"""Particles and flat faces drawn into a depth buffer: what is nearer hides the rest.

Parallel projection, so that lengths along an axis are the same everywhere in the picture.
"""

from __future__ import annotations

import itertools

import numpy as np

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
