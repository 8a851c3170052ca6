"""The stepper of one graph against the network's definition."""

import pytest
import torch

from sgns.model.fast_step import GraphStepper
from sgns.model.features import edge_indices
from sgns.model.network import EncodeProcessDecode

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
    within = (index >= MODES).all(0)
    for same_body in (True, False, True, False):  # at first there is nothing to keep
        expected = network.plain(nodes, features, index)
        torch.testing.assert_close(stepper(nodes, features, same_body), expected, rtol=1e-10, atol=1e-12)
        nodes, features = nodes + 0.3, torch.where(within[:, None], features, features - 0.2)
    found = stepper(nodes, features + 1.0)
    torch.testing.assert_close(found, network.plain(nodes, features + 1.0, index), rtol=1e-10, atol=1e-12)


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


@pytest.mark.parametrize("kw", [{"steps": 2}, {"layer_norm": True}, {"residual": True}])
def test_other_networks_are_not_covered(kw) -> None:
    assert not GraphStepper.covers(EncodeProcessDecode(6, 4, 9, 16, **kw))
