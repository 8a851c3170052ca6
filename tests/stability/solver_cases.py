"""Hard cases of the solver."""

from __future__ import annotations

import numpy as np
from beds import block
from case import Case

from mpm_warp import Solver


def free_fall_in_nothing() -> float:
    """Drift of a block of soil that nothing acts on, after 0.5 s."""
    scene = block(gravity=0.0, duration=0.5, frame_rate=20.0)
    *_, last = Solver(scene).frames()
    return 1000.0 * float(np.abs(last.position - scene.initial_positions()).max())


CASES = [
    Case(
        name="zero gravity, nothing touches",
        hard="every stress and every velocity is exactly zero",
        must="soil that nothing acts on stays where it is",
        quantity="largest displacement after 0.5 s",
        limit=1e-3,
        unit="mm",
        measure=free_fall_in_nothing,
        quick=True,
    ),
]
