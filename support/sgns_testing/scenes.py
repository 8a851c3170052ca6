"""Beds and scenes for the solver's tests."""

from dataclasses import dataclass

import numpy as np

from mpm_warp import Bed, Excavation, Plate, Scene


@dataclass(frozen=True)
class BlockBed(Bed):
    """Only the particles within a box: a block of soil that touches nothing."""

    low: tuple[float, float, float] = (0.1, 0.1, -0.2)
    high: tuple[float, float, float] = (0.2, 0.2, -0.1)

    @property
    def filled(self):
        positions, volume = Bed.filled.func(self)
        inside = np.all((positions > self.low) & (positions < self.high), axis=1)
        return positions[inside], volume


def block(gravity: float = 0.0, duration: float = 0.05, frame_rate: float = 200.0, **kw) -> Scene:
    """A block of 10^3 particles in the middle of a bin, 1 cm grid."""
    bed = BlockBed(size=(0.3, 0.3, 0.3), spacing=0.01, initial_stress="none", headroom=0.1)
    return Scene(bed=bed, gravity=gravity, duration=duration, frame_rate=frame_rate, **kw)


UNDAMPED = {"friction_angle": None, "damping": 0.0}
"""Of a wheel that falls freely, on soil with the material's own friction."""


def cut(**kw) -> Excavation:
    """A small, fast excavation: 4 800 particles on a 2 cm grid, whose square end meets soil at once."""
    values = {
        "bed": Bed(size=(0.48, 0.4, 0.16), spacing=0.02, headroom=0.12),
        "blade": Plate(length=0.2, width=0.193, thickness=0.044, edge="square"),
        "contact_margin": -0.25,
        "duration": 0.2,
        "depth": 0.06,
        "speed": 0.2,
        "start": 0.2,
    }
    return Excavation(**(values | kw))
