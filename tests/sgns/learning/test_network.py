"""The network against a message-passing step written out by hand, and its symmetries."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from sgns.learning.graph import edge_indices
from sgns.learning.network import MLP, EncodeProcessDecode, InteractionNetwork


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


def test_gradients_are_those_of_the_plain_concatenation() -> None:
    torch.manual_seed(2)
    step = InteractionNetwork(5, 7, 2).double()
    nodes, edges, index = torch.randn(3, 4, 5).double(), torch.randn(3, 12, 5).double(), edge_indices(3, 1)
    step(nodes, edges, index)[0].square().sum().backward()
    split = [p.grad.clone() for p in step.parameters()]
    step.zero_grad()
    sender, receiver = index
    updated = step.edge_mlp(torch.cat([edges, nodes[:, receiver], nodes[:, sender]], dim=-1))
    summed = torch.zeros_like(nodes).index_add_(1, receiver, updated)
    step.node_mlp(torch.cat([nodes, summed], dim=-1)).square().sum().backward()
    for a, p in zip(split, step.parameters(), strict=True):
        torch.testing.assert_close(a, p.grad, rtol=1e-9, atol=1e-12)


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


def test_parameter_count_is_that_of_five_mlps() -> None:
    def mlp(inputs: int, outputs: int, h: int = 128) -> int:
        return inputs * h + h + h * h + h + h * outputs + outputs

    network = EncodeProcessDecode(30, 4, 9)
    expected = mlp(30, 128) + mlp(4, 128) + mlp(3 * 128, 128) + mlp(2 * 128, 128) + mlp(128, 9)
    assert sum(p.numel() for p in network.parameters()) == expected
