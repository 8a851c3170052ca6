"""The network against a message-passing step written out by hand, its fast form against its definition, and its
symmetries.
"""

import time

import numpy as np
import pytest
import torch

from sgns.model import network as module
from sgns.model.features import edge_indices
from sgns.model.network import (
    MLP,
    CompleteAdjacency,
    EncodeProcessDecode,
    IndexedAdjacency,
    InteractionNetwork,
    adjacency_of,
    affine,
)


def assert_close(found: list[torch.Tensor], expected: list[torch.Tensor], tolerance: float) -> None:
    """Tensors, to a share of the largest value of each."""
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=tolerance, atol=tolerance * float(b.abs().max()))


# --- Both matrix libraries give the same linear layer and the same gradients ----------------------------


def affine_outcome(shape: tuple[int, ...], relu: bool) -> list[torch.Tensor]:
    """Values with gradients asked for, and without; gradients."""
    torch.manual_seed(0)
    tensors = [torch.randn(*shape, 40), torch.randn(60, 40), torch.randn(60)]
    for tensor in tensors:
        tensor.requires_grad_()
    y = affine(*tensors, relu=relu)
    with torch.inference_mode():
        alone = affine(*tensors, relu=relu)
    return [y.detach(), alone, *torch.autograd.grad(y.sin().sum(), tensors)]


@pytest.mark.parametrize("relu", [False, True])
@pytest.mark.parametrize("shape", [(7,), (2, 3, 5), (5000,)])
def test_onednn_is_the_linear_layer(shape, relu, monkeypatch) -> None:
    if not torch.backends.mkldnn.is_available():
        pytest.skip("torch was built without oneDNN")
    monkeypatch.setattr(module, "_WORTH_IT", 2**60)
    expected = affine_outcome(shape, relu)
    monkeypatch.setattr(module, "_WORTH_IT", 0)
    assert module.prefers_onednn(torch.empty(*shape, 40), torch.empty(60, 40))
    assert_close(affine_outcome(shape, relu), expected, 1e-5)


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


def outcome_of_sums(adjacency, v: int, e: int) -> list[torch.Tensor]:
    torch.manual_seed(0)
    tensors = [torch.randn(2, rows, 3).double().requires_grad_() for rows in (e, v, v)]
    spread = adjacency.spread(tensors[0] * 1.0, *tensors[1:])
    summed = adjacency.gather(spread.sin())
    return [spread.detach(), summed.detach(), *torch.autograd.grad(summed.square().sum(), tensors)]


@pytest.mark.parametrize("v", [2, 3, 6])
@pytest.mark.parametrize("self_loops", [False, True])
def test_broadcasting_is_indexing(v, self_loops) -> None:
    index = edge_indices(v - 1, 1, self_loops=self_loops)
    adjacency = adjacency_of(index, v)
    assert isinstance(adjacency, CompleteAdjacency) and adjacency.degree == index.shape[1] // v
    found, expected = (outcome_of_sums(a, v, index.shape[1]) for a in (adjacency, IndexedAdjacency(index, v)))
    assert_close(found, expected, 1e-12)


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


# --- The network ------------------------------------------------------------------------------------------


def by_hand(mlp: MLP, x: np.ndarray) -> np.ndarray:
    """The MLP in numpy: linear layers with ReLU between."""
    layers = [mlp.first, *[layer for layer in mlp.rest if isinstance(layer, torch.nn.Linear)]]
    for i, layer in enumerate(layers):
        x = layer.weight.detach().numpy() @ x + layer.bias.detach().numpy()
        if i < len(layers) - 1:
            x = np.maximum(x, 0.0)
    return x


@pytest.mark.parametrize("residual", [False, True])
def test_one_step_by_hand(residual: bool) -> None:
    torch.manual_seed(1)
    step = InteractionNetwork(5, 7, 2, residual=residual).double()
    nodes, edges, index = torch.randn(4, 5).double(), torch.randn(12, 5).double(), edge_indices(3, 1)
    found_nodes, found_edges = step(nodes, edges, index)

    v, e = nodes.numpy(), edges.numpy()
    new_e, summed = np.zeros_like(e), np.zeros_like(v)
    for k, (sender, receiver) in enumerate(index.T.tolist()):
        new_e[k] = by_hand(step.edge_mlp, np.concatenate([e[k], v[receiver], v[sender]]))
        summed[receiver] += new_e[k]
    new_v = np.stack([by_hand(step.node_mlp, np.concatenate([v[i], summed[i]])) for i in range(4)])
    np.testing.assert_allclose(found_nodes.detach().numpy(), new_v + residual * v, atol=1e-12)
    np.testing.assert_allclose(found_edges.detach().numpy(), new_e + residual * e, atol=1e-12)


EDGES = {
    "complete": edge_indices(3, 2),
    "self_loops": edge_indices(3, 2, self_loops=True),
    "star": edge_indices(3, 2, "star"),
    # In no order, some twice, with a node that receives nothing.
    "any": torch.tensor([[4, 0, 2, 2, 3, 0, 1], [1, 2, 0, 0, 3, 1, 2]]),
}


def outcome(form, network: EncodeProcessDecode, nodes, edges, index) -> list[torch.Tensor]:
    """Output, then gradients of a loss that weighs all outputs differently, for inputs and parameters."""
    nodes, edges = nodes.clone().requires_grad_(), edges.clone().requires_grad_()
    output = form(nodes, edges, index)
    loss = (output * torch.linspace(-1, 2, output.numel()).to(output).view_as(output)).sum()
    return [output.detach(), *torch.autograd.grad(loss, [nodes, edges, *network.parameters()])]


@pytest.mark.parametrize("edges", EDGES)
@pytest.mark.parametrize("activation", ["relu", "silu"])
@pytest.mark.parametrize("steps", [1, 3])
@pytest.mark.parametrize("layer_norm", [False, True])
@pytest.mark.parametrize("residual", [False, True])
def test_the_algebra_changes_nothing(residual, layer_norm, steps, activation, edges) -> None:
    torch.manual_seed(2)
    network = EncodeProcessDecode(6, 4, 9, 16, 2, steps, layer_norm, residual, activation).double()
    index = EDGES[edges]
    inputs = torch.randn(3, 5, 6).double(), torch.randn(3, index.shape[1], 4).double()
    expected = outcome(network.plain, network, *inputs, index)
    assert_close(outcome(network, network, *inputs, index), expected, 1e-10)


@pytest.mark.parametrize("hidden_layers", [1, 2, 3])
def test_the_algebra_changes_nothing_in_float32_at_the_papers_size(hidden_layers) -> None:
    torch.manual_seed(3)
    network = EncodeProcessDecode(20, 4, 9, hidden_layers=hidden_layers)
    index = edge_indices(8, 15)
    inputs = torch.randn(9, 23, 20), torch.randn(9, 506, 4)
    expected = outcome(network.plain, network, *inputs, index)
    assert_close(outcome(network, network, *inputs, index), expected, 1e-5)


def test_leading_dimensions_and_blocks_are_free(monkeypatch) -> None:
    torch.manual_seed(6)
    network = EncodeProcessDecode(6, 4, 9, hidden=16, steps=2, layer_norm=True, residual=True).double()
    nodes, edges = torch.randn(2, 3, 5, 6).double(), torch.randn(2, 3, 20, 4).double()
    index = edge_indices(4, 1)
    together = network(nodes, edges, index)
    alone = [
        [network(*graph, index) for graph in zip(*pair, strict=True)]
        for pair in zip(nodes, edges, strict=True)
    ]
    torch.testing.assert_close(torch.stack([torch.stack(row) for row in alone]), together)
    monkeypatch.setattr("sgns.model.network.EDGES_AT_ONCE", 40)
    with torch.inference_mode():
        torch.testing.assert_close(network(nodes, edges, index), together)


def test_the_inputs_are_left_as_they_are() -> None:
    torch.manual_seed(7)
    network = EncodeProcessDecode(6, 4, 9, hidden=16, steps=2, layer_norm=True, residual=True)
    nodes, edges = torch.randn(2, 5, 6), torch.randn(2, 20, 4)
    before = nodes.clone(), edges.clone()
    network(nodes, edges, edge_indices(4, 1))
    assert torch.equal(nodes, before[0]) and torch.equal(edges, before[1])
