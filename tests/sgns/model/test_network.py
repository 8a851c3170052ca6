"""The network against a message-passing step written out by hand, its fast form against its definition, and its
symmetries.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

from sgns.model.dynamics import Standardiser
from sgns.model.features import edge_indices
from sgns.model.network import MLP, EncodeProcessDecode, InteractionNetwork

# --- The network against a message-passing step written out by hand, its fast form against its definition,
# symmetries.


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
    for a, b in zip(outcome(network, network, *inputs, index), expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-10 * float(b.abs().max()))


@pytest.mark.parametrize("hidden_layers", [1, 2, 3])
def test_the_algebra_changes_nothing_in_float32_at_the_papers_size(hidden_layers) -> None:
    torch.manual_seed(3)
    network = EncodeProcessDecode(20, 4, 9, hidden_layers=hidden_layers)
    index = edge_indices(8, 15)
    inputs = torch.randn(9, 23, 20), torch.randn(9, 506, 4)
    expected = outcome(network.plain, network, *inputs, index)
    for a, b in zip(outcome(network, network, *inputs, index), expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-5 * float(b.abs().max()))


def test_a_batch_is_its_graphs_one_by_one() -> None:
    torch.manual_seed(3)
    network = EncodeProcessDecode(6, 4, 9, hidden=16, steps=2, layer_norm=True, residual=True).double()
    nodes, edges, index = torch.randn(3, 5, 6).double(), torch.randn(3, 20, 4).double(), edge_indices(4, 1)
    together = network(nodes, edges, index)
    alone = torch.stack([network(n, e, index) for n, e in zip(nodes, edges, strict=True)])
    torch.testing.assert_close(together, alone)


def test_renaming_nodes_renames_the_answer() -> None:
    torch.manual_seed(4)
    network = EncodeProcessDecode(6, 4, 9, hidden=16, steps=2).double()
    nodes, index = torch.randn(1, 5, 6).double(), edge_indices(4, 1)
    pair = torch.randn(5, 5, 4).double()
    order = torch.randperm(5)
    first = network(nodes, pair[index[0], index[1]][None], index)
    renamed_pair = pair[order][:, order]
    second = network(nodes[:, order], renamed_pair[index[0], index[1]][None], index)
    torch.testing.assert_close(second, first[:, order])


def test_the_order_of_edges_does_not_matter() -> None:
    torch.manual_seed(5)
    network = EncodeProcessDecode(6, 4, 9, hidden=16).double()
    nodes, edges, index = torch.randn(1, 5, 6).double(), torch.randn(1, 20, 4).double(), edge_indices(4, 1)
    order = torch.randperm(20)
    torch.testing.assert_close(network(nodes, edges, index), network(nodes, edges[:, order], index[:, order]))


def test_leading_dimensions_and_blocks_are_free(monkeypatch) -> None:
    torch.manual_seed(6)
    network = EncodeProcessDecode(6, 4, 9, hidden=16).double()
    nodes, edges, index = (
        torch.randn(2, 3, 5, 6).double(),
        torch.randn(2, 3, 20, 4).double(),
        edge_indices(4, 1),
    )
    together = network(nodes, edges, index)
    assert together.shape == (2, 3, 5, 9)
    torch.testing.assert_close(network(nodes[0, 0], edges[0, 0], index), together[0, 0])
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


def test_parameter_count_is_that_of_five_mlps() -> None:
    def mlp(inputs: int, outputs: int, h: int = 128) -> int:
        return inputs * h + h + h * h + h + h * outputs + outputs

    network = EncodeProcessDecode(30, 4, 9)
    expected = mlp(30, 128) + mlp(4, 128) + mlp(3 * 128, 128) + mlp(2 * 128, 128) + mlp(128, 9)
    assert sum(p.numel() for p in network.parameters()) == expected


def test_messages_of_two_sets_of_edges_add_up() -> None:
    torch.manual_seed(0)
    step = InteractionNetwork(5, 8, 2).double()
    nodes, edges, index = torch.randn(6, 5).double(), torch.randn(30, 5).double(), edge_indices(5, 1)

    def summed(which: torch.Tensor) -> torch.Tensor:
        messages = step.edge_updater(index[:, which], nodes=nodes, edges=edges[which])
        return step.propagate(index[:, which], edges=messages, size=(6, 6))

    some = torch.rand(30) < 0.5
    torch.testing.assert_close(summed(some) + summed(~some), summed(torch.ones(30, dtype=torch.bool)))


# --- Means and scales: round trip, nothing blown up, float64 before float32 -----------------------------


def test_round_trip() -> None:
    torch.manual_seed(0)
    x = 3.0 + torch.randn(200, 4, 3, dtype=torch.float64) * torch.rand(4, 3, dtype=torch.float64)
    standard = Standardiser.fit(x)
    torch.testing.assert_close(standard.denormalise(standard.normalise(x)), x, rtol=0, atol=1e-6)
    y = standard.normalise(x)
    torch.testing.assert_close(y.mean(0), torch.zeros(4, 3), rtol=0, atol=1e-5)
    torch.testing.assert_close(y.square().mean(0), torch.ones(4, 3), rtol=1e-4, atol=0)


def test_zero_variance_stays_small() -> None:
    x = torch.zeros(50, 2, 3, dtype=torch.float64)
    x[:, 0] = torch.randn(50, 3)
    x[:, 1, 1] = 1e-12 * torch.randn(50)
    y = Standardiser.fit(x, floor=0.01).normalise(x)
    assert torch.isfinite(y).all()
    assert y[:, 1].abs().max() < 1e-9


def test_a_constant_is_scaled_by_one() -> None:
    constant = torch.full((9, 2, 3), 7.3, dtype=torch.float64)
    for centred in (True, False):
        standard = Standardiser.fit(constant if centred else 0 * constant, centred=centred)
        assert torch.equal(standard.scale, torch.ones(2, 3, dtype=torch.float64))


def test_without_centring_rest_stays_zero() -> None:
    standard = Standardiser.fit(1.0 + torch.randn(50, 3), centred=False)
    assert torch.equal(standard.normalise(torch.zeros(3)), torch.zeros(3))


def test_small_movements_of_large_positions_survive() -> None:
    x = 18.0 + 1e-7 * torch.arange(10, dtype=torch.float64)[:, None]
    y = Standardiser.fit(x).normalise(x)
    torch.testing.assert_close(y[:, 0].diff(), y[:, 0].diff().mean().expand(9), rtol=1e-5, atol=0)


def test_an_empty_quantity() -> None:
    standard = Standardiser.fit(torch.zeros(5, 0))
    assert standard.normalise(torch.zeros(2, 0)).shape == (2, 0)
