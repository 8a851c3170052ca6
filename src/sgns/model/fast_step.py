"""The network for one graph at a time, as a rollout needs it: weights multiplied out once, memory kept.

Shapes: V nodes, E edges, H hidden width.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from sgns.model.network import (
    MLP,
    CompleteAdjacency,
    EncodeProcessDecode,
    adjacency_of,
    in_place,
    prefers_onednn,
    product,
)


class Layer:
    """A linear layer, weight (outputs, inputs) and bias (outputs,), for a known number of rows, with an activation or
    without, into memory of its own."""

    def __init__(self, weight: Tensor, bias: Tensor, rows: int, activation: nn.Module | None = None) -> None:
        self.bias = bias.clone()
        self.output = weight.new_empty(rows, len(weight))
        self.onednn = prefers_onednn(weight.new_empty(rows, weight.shape[1]), weight)
        self.relu = self.onednn and isinstance(activation, nn.ReLU)
        self.activate = None if self.relu or activation is None else in_place(activation)
        # A copy in the layout that the library needs not turn round.
        layout = weight if self.onednn else weight.t()
        self.weight = layout.clone(memory_format=torch.contiguous_format)

    def __call__(self, x: Tensor) -> Tensor:
        """Shape (rows, inputs) to (rows, outputs); what the last call returned may be overwritten."""
        if self.onednn:
            y = product(x, self.weight, self.bias, self.relu)
        else:
            y = torch.addmm(self.bias, x, self.weight, out=self.output)
        return y if self.activate is None else self.activate(y)


def hidden_layers(mlp: MLP, linears: Sequence[nn.Linear], rows: int) -> list[Layer]:
    """Some hidden layers of an MLP as they are."""
    return [Layer(linear.weight, linear.bias, rows, mlp.rest[0]) for linear in linears]


def merged(second: Tensor, bias: Tensor, first: nn.Linear) -> tuple[Tensor, Tensor]:
    """Weight and bias of a linear layer after another, as one; the product in float64."""
    weight = (second.double() @ first.weight.double()).to(second)
    return weight, (second.double() @ first.bias.double() + bias.double()).to(second)


def through(layers: Sequence[Layer], x: Tensor) -> Tensor:
    """Some layers one after another."""
    for layer in layers:
        x = layer(x)
    return x


class GraphStepper:
    """`EncodeProcessDecode` on one graph, without gradients.

    The same function as the network's, with every pair of linear layers that meet multiplied into one. What is
    encoded of the edges within the body can be kept while they stay as they are.

    Its memory is shared between views, which a copy of the object would tear apart: `PathStepper` makes another one
    for each of its copies.

    Args:
        network: One that `covers` approves of; its weights are copied.
        edge_index: Senders and receivers, shape (2, E).
        node_count: V.
        body_nodes: How many nodes, the last ones, are the body's.
    """

    def __init__(
        self, network: EncodeProcessDecode, edge_index: Tensor, node_count: int, body_nodes: int = 0
    ) -> None:
        self.adjacency = adjacency_of(edge_index, node_count)
        self.width = network.process[0].width
        with torch.no_grad():
            self.prepare_nodes(network, node_count)
            self.prepare_edges(network, edge_index, node_count - body_nodes)

    @staticmethod
    def covers(network: EncodeProcessDecode) -> bool:
        """Whether the network has one message-passing step, no layer normalisation and no residual."""
        steps, norm = network.process, network.encode_nodes.norm
        return len(steps) == 1 and not steps[0].residual and norm is None

    def prepare_nodes(self, network: EncodeProcessDecode, node_count: int) -> None:
        """Weights and memory of all that has V rows."""
        step, encode, decode = network.process[0], network.encode_nodes, network.decode
        update = step.node_mlp
        _, receiver, sender = step.edge_mlp.first.weight.split(self.width, 1)
        kept, summed = update.first.weight.split(self.width, 1)
        # What receivers and senders add to their edges, and nodes to their own update, side by side.
        stacked = torch.cat([receiver, sender, kept])
        projected = merged(stacked, torch.zeros_like(stacked[:, 0]), encode.linears[-1])
        self.encode_nodes = [
            *hidden_layers(encode, encode.linears[:-1], node_count),
            Layer(*projected, node_count),
        ]
        # The last layer of the edge update, behind the sum: its bias counts once per edge.
        weight, once = merged(summed, torch.zeros_like(update.first.bias), step.edge_mlp.linears[-1])
        self.summed_weight = weight.t().contiguous()
        self.update_bias = update.first.bias + self.adjacency.degree * once  # shape (H,) or (V, H)
        self.activate = in_place(update.rest[0])
        joined = merged(decode.first.weight, decode.first.bias, update.linears[-1])
        self.rest_of_nodes = [
            *hidden_layers(update, update.linears[1:-1], node_count),
            Layer(*joined, node_count, decode.rest[0]),
            *hidden_layers(decode, decode.linears[1:-1], node_count),
            Layer(decode.linears[-1].weight, decode.linears[-1].bias, node_count),
        ]
        self.summed = stacked.new_empty(node_count, self.width)
        self.updated = torch.empty_like(self.summed)

    def prepare_edges(self, network: EncodeProcessDecode, edge_index: Tensor, modes: int) -> None:
        """Weights and memory of all that has E rows."""
        update, encode = network.process[0].edge_mlp, network.encode_edges
        own = update.first.weight[:, : self.width]
        joined = merged(own, update.first.bias, encode.linears[-1])

        def encoder(rows: int) -> list[Layer]:
            return [*hidden_layers(encode, encode.linears[:-1], rows), Layer(*joined, rows)]

        count = edge_index.shape[1]
        self.encode_edges = encoder(count)
        self.update_edges = hidden_layers(update, update.linears[1:-1], count)
        self.spread = own.new_empty(count, self.width)
        self.modes = modes
        self.kept: Tensor | None = None
        if isinstance(self.adjacency, CompleteAdjacency):
            self.by_receiver = self.adjacency.by_receiver(self.spread[None])[0]
            self.by_turn = self.adjacency.by_turn(self.spread[None])[0]
            self.changing = (edge_index < modes).any(0).nonzero().flatten()
            self.encode_changing = encoder(len(self.changing))

    def __call__(self, nodes: Tensor, edges: Tensor, same_body: bool = False) -> Tensor:
        """Decoded quantities of every node, shape (V, outputs); overwritten by the next call.

        Args:
            nodes: Shape (V, node inputs).
            edges: Shape (E, edge inputs).
            same_body: Whether the edges within the body are those of the call before.
        """
        receiver, sender, kept = through(self.encode_nodes, nodes).split(self.width, 1)
        messages = self.activate(self.first_of_edges(edges, receiver, sender, same_body))
        messages = through(self.update_edges, messages)
        kept = kept + self.update_bias
        updated = torch.addmm(kept, self.gather(messages), self.summed_weight, out=self.updated)
        return through(self.rest_of_nodes, self.activate(updated))

    def first_of_edges(self, edges: Tensor, receiver: Tensor, sender: Tensor, same_body: bool) -> Tensor:
        """The first layer of the edge update before its activation, shape (E, H)."""
        adjacency = self.adjacency
        if not isinstance(adjacency, CompleteAdjacency):
            torch.index_select(receiver, 0, adjacency.receiver, out=self.spread)
            self.spread.add_(through(self.encode_edges, edges))
            return self.spread.add_(sender.index_select(0, adjacency.sender))
        if same_body and self.kept is not None:
            self.add_receivers_beside_kept(edges, receiver, self.kept)
        else:
            own = through(self.encode_edges, edges).view_as(self.by_receiver)
            torch.add(own, receiver[:, None], out=self.by_receiver)
            within_body = own[self.modes :, self.modes :]
            self.kept = within_body.clone() if within_body.numel() else None
        self.by_turn.add_(adjacency.senders(sender[None])[0])
        return self.spread

    def add_receivers_beside_kept(self, edges: Tensor, receiver: Tensor, kept: Tensor) -> None:
        """Fill `spread` with own shares and receivers', computing those of the edges outside the body only.

        In the order of a complete graph these are all edges to modes, then those from modes to each body node.
        """
        r = self.modes
        to_modes, to_body = self.by_receiver[:r], self.by_receiver[r:]
        changed = through(self.encode_changing, edges.index_select(0, self.changing))
        first = r * to_modes.shape[1]
        torch.add(changed[:first].view(to_modes.shape), receiver[:r, None], out=to_modes)
        torch.add(changed[first:].view(-1, r, self.width), receiver[r:, None], out=to_body[:, :r])
        torch.add(kept, receiver[r:, None], out=to_body[:, r:])

    def gather(self, messages: Tensor) -> Tensor:
        """Sum of the edges at their receivers, shape (V, H)."""
        if isinstance(self.adjacency, CompleteAdjacency):
            return torch.sum(messages.view_as(self.by_receiver), 1, out=self.summed)
        return self.summed.zero_().index_add_(0, self.adjacency.receiver, messages)
