"""The graph: which edges, and what is written on nodes and edges."""

from __future__ import annotations

import pytest
import torch

from sgns.learning.graph import build_graph, edge_indices


def test_every_ordered_pair_of_different_nodes_is_an_edge_once() -> None:
    edges = edge_indices(4, 1).T.tolist()
    assert len(edges) == 20
    assert {(s, r) for s, r in edges} == {(s, r) for s in range(5) for r in range(5) if s != r}


def test_a_star_joins_modes_and_body_only() -> None:
    edges = edge_indices(3, 2, "star").T.tolist()
    assert len(edges) == 12
    assert all((s < 3) != (r < 3) for s, r in edges)


@pytest.mark.parametrize("edges", ["complete", "star"])
def test_self_loops_are_added_and_receivers_ascend(edges) -> None:
    without, loops = edge_indices(3, 2, edges), edge_indices(3, 2, edges, self_loops=True)
    assert loops.shape[1] == without.shape[1] + 5
    assert {(s, r) for s, r in loops.T.tolist() if s == r} == {(v, v) for v in range(5)}
    assert loops[1].diff().min() >= 0


def test_one_node_has_no_edges() -> None:
    assert edge_indices(1, 0).shape == (2, 0)


def test_features_are_where_they_belong() -> None:
    torch.manual_seed(0)
    mode_features, body_features, position = (
        torch.randn(2, 3, 15),
        torch.randn(2, 1, 20),
        torch.randn(2, 4, 3),
    )
    graph = build_graph(mode_features, body_features, position, edge_indices(3, 1))
    assert graph.nodes.shape == (2, 4, 20)
    assert torch.equal(graph.nodes[:, :3, :15], mode_features)
    assert torch.equal(graph.nodes[:, :3, 15:], torch.zeros(2, 3, 5))
    assert torch.equal(graph.nodes[:, 3:], body_features)
    for e, (sender, receiver) in enumerate(graph.edge_index.T.tolist()):
        difference = position[:, sender] - position[:, receiver]
        torch.testing.assert_close(graph.edges[:, e, :3], difference)
        torch.testing.assert_close(graph.edges[:, e, 3], difference.norm(dim=-1))
    bare = build_graph(mode_features, body_features, position, edge_indices(3, 1), edge_length=False)
    assert torch.equal(bare.edges, graph.edges[..., :3])
