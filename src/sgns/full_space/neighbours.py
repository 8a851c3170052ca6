"""Which points are near each other: the edges of a graph in full space, found with Warp's hash grid.

Shapes: V points, E edges.
"""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from mpm_warp.start import start_warp
from sgns.errors import UserError

__all__ = ["radius_graph"]

# Cells per axis of the hash grid; what lies outside wraps around and is told apart by its distance.
_CELLS = 64


@wp.kernel(enable_backward=False)
def count_neighbours(
    grid: wp.uint64, points: wp.array(dtype=wp.vec3), radius: float, counts: wp.array(dtype=wp.int64)
):
    receiver = wp.tid()
    centre = points[receiver]
    query = wp.hash_grid_query(grid, centre, radius)
    sender = wp.int32(0)
    count = wp.int64(0)
    while wp.hash_grid_query_next(query, sender):
        offset = points[sender] - centre
        if sender != receiver and wp.dot(offset, offset) <= radius * radius:
            count += wp.int64(1)
    counts[receiver] = count


@wp.kernel(enable_backward=False)
def list_neighbours(
    grid: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    radius: float,
    ends: wp.array(dtype=wp.int64),
    senders: wp.array(dtype=wp.int64),
    receivers: wp.array(dtype=wp.int64),
):
    receiver = wp.tid()
    centre = points[receiver]
    place = wp.int64(0)
    if receiver > 0:
        place = ends[receiver - 1]
    query = wp.hash_grid_query(grid, centre, radius)
    sender = wp.int32(0)
    while wp.hash_grid_query_next(query, sender):
        offset = points[sender] - centre
        if sender != receiver and wp.dot(offset, offset) <= radius * radius:
            senders[place] = wp.int64(sender)
            receivers[place] = wp.int64(receiver)
            place += wp.int64(1)


def radius_graph(points: Tensor, radius: float) -> Tensor:
    """Every ordered pair of different points no further apart than a radius, receivers ascending.

    Distances are taken in float32 on the device of the points.

    Args:
        points: Positions [m], shape (V, 3).
        radius: [m].

    Returns:
        Senders in row 0 and receivers in row 1, int64, shape (2, E).

    Raises:
        UserError: The radius is not positive, or a position is not finite.
    """
    if not radius > 0:
        raise UserError(f"the radius of the neighbours is {radius}; it must be above 0 m")
    if not bool(torch.isfinite(points).all()):
        raise UserError(
            "positions are not finite, so they have no neighbours; the rollout ran away or the run is damaged"
        )
    if len(points) == 0:
        return torch.empty((2, 0), dtype=torch.int64, device=points.device)
    where = points.detach().float().contiguous()
    start_warp()
    # torch's stream, so that neither library reads what the other has not finished.
    stream = wp.stream_from_torch(where.device) if where.is_cuda else None
    with wp.ScopedDevice(wp.device_from_torch(where.device)), wp.ScopedStream(stream):
        array = wp.from_torch(where, dtype=wp.vec3)
        grid = wp.HashGrid(_CELLS, _CELLS, _CELLS)
        grid.build(array, radius)
        counts = torch.empty(len(where), dtype=torch.int64, device=where.device)
        wp.launch(count_neighbours, len(where), [grid.id, array, radius], [wp.from_torch(counts)])
        ends = counts.cumsum(0)
        edges = torch.empty((2, int(ends[-1])), dtype=torch.int64, device=where.device)
        if edges.shape[1]:
            out = [wp.from_torch(row) for row in edges]
            wp.launch(list_neighbours, len(where), [grid.id, array, radius, wp.from_torch(ends)], out)
    return edges
