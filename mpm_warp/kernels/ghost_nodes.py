"""Ghost nodes: what lies across a mirror plane or a periodic seam.

Particles near such a plane write to nodes on its other side. Those ghost nodes are images of nodes on this side:
their momentum and mass are added to them (`fold`), and after the grid step they get the velocity back (`unfold`).
A node on a mirror plane is its own image.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from ..launch import Launch, SceneKernel

_REACH = 2  # layers of ghost nodes: one more than the splines of a particle on the plane reach


def mirror_layers(sum_of_indices: int) -> np.ndarray:
    """Ghost layers and their images, shape (m, 2), where layers j and `sum_of_indices` - j mirror each other."""
    first = (sum_of_indices + 1) // 2 - _REACH
    return np.array([(j, sum_of_indices - j) for j in range(first, sum_of_indices // 2 + 1)])


def periodic_layers(low: int, cells: int) -> np.ndarray:
    """Ghost layers and their images, shape (m, 2), where layers j and j + `cells` are the same and layer `low` is
    the first of the period."""
    before = [(low - j, low - j + cells) for j in range(1, _REACH + 1)]
    after = [(low + cells + j, low + j) for j in range(_REACH)]
    return np.array(before + after)


@cache
def ghost_kernels(real: type) -> SimpleNamespace:
    """Kernels `fold`, `unfold` (one thread per row of nodes across the plane) and `wrap` in precision `real`."""
    vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)
    vec4s, layers = wp.array(dtype=vec4), wp.array(dtype=wp.vec2i)

    @wp.func
    def node_of(row: int, layer: int, stride: int, extent: int):
        return (row // stride) * stride * extent + row % stride + layer * stride

    @SceneKernel
    def fold(row: int, nodes: vec4s, pairs: layers, sign: vec4, stride: int, extent: int):
        """Add ghost layers to their images; `sign` mirrors a node's momentum, `stride` and `extent` are the axis'."""
        for q in range(pairs.shape[0]):
            ghost = node_of(row, pairs[q][0], stride, extent)
            image = node_of(row, pairs[q][1], stride, extent)
            amount = wp.cw_mul(sign, nodes[ghost])
            nodes[image] = nodes[image] + amount
            if ghost != image:
                nodes[ghost] = vec4()

    @SceneKernel
    def unfold(row: int, velocity: vec4s, pairs: layers, sign: vec4, stride: int, extent: int):
        """Give ghost layers the velocity of their images."""
        for q in range(pairs.shape[0]):
            ghost = node_of(row, pairs[q][0], stride, extent)
            image = node_of(row, pairs[q][1], stride, extent)
            velocity[ghost] = wp.cw_mul(sign, velocity[image])

    @SceneKernel
    def wrap(p: int, x: wp.array(dtype=vec3), turns: wp.array(dtype=int), axis: int, length: real):
        """Bring particles back into 0 <= x < length along an axis and count the turns."""
        at = x[p]
        if at[axis] < real(0.0):
            at[axis] = at[axis] + length
            turns[p] = turns[p] - 1
            x[p] = at
        elif at[axis] >= length:
            at[axis] = at[axis] - length
            turns[p] = turns[p] + 1
            x[p] = at

    return SimpleNamespace(fold=fold, unfold=unfold, wrap=wrap)


class GhostNodes:
    """Launches that keep ghost nodes and their images in agreement.

    `layers` are those of an axis and their images, shape (m, 2). With `mirrored` the layers along y are mirror images;
    all others are one period apart.
    """

    def __init__(
        self, real: type, device: wp.Device, grid: Any, layers: dict[int, np.ndarray], mirrored: bool
    ) -> None:
        vec4 = wp.types.vector(4, real)
        self._kernels, self._device, self._axes = ghost_kernels(real), device, []
        for axis, pairs in layers.items():
            extent, stride = ((grid.nx, grid.ny * grid.nz), (grid.ny, grid.nz))[axis]
            sign = vec4(1.0, -1.0 if mirrored and axis == 1 else 1.0, 1.0, 1.0)
            rows = grid.nx * grid.ny * grid.nz // extent
            self._axes.append((rows, wp.array(pairs, dtype=wp.vec2i, device=device), sign, stride, extent))

    def fold(self, nodes: wp.array) -> list[Launch]:
        """Add ghost layers to their images."""
        return [Launch(self._kernels.fold, rows, [nodes, *axis], self._device) for rows, *axis in self._axes]

    def unfold(self, nodes: wp.array) -> list[Launch]:
        """Give ghost layers the values of their images."""
        axes = reversed(self._axes)
        return [Launch(self._kernels.unfold, rows, [nodes, *axis], self._device) for rows, *axis in axes]
