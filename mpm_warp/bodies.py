"""Rigid bodies that touch the soil."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .errors import SceneError

__all__ = ["Plate"]


@dataclass(frozen=True)
class Plate:
    """A blade: a box centred on its centre of mass.

    Body frame: x through the thickness (front face at +x), y along the width, z along the length (tip at -z).
    """

    length: float = 0.305
    """Along the blade, tip to top [m]."""
    width: float = 0.457
    """Across the direction of travel [m]."""
    thickness: float = 0.028
    """[m]; about 2 to 3 grid spacings are needed to keep the soil on its two sides apart."""
    friction: float = 0.3
    """Coulomb friction between soil and blade [-]."""

    def __post_init__(self) -> None:
        for name in ("length", "width", "thickness"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise SceneError(f"blade.{name} is {getattr(self, name)}; it must be above 0 m")
        if not self.friction >= 0:
            raise SceneError(f"blade.friction is {self.friction}; it must be 0 or more")

    @property
    def half_size(self) -> np.ndarray:
        """Half the thickness, width and length [m], shape (3,)."""
        return 0.5 * np.array([self.thickness, self.width, self.length])

    @property
    def tip(self) -> np.ndarray:
        """Middle of the bottom face in the body frame [m], shape (3,)."""
        return np.array([0.0, 0.0, -0.5 * self.length])

    @property
    def corners(self) -> np.ndarray:
        """The eight corners in the body frame [m], shape (8, 3)."""
        signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        return signs * self.half_size

    def points(self, rows: int = 3, columns: int = 5) -> np.ndarray:
        """Body nodes: rows x columns points on the front face in the body frame [m], shape (M, 3)."""
        hx, hy, hz = self.half_size
        z, y = np.meshgrid(np.linspace(-hz, hz, rows), np.linspace(-hy, hy, columns), indexing="ij")
        return np.stack([np.full(rows * columns, hx), y.ravel(), z.ravel()], axis=-1)
