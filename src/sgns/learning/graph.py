"""The graph the network sees: one node per mode, one or more for the body, and edges between them.

Shapes: B batch, V nodes, E edges, d history positions, r modes.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["EDGES", "Graph", "build_graph", "edge_indices"]

EDGES = ("complete", "star")


class Graph(NamedTuple):
    """A batch of graphs that share one set of edges.

    Attributes:
        nodes: Node features [1], shape (B, V, node features).
        edges: Edge features [1], shape (B, E, 3 or 4).
        edge_index: Sender and receiver of every edge, shape (2, E).
    """

    nodes: Tensor
    edges: Tensor
    edge_index: Tensor


def edge_indices(
    modes: int,
    body_nodes: int,
    edges: str = "complete",
    self_loops: bool = False,
    device: torch.device | str = "cpu",
) -> Tensor:
    """The edges between modes, which come first, and body nodes, receivers ascending.

    Args:
        modes: r.
        body_nodes: N.
        edges: "complete", every ordered pair of different nodes; "star", only those with one mode and one body node.
        self_loops: Whether every node has an edge to itself.
        device: Where the indices live.

    Returns:
        Senders in row 0 and receivers in row 1 (PyG's order), int64, shape (2, E).
    """
    index = torch.arange(modes + body_nodes, device=device)
    receiver, sender = torch.meshgrid(index, index, indexing="ij")
    keep = receiver != sender if edges == "complete" else (receiver < modes) != (sender < modes)
    if self_loops:
        keep = keep | (receiver == sender)
    return torch.stack([sender[keep], receiver[keep]])


def build_graph(
    mode_features: Tensor,
    body_features: Tensor,
    position: Tensor,
    edge_index: Tensor,
    edge_length: bool = True,
) -> Graph:
    """Put features on the nodes and edges.

    The narrower kind of node is padded with zeros so that one encoder serves both. An edge holds the sender's position
    relative to the receiver's, and its length.

    Args:
        mode_features: Of the modes [1], shape (B, r, any).
        body_features: Of the body nodes [1], shape (B, N, any).
        position: Of all nodes, modes first, in the unit of edges [1], shape (B, V, 3).
        edge_index: Senders and receivers, shape (2, E).
        edge_length: Whether edges hold their length.

    Returns:
        The graph with modes first and body nodes last.
    """
    width = max(mode_features.shape[-1], body_features.shape[-1])
    nodes = torch.cat(
        [
            torch.nn.functional.pad(part, (0, width - part.shape[-1]))
            for part in (mode_features, body_features)
        ],
        dim=-2,
    )
    sender, receiver = edge_index
    edges = position.index_select(-2, sender) - position.index_select(-2, receiver)
    if edge_length:
        edges = torch.cat([edges, torch.linalg.vector_norm(edges, dim=-1, keepdim=True)], dim=-1)
    return Graph(nodes, edges, edge_index)
