"""The graph the network sees: one node per mode, one or more for the body, every ordered pair an edge.

Shapes: B batch, V nodes, E edges, d history positions, r modes.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["Graph", "build_graph", "complete_graph"]


class Graph(NamedTuple):
    """A batch of graphs that share one set of edges.

    Attributes:
        nodes: Node features [1], shape (B, V, node features).
        edges: Edge features [1], shape (B, E, 4).
        edge_index: Sender and receiver of every edge, shape (2, E).
    """

    nodes: Tensor
    edges: Tensor
    edge_index: Tensor


def complete_graph(node_count: int, device: torch.device | str = "cpu") -> Tensor:
    """Every ordered pair of different nodes, receivers ascending.

    Args:
        node_count: V.
        device: Where the indices live.

    Returns:
        Senders in row 0 and receivers in row 1 (PyG's order), int64, shape (2, V (V - 1)).
    """
    index = torch.arange(node_count, device=device)
    receiver, sender = torch.meshgrid(index, index, indexing="ij")
    keep = receiver != sender
    return torch.stack([sender[keep], receiver[keep]])


def build_graph(
    mode_position: Tensor,
    mode_velocity: Tensor,
    body_position: Tensor,
    body_features: Tensor,
    edge_index: Tensor,
) -> Graph:
    """Put normalised quantities on the nodes and edges.

    A mode node holds its absolute position and its d - 1 past velocities. The bed does not move with the
    tool, so positions are given as they are, not only as differences. A body node holds its own features
    (place, past motion and the motion into the next frame). The narrower kind is padded with zeros so that
    one encoder serves both. An edge holds the sender's position relative to the receiver's, and its length.

    Args:
        mode_position: Newest normalised positions of the modes [1], shape (B, r, 3).
        mode_velocity: Normalised velocities, oldest first [1], shape (B, d - 1, r, 3).
        body_position: Normalised position of the body nodes [1], shape (B, body nodes, 3).
        body_features: Normalised features of the body nodes [1], shape (B, body nodes, any).
        edge_index: Senders and receivers, shape (2, E).

    Returns:
        The graph with modes first and body nodes last.
    """
    mode_features = torch.cat([mode_position, mode_velocity.permute(0, 2, 1, 3).flatten(2)], dim=-1)
    width = max(mode_features.shape[-1], body_features.shape[-1])
    nodes = torch.cat(
        [
            torch.nn.functional.pad(part, (0, width - part.shape[-1]))
            for part in (mode_features, body_features)
        ],
        dim=-2,
    )
    position = torch.cat([mode_position, body_position], dim=-2)
    sender, receiver = edge_index
    relative = position.index_select(-2, sender) - position.index_select(-2, receiver)
    length = torch.linalg.vector_norm(relative, dim=-1, keepdim=True)
    return Graph(nodes, torch.cat([relative, length], dim=-1), edge_index)
