"""Sums along edges without an index equal those with one."""

from __future__ import annotations

import pytest
import torch

from sgns.learning.graph import edge_indices
from sgns.learning.pairs import CompletePairs, IndexedPairs, pairs_of


def inputs(v: int, e: int) -> list[torch.Tensor]:
    torch.manual_seed(0)
    return [torch.randn(2, rows, 3).double().requires_grad_() for rows in (e, v, v)]


def outcome(pairs, tensors) -> list[torch.Tensor]:
    spread = pairs.spread(tensors[0] * 1.0, *tensors[1:])
    summed = pairs.gather(spread.sin())
    return [spread, summed, *torch.autograd.grad(summed.square().sum(), tensors)]


@pytest.mark.parametrize("v", [2, 3, 6])
@pytest.mark.parametrize("self_loops", [False, True])
def test_broadcasting_is_indexing(v, self_loops) -> None:
    index = edge_indices(v - 1, 1, self_loops=self_loops)
    pairs = pairs_of(index, v)
    assert isinstance(pairs, CompletePairs) and pairs.degree == index.shape[1] // v
    tensors = inputs(v, index.shape[1])
    for a, b in zip(outcome(pairs, tensors), outcome(IndexedPairs(index, v), tensors), strict=True):
        torch.testing.assert_close(a, b)


def test_any_other_edges_are_indexed() -> None:
    whole = edge_indices(3, 1)
    for index in (whole.flip(1), whole.flip(0), whole[:, :-1], edge_indices(3, 1, "star")):
        assert isinstance(pairs_of(index, 4), IndexedPairs)
    # As many edges as a complete graph of five nodes would have.
    assert isinstance(pairs_of(edge_indices(4, 1).clamp(max=3), 5), IndexedPairs)


def test_edges_end_where_the_index_says() -> None:
    index = torch.tensor([[0, 1, 2, 0], [2, 2, 1, 1]])
    pairs = IndexedPairs(index, 4)
    edges, nodes = torch.arange(4.0)[None, :, None], torch.tensor([10.0, 20, 30, 40])[None, :, None]
    assert pairs.degree.flatten().tolist() == [0, 2, 2, 0]
    assert pairs.gather(edges).flatten().tolist() == [0, 5, 1, 0]
    assert pairs.spread(edges, nodes, -nodes).flatten().tolist() == [20, 11, -8, 13]


def test_one_node_alone() -> None:
    pairs = pairs_of(edge_indices(1, 0), 1)
    assert torch.equal(pairs.gather(torch.empty(2, 0, 3)), torch.zeros(2, 1, 3))


def test_a_graph_of_many_nodes_and_few_edges_needs_no_table_of_all_pairs() -> None:
    nodes = 3_000_000  # all their pairs would take 144 TB
    assert isinstance(pairs_of(torch.tensor([[0, 1], [2, 2]]), nodes), IndexedPairs)
