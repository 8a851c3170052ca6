"""Hand-written algebra against its definition: linear layers, sums along edges, one graph at a time."""

from __future__ import annotations

import time

import pytest
import torch

from sgns.model import network as module
from sgns.model.fast_step import GraphStepper
from sgns.model.features import edge_indices
from sgns.model.network import CompleteAdjacency, EncodeProcessDecode, IndexedAdjacency, adjacency_of, affine

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


def outcome_of_sums(adjacency, tensors) -> list[torch.Tensor]:
    spread = adjacency.spread(tensors[0] * 1.0, *tensors[1:])
    summed = adjacency.gather(spread.sin())
    return [spread, summed, *torch.autograd.grad(summed.square().sum(), tensors)]


@pytest.mark.parametrize("v", [2, 3, 6])
@pytest.mark.parametrize("self_loops", [False, True])
def test_broadcasting_is_indexing(v, self_loops) -> None:
    index = edge_indices(v - 1, 1, self_loops=self_loops)
    adjacency = adjacency_of(index, v)
    assert isinstance(adjacency, CompleteAdjacency) and adjacency.degree == index.shape[1] // v
    tensors = inputs(v, index.shape[1])
    for a, b in zip(
        outcome_of_sums(adjacency, tensors), outcome_of_sums(IndexedAdjacency(index, v), tensors), strict=True
    ):
        torch.testing.assert_close(a, b)


def test_any_other_edges_are_indexed() -> None:
    whole = edge_indices(3, 1)
    for index in (whole.flip(1), whole.flip(0), whole[:, :-1], edge_indices(3, 1, "star")):
        assert isinstance(adjacency_of(index, 4), IndexedAdjacency)
    # As many edges as a complete graph of five nodes would have.
    assert isinstance(adjacency_of(edge_indices(4, 1).clamp(max=3), 5), IndexedAdjacency)


def test_edges_end_where_the_index_says() -> None:
    index = torch.tensor([[0, 1, 2, 0], [2, 2, 1, 1]])
    adjacency = IndexedAdjacency(index, 4)
    edges, nodes = torch.arange(4.0)[None, :, None], torch.tensor([10.0, 20, 30, 40])[None, :, None]
    assert adjacency.degree.flatten().tolist() == [0, 2, 2, 0]
    assert adjacency.gather(edges).flatten().tolist() == [0, 5, 1, 0]
    assert adjacency.spread(edges, nodes, -nodes).flatten().tolist() == [20, 11, -8, 13]


def test_one_node_alone() -> None:
    adjacency = adjacency_of(edge_indices(1, 0), 1)
    assert torch.equal(adjacency.gather(torch.empty(2, 0, 3)), torch.zeros(2, 1, 3))


def test_a_graph_of_many_nodes_and_few_edges_needs_no_table_of_all_pairs() -> None:
    nodes = 3_000_000  # all their pairs would take 144 TB
    assert isinstance(adjacency_of(torch.tensor([[0, 1], [2, 2]]), nodes), IndexedAdjacency)


# --- The stepper of one graph against the network's definition ----------------------------------------------

MODES, BODY = 3, 4
EDGES = {
    "complete": edge_indices(MODES, BODY),
    "self_loops": edge_indices(MODES, BODY, self_loops=True),
    "star": edge_indices(MODES, BODY, "star"),
}


def prepared(index, hidden_layers: int = 2, activation: str = "relu"):
    torch.manual_seed(1)
    network = EncodeProcessDecode(6, 4, 9, 16, hidden_layers, activation=activation)
    network = network.double().requires_grad_(False)
    inputs = torch.randn(MODES + BODY, 6).double(), torch.randn(index.shape[1], 4).double()
    return network, GraphStepper(network, index, MODES + BODY, BODY), *inputs


@pytest.mark.parametrize("edges", EDGES)
@pytest.mark.parametrize("activation", ["relu", "tanh"])
@pytest.mark.parametrize("hidden_layers", [1, 2, 3])
def test_it_is_the_network(hidden_layers, activation, edges) -> None:
    index = EDGES[edges]
    network, stepper, nodes, features = prepared(index, hidden_layers, activation)
    assert GraphStepper.covers(network)
    for _ in range(2):
        expected = network.plain(nodes, features, index)
        torch.testing.assert_close(stepper(nodes, features), expected, rtol=1e-10, atol=1e-12)
        nodes, features = nodes + 0.3, features - 0.2


@pytest.mark.parametrize("edges", EDGES)
def test_edges_within_the_body_are_kept_while_they_are_the_same(edges) -> None:
    index = EDGES[edges]
    network, stepper, nodes, features = prepared(index)
    # Asked to keep before there is anything to keep.
    expected = network.plain(nodes, features, index)
    torch.testing.assert_close(stepper(nodes, features, same_body=True), expected, rtol=1e-10, atol=1e-12)
    within = (index >= MODES).all(0)
    changed = torch.where(within[:, None], features, features + 1.0)
    expected = network.plain(nodes, changed, index)
    for same_body in (True, False, True):
        found = stepper(nodes, changed, same_body)
        torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-12)


def test_what_is_kept_is_not_computed_again() -> None:
    _, stepper, nodes, features = prepared(EDGES["complete"])
    within = (EDGES["complete"] >= MODES).all(0)
    moved = torch.where(within[:, None], features + 1.0, features)
    before = stepper(nodes, features).clone()
    torch.testing.assert_close(stepper(nodes, moved, same_body=True), before)
    assert not torch.allclose(stepper(nodes, moved), before)


def test_single_precision_at_the_papers_size() -> None:
    torch.manual_seed(2)
    network, index = EncodeProcessDecode(20, 4, 9).requires_grad_(False), edge_indices(8, 15)
    nodes, features = torch.randn(23, 20), torch.randn(506, 4)
    stepper = GraphStepper(network, index, 23, 15)
    expected = network.double().plain(nodes.double(), features.double(), index)
    for same_body in (False, True):
        found = stepper(nodes, features, same_body).double()
        torch.testing.assert_close(found, expected, rtol=1e-5, atol=2e-6 * float(expected.abs().max()))


def test_later_weights_do_not_matter() -> None:
    network, stepper, nodes, features = prepared(EDGES["complete"])
    before = stepper(nodes, features).clone()
    for parameter in network.parameters():
        parameter.add_(1.0)
    assert torch.equal(stepper(nodes, features), before)


@pytest.mark.parametrize("kw", [{"steps": 2}, {"layer_norm": True}, {"residual": True}])
def test_other_networks_are_not_covered(kw) -> None:
    assert not GraphStepper.covers(EncodeProcessDecode(6, 4, 9, 16, **kw))
