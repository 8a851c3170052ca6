"""The forms of one network between its definition and its fast form, each with one rearrangement more."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import contextmanager

import torch
from torch import Tensor
from torch.nn.functional import linear

from sgns.model import network as module
from sgns.model.network import Adjacency, EncodeProcessDecode, IndexedAdjacency, adjacency_of

__all__ = ["Form", "forms_of", "multiplications", "onednn"]

Form = Callable[[Tensor, Tensor], Tensor]


def forms_of(network: EncodeProcessDecode, edge_index: Tensor, node_count: int) -> dict[str, Form]:
    """Functions of node and edge features (B, V, ...), (B, E, ...); each name says what is new in it."""
    indexed, broadcast = IndexedAdjacency(edge_index, node_count), adjacency_of(edge_index, node_count)
    return {
        "plain": lambda nodes, edges: network.plain(nodes, edges, edge_index),
        "first layer split": lambda *x: rearranged(network, *x, indexed, commuted=False, merged=False),
        "sum before the last layer": lambda *x: rearranged(network, *x, indexed, commuted=True, merged=False),
        "matrices merged": lambda *x: rearranged(network, *x, indexed, commuted=True, merged=True),
        "broadcast, no index": lambda *x: rearranged(network, *x, broadcast, commuted=True, merged=True),
    }


def rearranged(
    network: EncodeProcessDecode,
    nodes: Tensor,
    edges: Tensor,
    adjacency: Adjacency,
    commuted: bool,
    merged: bool,
) -> Tensor:
    """One message-passing step with some of the algebra of `sgns.model.network`."""
    step = network.process[0]
    first = step.edge_mlp.first
    own_weight, receiver_weight, sender_weight = first.weight.split(step.width, 1)
    nodes = network.encode_nodes(nodes)
    encoded = network.encode_edges.ending(network.encode_edges.hidden(edges))
    own = encoded.into(own_weight, first.bias) if merged else linear(encoded.value(), own_weight, first.bias)
    spread = adjacency.spread(own, linear(nodes, receiver_weight), linear(nodes, sender_weight))
    updated = step.edge_mlp.ending(step.edge_mlp.hidden_after_first(spread))
    summed = updated.gathered(adjacency) if commuted else adjacency.gather(updated.value())
    return network.decode(step.node_mlp(torch.cat([nodes, summed], -1)))


@contextmanager
def onednn(allowed: bool):
    """oneDNN's products allowed or not."""
    before, module._AVAILABLE = module._AVAILABLE, allowed and module._AVAILABLE
    try:
        yield
    finally:
        module._AVAILABLE = before


def multiplications(network: EncodeProcessDecode, nodes: int, edges: int) -> int:
    """Multiplications of one step that no rearrangement removes, for one message-passing step of two hidden layers.

    Every layer between nonlinearities counts once: of the edges, the first and second hidden layer of their encoder,
    then two layers of their update, the first of which holds the encoder's last; of the nodes, two of the encoder,
    three blocks of the layers after it, the sum's, one of the update, two of the decoder and its output.
    """
    width = network.process[0].width
    inputs, outputs = network.encode_nodes.first.in_features, network.decode.linears[-1].out_features
    of_edges = edges * width * (network.encode_edges.first.in_features + 3 * width)
    return of_edges + nodes * width * (inputs + width * (1 + 3 + 1 + 1 + 1 + 1) + outputs)
