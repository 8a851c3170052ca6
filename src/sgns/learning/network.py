"""Encode, pass messages, decode: the graph network of the paper (section 3.3), batched over graphs of one
topology."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch_geometric.nn import MessagePassing

__all__ = ["MLP", "EncodeProcessDecode", "InteractionNetwork"]

ACTIVATIONS: dict[str, type[nn.Module]] = {"relu": nn.ReLU, "silu": nn.SiLU, "gelu": nn.GELU, "tanh": nn.Tanh}


class MLP(nn.Module):
    """A multilayer perceptron whose first layer can be applied in parts.

    Args:
        inputs: Width of the input.
        hidden: Width of the hidden layers.
        hidden_layers: Number of hidden layers.
        outputs: Width of the output.
        layer_norm: Whether the output is layer-normalised.
        activation: One of "relu", "silu", "gelu", "tanh".
    """

    def __init__(
        self,
        inputs: int,
        hidden: int,
        hidden_layers: int,
        outputs: int,
        layer_norm: bool = False,
        activation: str = "relu",
    ) -> None:
        super().__init__()
        self.first = nn.Linear(inputs, hidden)
        rest: list[nn.Module] = [ACTIVATIONS[activation]()]
        for _ in range(hidden_layers - 1):
            rest += [nn.Linear(hidden, hidden), ACTIVATIONS[activation]()]
        rest.append(nn.Linear(hidden, outputs))
        if layer_norm:
            rest.append(nn.LayerNorm(outputs))
        self.rest = nn.Sequential(*rest)

    def forward(self, x: Tensor) -> Tensor:
        """Apply to `x` of shape (..., inputs); returns shape (..., outputs)."""
        return self.rest(self.first(x))


class InteractionNetwork(MessagePassing):
    r"""One message-passing step of an interaction network (Battaglia et al. 2016, arXiv:1612.00222).

    .. math::
        e'_{ij} = \phi_e([e_{ij}, v_i, v_j]), \qquad v'_i = \phi_v([v_i, \sum_j e'_{ij}])

    for the edge from sender j to receiver i. The first layer of :math:`\phi_e` is linear, so its receiver and
    sender blocks are applied to the nodes, V products instead of E; the function and its parameters are those
    of the concatenation.

    Args:
        width: Width of node and edge features.
        hidden: Width of the hidden layers.
        hidden_layers: Number of hidden layers of each MLP.
        layer_norm: Whether updates are layer-normalised.
        residual: Whether updates are added to what they update.
        activation: Activation between layers.

    Shapes:
        nodes (..., V, width), edges (..., E, width), edge_index (2, E) with senders in row 0.
        Returns nodes and edges of the same shapes.
    """

    def __init__(
        self,
        width: int,
        hidden: int,
        hidden_layers: int,
        layer_norm: bool = False,
        residual: bool = False,
        activation: str = "relu",
    ) -> None:
        super().__init__(aggr="sum", node_dim=-2)
        self.width = width
        self.residual = residual
        self.edge_mlp = MLP(3 * width, hidden, hidden_layers, width, layer_norm, activation)
        self.node_mlp = MLP(2 * width, hidden, hidden_layers, width, layer_norm, activation)

    def forward(self, nodes: Tensor, edges: Tensor, edge_index: Tensor) -> tuple[Tensor, Tensor]:
        """Update edges, sum them at their receivers, update nodes."""
        _, receiver_weight, sender_weight = self.edge_mlp.first.weight.split(self.width, dim=1)
        updated = self.edge_updater(
            edge_index,
            edges=edges,
            receiver=nn.functional.linear(nodes, receiver_weight),
            sender=nn.functional.linear(nodes, sender_weight),
        )
        count = nodes.shape[-2]
        summed = self.propagate(edge_index, edges=updated, size=(count, count))
        moved = self.node_mlp(torch.cat([nodes, summed], dim=-1))
        if self.residual:
            return nodes + moved, edges + updated
        return moved, updated

    def edge_update(self, edges: Tensor, receiver_i: Tensor, sender_j: Tensor) -> Tensor:
        """The edge MLP, its first layer finished from parts; shape (..., E, width)."""
        first = self.edge_mlp.first
        own = nn.functional.linear(edges, first.weight[:, : self.width], first.bias)
        return self.edge_mlp.rest(own + receiver_i + sender_j)

    def message(self, edges: Tensor) -> Tensor:
        """What an edge sends is its updated feature."""
        return edges


class EncodeProcessDecode(nn.Module):
    """Five MLPs: encoders of nodes and edges, edge and node updates, decoder of nodes.

    Args:
        node_inputs: Width of node features.
        edge_inputs: Width of edge features.
        outputs: Width of the decoded node quantities.
        hidden: Width of every layer and of the encoded features.
        hidden_layers: Hidden layers of each MLP.
        steps: Message-passing steps, each with its own two MLPs.
        layer_norm: Layer normalisation after every MLP but the decoder.
        residual: Whether message passing adds to nodes and edges.
        activation: Activation between layers.

    Shapes:
        nodes (..., V, node_inputs), edges (..., E, edge_inputs), edge_index (2, E). Returns (..., V,
        outputs).
    """

    def __init__(
        self,
        node_inputs: int,
        edge_inputs: int,
        outputs: int,
        hidden: int = 128,
        hidden_layers: int = 2,
        steps: int = 1,
        layer_norm: bool = False,
        residual: bool = False,
        activation: str = "relu",
    ) -> None:
        super().__init__()
        self.encode_nodes = MLP(node_inputs, hidden, hidden_layers, hidden, layer_norm, activation)
        self.encode_edges = MLP(edge_inputs, hidden, hidden_layers, hidden, layer_norm, activation)
        self.process = nn.ModuleList(
            InteractionNetwork(hidden, hidden, hidden_layers, layer_norm, residual, activation)
            for _ in range(steps)
        )
        self.decode = MLP(hidden, hidden, hidden_layers, outputs, activation=activation)

    def forward(self, nodes: Tensor, edges: Tensor, edge_index: Tensor) -> Tensor:
        """Node quantities from a batch of graphs."""
        nodes = self.encode_nodes(nodes)
        edges = self.encode_edges(edges)
        for step in self.process:
            nodes, edges = step(nodes, edges, edge_index)
        return self.decode(nodes)
