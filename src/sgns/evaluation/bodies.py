"""The body of a recorded scene: its kind, its corners, and how its force is reported.

Scenes are plain data of a run file, of any kind.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sgns.poses import in_world_frame

__all__ = ["body_corners", "forward_force", "is_wheel", "sinkage"]


def is_wheel(scene: Mapping[str, Any]) -> bool:
    """Whether the body is a wheel."""
    return "diameter" in scene


def forward_force(scene: Mapping[str, Any]) -> tuple[str, float]:
    """Name of the forward force and the sign that F_x is reported with."""
    return ("drawbar pull Fx", 1.0) if is_wheel(scene) else ("draft −Fx", -1.0)


def sinkage(scene: Mapping[str, Any], poses: np.ndarray) -> np.ndarray:
    """Depth of a wheel's lowest point below the undisturbed surface [m], shape (T,) for poses (T, 7)."""
    return 0.5 * float(scene["diameter"]) + float(scene.get("grouser_height", 0.0)) - poses[:, 2]


def body_corners(run: Any, frame: int) -> np.ndarray:
    """Points [m] whose convex hull is the body at a frame, shape (k, 3), world frame.

    The corners of the scene's blade, points along the rims of its wheel, the vertices of the mesh that the run holds,
    else the recorded body points.
    """
    scene = run.scene
    blade = scene.get("blade")
    if is_wheel(scene) and "width" in scene:
        angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
        radius, half_width = 0.5 * float(scene["diameter"]), 0.5 * float(scene["width"])
        rim = np.stack([radius * np.cos(angle), np.full(24, half_width), radius * np.sin(angle)], axis=-1)
        corners = np.concatenate([rim, rim * [1.0, -1.0, 1.0]])
    elif isinstance(blade, Mapping):
        half = 0.5 * np.array([blade["thickness"], blade["width"], blade["length"]], dtype=np.float64)
        corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3) * half
    elif run.mesh is not None:
        corners = run.mesh[0]
    else:
        return np.asarray(run.body_points[frame])
    return in_world_frame(run.pose[[frame]], corners)[0]
