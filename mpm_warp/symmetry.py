"""Mirror symmetry about the vertical plane at mid-width, y = Ly / 2.

Where a scene has it, the half with y >= Ly / 2 is computed and the whole is put together from it. Ghost nodes across
the plane are images of nodes on this side (images.py), so half and whole agree to round-off. Particles on the plane
are their own images: they come first and count half.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .errors import SceneError
from .scene import Scene

__all__ = ["Half", "asymmetry", "half", "require_symmetry"]

_SAME = 1e-6  # positions closer than this are the same [grid spacings]


@dataclass(frozen=True)
class Half:
    """The particles that are computed, and how the whole bed follows from them."""

    kept: np.ndarray
    """Indices into the whole bed of the particles that are computed, those on the plane first; shape (m,)."""
    on_plane: int
    """How many of them lie on the plane."""
    source: np.ndarray
    """Index into `kept` of each particle of the whole bed, shape (n,)."""
    mirrored: np.ndarray
    """Whether a particle of the whole bed is the image of its source, shape (n,), bool."""
    plane: float
    """y of the plane [m]."""

    def whole(self, position: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities (n, 3) of the whole bed from those of the particles computed (m, 3)."""
        position, velocity = position[self.source], velocity[self.source]
        position[self.mirrored, 1] = 2.0 * self.plane - position[self.mirrored, 1]
        velocity[self.mirrored, 1] *= -1.0
        return position, velocity


def asymmetry(scene: Scene) -> str | None:
    """Why a scene is not mirror symmetric about y = Ly / 2; None if it is."""
    if scene.bed.walls.y == "periodic":
        return "the bed is periodic in y (bed.walls.y)"
    if scene.body is not None:
        # A path may turn off the plane between two frames.
        path = getattr(scene, "path", None)
        times = np.concatenate([scene.times(), [row[0] for row in path or ()]])
        poses = scene.poses_at(times)
        off = np.abs(poses[:, 1] - 0.5 * scene.bed.size[1]) > _SAME * scene.bed.spacing
        if off.any():
            i = int(np.argmax(off))
            return f"the body is at y = {poses[i, 1]:.4f} m at {times[i]:.3f} s, not at mid-width"
        turned = np.abs(poses[:, [3, 5]]).max(axis=1) > 1e-9
        if turned.any():
            return f"at {times[int(np.argmax(turned))]:.3f} s the body is turned about another axis than y"
    if half(scene) is None:
        return (
            "the particles are not mirror images of each other (bed.arrangement); use bed.arrangement=lattice or "
            "bed.mirrored=true"
        )
    return None


def require_symmetry(scene: Scene) -> None:
    """Refuse a scene that is not mirror symmetric about y = Ly / 2.

    Raises:
        SceneError: with what is not symmetric.
    """
    if reason := asymmetry(scene):
        raise SceneError(
            f"effects.symmetry needs a scene that is mirror symmetric about mid-width: {reason}; or set "
            "effects.symmetry=false"
        )


def half(scene: Scene) -> Half | None:
    """The half of a scene's particles with y >= Ly / 2; None if the particles are not mirror symmetric."""
    positions = scene.initial_positions()
    plane = 0.5 * scene.bed.size[1]
    same = _SAME * scene.bed.spacing
    x, off, z = positions[:, 0], positions[:, 1] - plane, positions[:, 2]
    on = np.flatnonzero(np.abs(off) <= same)
    right, left = np.flatnonzero(off > same), np.flatnonzero(off < -same)
    if len(left) != len(right):
        return None
    # Both sides in the same order: partners agree in x and z to the bit, and differ in distance by round-off.
    by_place = [side[np.lexsort((np.abs(off[side]), z[side], x[side]))] for side in (right, left)]
    one, other = (np.stack([x[side], np.abs(off[side]), z[side]]) for side in by_place)
    if np.abs(one - other).max(initial=0.0) > same:
        return None
    kept = np.concatenate([on, right])
    source = np.empty(len(positions), dtype=np.int64)
    source[kept] = np.arange(len(kept))
    source[by_place[1]] = source[by_place[0]]
    return Half(kept, len(on), source, off < -same, plane)
