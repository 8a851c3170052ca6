"""Distances of points from a tool's surface, and how thick the walls of a mesh are."""

import numpy as np
import warp as wp

from .bodies import Tool
from .kernels.signed_distance import distance_kernel, shape_data
from .launch import Launch, find_device


def distances(body: Tool, points: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """Distances of points (n, 3) from a tool's surface, negative inside, both in the body frame [m]; shape (n,).

    Args:
        margin: the largest distance that is of interest [m]; points beyond it may be said to be far away.
    """
    device, real = find_device("cpu"), wp.float64
    shape, mesh = shape_data(body, real, margin, device)  # the mesh has to live as long as the launch
    found = wp.zeros(len(points), dtype=real, device=device)
    given: wp.array = wp.array(points, dtype=wp.types.vector(3, real), device=device)
    Launch(distance_kernel(body.surface), len(points), [given, shape, found], device).launch()
    del mesh
    return found.numpy()
