"""The graph: which edges, and what is written on nodes and edges."""

from __future__ import annotations

import torch

from sgns.learning.graph import build_graph, complete_graph


def test_every_ordered_pair_of_different_nodes_is_an_edge_once() -> None:
    edges = complete_graph(5).T.tolist()
    assert len(edges) == 20
    assert {(s, r) for s, r in edges} == {(s, r) for s in range(5) for r in range(5) if s != r}


def test_one_node_has_no_edges() -> None:
    assert complete_graph(1).shape == (2, 0)


def test_features_are_where_they_belong() -> None:
    torch.manual_seed(0)
    position, velocity = torch.randn(2, 3, 3), torch.randn(2, 4, 3, 3)
    body_position, body_features = torch.randn(2, 1, 3), torch.randn(2, 1, 20)
    graph = build_graph(position, velocity, body_position, body_features, complete_graph(4))
    assert graph.nodes.shape == (2, 4, 20)
    assert torch.equal(graph.nodes[1, 2, :3], position[1, 2])
    # Velocities oldest first, x y z together.
    assert torch.equal(graph.nodes[1, 2, 6:9], velocity[1, 1, 2])
    assert torch.equal(graph.nodes[:, :3, 15:], torch.zeros(2, 3, 5))
    assert torch.equal(graph.nodes[:, 3:], body_features)
    everything = torch.cat([position, body_position], dim=1)
    for e, (sender, receiver) in enumerate(graph.edge_index.T.tolist()):
        difference = everything[:, sender] - everything[:, receiver]
        torch.testing.assert_close(graph.edges[:, e, :3], difference)
        torch.testing.assert_close(graph.edges[:, e, 3], difference.norm(dim=-1))
