"""A column of soil that is let go and collapses under its own weight."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .errors import SceneError
from .scene import Scene

__all__ = ["Column"]

SHAPES = ("cylinder", "slab")


@dataclass(frozen=True)
class Column(Scene):
    """Soil stands in the middle of the floor and is let go at time 0; the bed's Lz is its height."""

    name: str = "column"
    kind: str = "column"
    shape: str = "cylinder"
    """cylinder, or slab: all of the bin's width, for a channel."""
    radius: float = 0.05
    """Of the cylinder, or half the slab's length along x [m]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.shape not in SHAPES:
            raise SceneError(f"scene.shape is {self.shape!r}; allowed: {', '.join(SHAPES)}")
        room = 0.5 * min(self.bed.size[: 2 if self.shape == "cylinder" else 1])
        if not 2.0 * self.bed.spacing <= self.radius <= room:
            raise SceneError(
                f"scene.radius is {self.radius} m; allowed: two grid spacings ({2.0 * self.bed.spacing:g} m) up to "
                f"half the bin ({room:g} m)"
            )

    @property
    def aspect_ratio(self) -> float:
        """Height over radius [-]."""
        return self.bed.size[2] / self.radius

    @cached_property
    def filled(self) -> tuple[np.ndarray, float]:
        positions, volume = self.bed.filled
        off = positions[:, :2] - 0.5 * np.asarray(self.bed.size[:2])
        distance = np.abs(off[:, 0]) if self.shape == "slab" else np.hypot(off[:, 0], off[:, 1])
        return positions[distance <= self.radius], volume

    @property
    def soil_volume(self) -> float:
        _, width, height = self.bed.size
        across = math.pi * self.radius**2 if self.shape == "cylinder" else 2.0 * self.radius * width
        return across * height

    @property
    def arrangement_hash(self) -> str:
        key = [self.bed.arrangement_hash, self.shape, self.radius]
        return hashlib.blake2b(json.dumps(key).encode(), digest_size=8).hexdigest()
