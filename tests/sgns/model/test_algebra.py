"""Both matrix libraries give the same linear layer and the same gradients."""

from __future__ import annotations

import time

import pytest
import torch

from sgns.model import algebra as module
from sgns.model.algebra import CompletePairs, IndexedPairs, affine, pairs_of
from sgns.model.features import edge_indices

# --- Both matrix libraries give the same linear layer and the same gradients ----------------------------


def outcome(shape: tuple[int, ...], relu: bool) -> list[torch.Tensor]:
    torch.manual_seed(0)
    tensors = [torch.randn(*shape, 40), torch.randn(60, 40), torch.randn(60)]
    for tensor in tensors:
        tensor.requires_grad_()
    y = affine(*tensors, relu=relu)
    return [y.detach(), *torch.autograd.grad(y.sin().sum(), tensors)]


@pytest.mark.parametrize("relu", [False, True])
@pytest.mark.parametrize("shape", [(7,), (2, 3, 5), (5000,)])
def test_onednn_is_the_linear_layer(shape, relu, monkeypatch) -> None:
    if not torch.backends.mkldnn.is_available():
        pytest.skip("torch was built without oneDNN")
    monkeypatch.setattr(module, "_WORTH_IT", 2**60)
    expected = outcome(shape, relu)
    monkeypatch.setattr(module, "_WORTH_IT", 0)
    assert module.prefers_onednn(torch.empty(*shape, 40), torch.empty(60, 40))
    for a, b in zip(outcome(shape, relu), expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-5 * float(b.abs().max()))


def test_without_gradients_it_is_the_same() -> None:
    x, weight, bias = torch.randn(700, 128), torch.randn(128, 128), torch.randn(128)
    with torch.inference_mode():
        found = affine(x, weight, bias, relu=True)
    expected = torch.nn.functional.linear(x.double(), weight.double(), bias.double()).relu()
    torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=1e-4)


def test_double_precision_stays_double() -> None:
    assert not module.prefers_onednn(torch.empty(5000, 128).double(), torch.empty(128, 128).double())
    y = affine(torch.ones(5000, 128).double(), torch.ones(128, 128).double() / 3, torch.zeros(128).double())
    torch.testing.assert_close(y, torch.full_like(y, 128 / 3), rtol=1e-14, atol=0.0)


def test_a_part_of_a_matrix_is_no_slower() -> None:
    x, whole, bias = torch.randn(1568, 128), torch.randn(128, 384), torch.randn(128)

    def seconds(weight: torch.Tensor) -> float:
        best = float("inf")
        for _ in range(5):
            began = time.perf_counter()
            affine(x, weight, bias)
            best = min(best, time.perf_counter() - began)
        return best

    # Taken as it lies in memory it was a thousand times slower.
    assert seconds(whole[:, :128]) < 20 * seconds(whole[:, :128].contiguous())


# --- Sums along edges without an index equal those with one ---------------------------------------------


def inputs(v: int, e: int) -> list[torch.Tensor]:
    torch.manual_seed(0)
    return [torch.randn(2, rows, 3).double().requires_grad_() for rows in (e, v, v)]


def outcome_of_pairs(pairs, tensors) -> list[torch.Tensor]:
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
    for a, b in zip(
        outcome_of_pairs(pairs, tensors), outcome_of_pairs(IndexedPairs(index, v), tensors), strict=True
    ):
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
