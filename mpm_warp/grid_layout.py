"""Where the grid lies: its nodes, walls and ghost layers for a scene."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp

from .grid import grid_struct
from .images import mirror_pairs, seam_pairs
from .scene import PADDING, Scene

__all__ = ["lay_grid"]


def lay_grid(
    scene: Scene, real: type, time_step: float, particle_volume: float, symmetric: bool
) -> tuple[Any, dict[int, np.ndarray]]:
    """The grid's struct, and for each axis that has ghost layers these and their images (images.py).

    Walls fall on nodes where the bin is a whole number of cells; otherwise the grid is centred in x and y, which
    keeps the scene's mirror symmetry, and the nodes just outside the bin are the walls. With `symmetric` the grid
    ends two layers beyond the plane y = Ly / 2.
    """
    bed, vec3 = scene.bed, wp.types.vector(3, real)
    h = bed.spacing
    cells = [math.ceil(s / h - 1e-6) for s in bed.size[:2]]
    origin = [0.5 * (s - c * h) - PADDING * h for s, c in zip(bed.size[:2], cells, strict=True)]
    origin.append(-bed.size[2] - PADDING * h)
    count = list(bed.node_counts)
    low = [PADDING, PADDING, PADDING]
    high = [PADDING + cells[0], PADDING + cells[1], 2**30]
    ghosts = {}
    for axis in (0, 1):
        if bed.walls.kinds[axis] == "periodic":
            ghosts[axis] = seam_pairs(PADDING, cells[axis])
            low[axis], high[axis] = -1, 2**30  # no walls
    if symmetric:
        ghosts[1] = mirror_pairs(2 * PADDING + cells[1])
        left_out = ghosts[1].min()
        ghosts[1] -= left_out
        origin[1] += left_out * h
        count[1] -= left_out
        low[1], high[1] = -1, high[1] - left_out

    grid = grid_struct(real)()
    grid.origin = vec3(*origin)
    grid.spacing, grid.inverse_spacing = h, 1.0 / h
    grid.nx, grid.ny, grid.nz = (int(c) for c in count)
    grid.dt, grid.gravity = time_step, vec3(*scene.gravity_vector)
    grid.volume_averaging = scene.volume_averaging
    grid.forgetting = min(1.0, time_step * scene.material.wave_speed / h)
    grid.damping = scene.elastic_damping * h / scene.material.wave_speed / time_step
    grid.low, grid.high = wp.vec3i(*low), wp.vec3i(*(int(i) for i in high))
    grid.wall_friction = vec3(*bed.walls.friction)
    grid.particle_volume = particle_volume
    grid.particle_mass = particle_volume * scene.material.bulk_density
    grid.density_per_mass = 1.0 / (scene.material.bulk_density * h**3 * bed.filling)
    behind = [round(0.5 * (c - s / h), 6) for s, c in zip(bed.size[:2], cells, strict=True)]
    grid.beyond_walls = vec3(*(1.0 / _part_in_bin(distance) for distance in (*behind, 0.0)))
    grid.speed_limit = h / time_step
    return grid, ghosts


def _part_in_bin(distance: float) -> float:
    """How much of a node's spline (splines.py) lies in the bin, for a node 0 to 0.5 cells outside of it [-]."""
    return 0.5 - 0.75 * distance + distance**3 / 3.0
