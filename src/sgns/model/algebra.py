"""The network's algebra by hand: linear layers, sums along edges, and all of it for one graph at a time, as a rollout
needs it.

Shapes: B batch, V nodes, E edges, H hidden width.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

if TYPE_CHECKING:
    from sgns.model.network import MLP, EncodeProcessDecode

# --- A linear layer, with or without ReLU, through the faster of torch's two matrix libraries on the CPU --
# torch multiplies float32 matrices with the BLAS it was built with. oneDNN, which it also holds, applies bias
# and ReLU on the way. torch gives it no public function: `nn.functional.linear` and ReLU take 1.04 times as
# long for 4096 rows and 1.24 times for 9000 on one processor, twice as long on another
# (experiments/rollout_speed); `torch.mkldnn` tensors, copied there and back, take 4 times as long.

# Below this many multiplications a product is over before oneDNN has begun.
_WORTH_IT = 2**22
# Rows whose products with each other are summed at once: more fall out of the cache, and take many times as long.
_ROWS_AT_ONCE = 2048
_AVAILABLE = torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_linear_pointwise")


def affine(x: Tensor, weight: Tensor, bias: Tensor, relu: bool = False) -> Tensor:
    """x Wᵀ + b, then ReLU if asked for; shapes and values of `torch.nn.functional.linear`, to rounding."""
    if prefers_onednn(x, weight):
        if torch.is_grad_enabled():
            return _Affine.apply(x, weight, bias, relu)
        return product(x, weight, bias, relu)
    y = nn.functional.linear(x, weight, bias)
    return y.relu_() if relu else y


def prefers_onednn(x: Tensor, weight: Tensor) -> bool:
    """Whether oneDNN is there for this product and worth its start."""
    return (
        _AVAILABLE
        and x.dtype == torch.float32
        and x.device.type == "cpu"
        and x.numel() * weight.shape[0] >= _WORTH_IT
    )


def product(x: Tensor, weight: Tensor, bias: Tensor | None = None, relu: bool = False) -> Tensor:
    """oneDNN's x Wᵀ + b with its ReLU; float32 on the CPU only."""
    # Of a matrix with gaps between its rows, such as a part of another one, oneDNN takes a thousand times as long.
    if not (weight.is_contiguous() or weight.t().is_contiguous()):
        weight = weight.contiguous()
    return torch.ops.mkldnn._linear_pointwise(x, weight, bias, "relu" if relu else "none", [], "")


class _Affine(torch.autograd.Function):
    """oneDNN's product with its gradient, which torch does not define."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor, relu: bool) -> Tensor:
        y = product(x.reshape(-1, x.shape[-1]), weight, bias, relu)
        # Not a view to autograd, which would forbid whoever comes next to work in place.
        y = torch.ops.aten._unsafe_view(y, [*x.shape[:-1], len(weight)])
        ctx.relu = relu
        ctx.save_for_backward(x, weight, *([y] if relu else []))
        return y

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor, Tensor, None]:
        x, weight, *y = ctx.saved_tensors
        if ctx.relu:
            gradient = torch.ops.aten.threshold_backward(gradient, y[0], 0)
        rows, inputs = gradient.reshape(-1, gradient.shape[-1]), x.reshape(-1, x.shape[-1])
        to_x = product(gradient, weight.t().contiguous()) if ctx.needs_input_grad[0] else None
        blocks = zip(rows.split(_ROWS_AT_ONCE), inputs.split(_ROWS_AT_ONCE), strict=True)
        to_weight = sum(product(row.t(), value.t()) for row, value in blocks)
        return to_x, to_weight, rows.sum(0), None


# --- Sums along the edges of a graph: nodes to their edges, edges to their receivers --------------------


class Adjacency(Protocol):
    """The edges of a graph, as two linear maps."""

    @property
    def degree(self) -> int | Tensor:
        """Edges that each node receives: a number, or one per node, shape (V, 1)."""

    def spread(self, edges: Tensor, receiver: Tensor, sender: Tensor) -> Tensor:
        """Each edge's own value (B, E, H), which may be overwritten, plus that of its receiver and that of its sender
        (B, V, H)."""

    def gather(self, edges: Tensor) -> Tensor:
        """Sum of the edges at their receivers, (B, E, H) to (B, V, H)."""


class CompleteAdjacency:
    """Every ordered pair of V nodes, receivers ascending: no index is needed."""

    def __init__(self, node_count: int, self_loops: bool) -> None:
        self.node_count = node_count
        self.self_loops = self_loops

    @property
    def degree(self) -> int:
        """V, or V - 1 without self loops."""
        return self.node_count - (not self.self_loops)

    def spread(self, edges: Tensor, receiver: Tensor, sender: Tensor) -> Tensor:
        """As `Adjacency.spread`, in place."""
        return _Spread.apply(edges, receiver, sender, self)

    def gather(self, edges: Tensor) -> Tensor:
        """As `Adjacency.gather`."""
        return self.by_receiver(edges).sum(-2)

    def by_receiver(self, edges: Tensor) -> Tensor:
        """A view (B, V, degree, H) of (B, E, H)."""
        return edges.unflatten(1, (self.node_count, self.degree))

    def by_turn(self, edges: Tensor) -> Tensor:
        """A view (B, degree, V, H) of (B, E, H) in whose block k the senders are k + 1, k + 2, ... modulo V
        (k = 0 and senders 0, 1, ... with self loops).

        Without its diagonal a V × V matrix read row by row is V - 1 blocks of V values: each block begins one
        column further.
        """
        return edges.unflatten(1, (self.degree, self.node_count))

    def senders(self, sender: Tensor) -> Tensor:
        """What `by_turn` finds at the edges' senders: a view of the nodes written twice, (B, V - 1, V, H)."""
        if self.self_loops:
            return sender[:, None]
        return torch.cat([sender, sender], 1)[:, 1:-1].unfold(1, self.node_count, 1).transpose(-1, -2)

    def sum_at_senders(self, edges: Tensor) -> Tensor:
        """Sum of the edges at their senders, (B, E, H) to (B, V, H)."""
        if self.self_loops:
            return self.by_receiver(edges).sum(1)
        batch, v, width = len(edges), self.node_count, edges.shape[-1]
        square = edges.new_zeros(batch, v * v, width)
        square[:, 1:].unflatten(1, (v - 1, v + 1))[:, :, :v] = self.by_turn(edges)
        return square.unflatten(1, (v, v)).sum(1)


class _Spread(torch.autograd.Function):
    """`CompleteAdjacency.spread`: written by hand because it overwrites the edges instead of copying them twice."""

    @staticmethod
    def forward(
        ctx: Any, edges: Tensor, receiver: Tensor, sender: Tensor, adjacency: CompleteAdjacency
    ) -> Tensor:
        ctx.adjacency = adjacency
        ctx.mark_dirty(edges)
        adjacency.by_receiver(edges).add_(receiver[:, :, None])
        adjacency.by_turn(edges).add_(adjacency.senders(sender))
        return edges

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor, None]:
        gradient = gradient.contiguous()
        return gradient, ctx.adjacency.gather(gradient), ctx.adjacency.sum_at_senders(gradient), None


class IndexedAdjacency:
    """Any set of edges: senders and receivers (2, E) between V nodes."""

    def __init__(self, edge_index: Tensor, node_count: int) -> None:
        self.sender, self.receiver = edge_index
        self.node_count = node_count
        self.degree = torch.bincount(self.receiver, minlength=node_count)[:, None]

    def spread(self, edges: Tensor, receiver: Tensor, sender: Tensor) -> Tensor:
        """As `Adjacency.spread`."""
        return edges + receiver.index_select(1, self.receiver) + sender.index_select(1, self.sender)

    def gather(self, edges: Tensor) -> Tensor:
        """As `Adjacency.gather`."""
        empty = edges.new_zeros(len(edges), self.node_count, edges.shape[-1])
        return empty.index_add(1, self.receiver, edges)


def adjacency_of(edge_index: Tensor, node_count: int) -> Adjacency:
    """The quickest form of these edges; they are those of a complete graph only in its order."""
    for self_loops in (False, True):
        # Their number first: a graph of all particles has few edges, and all pairs of its nodes take tens of GB.
        if node_count < 2 or edge_index.shape[1] != node_count * (node_count - (not self_loops)):
            continue
        index = torch.arange(node_count, device=edge_index.device)
        receiver, sender = torch.meshgrid(index, index, indexing="ij")
        keep = (receiver != sender) | self_loops
        if torch.equal(edge_index, torch.stack([sender[keep], receiver[keep]])):
            return CompleteAdjacency(node_count, self_loops)
    return IndexedAdjacency(edge_index, node_count)


# --- The network for one graph at a time: weights multiplied out once, memory kept ------------------------


class Layer:
    """A linear layer for a known number of rows, with ReLU or without, into memory of its own.

    Args:
        weight: Shape (outputs, inputs).
        bias: Shape (outputs,).
        rows: Their number.
        activation: What follows; None for nothing.
    """

    def __init__(self, weight: Tensor, bias: Tensor, rows: int, activation: nn.Module | None = None) -> None:
        self.bias = bias.clone()
        self.relu = isinstance(activation, nn.ReLU)
        self.activation = None if self.relu else activation
        self.output = weight.new_empty(rows, len(weight))
        self.onednn = prefers_onednn(weight.new_empty(rows, weight.shape[1]), weight)
        # A copy in the layout that the library needs not turn round.
        self.weight = (
            weight.clone() if self.onednn else weight.t().clone(memory_format=torch.contiguous_format)
        )

    def __call__(self, x: Tensor) -> Tensor:
        """Shape (rows, inputs) to (rows, outputs); what the last call returned may be overwritten."""
        if self.onednn:
            y = product(x, self.weight, self.bias, self.relu)
        else:
            y = torch.addmm(self.bias, x, self.weight, out=self.output)
            if self.relu:
                y.relu_()
        return y if self.activation is None else self.activation(y)


def hidden_layers(mlp: MLP, linears: Sequence[nn.Linear], rows: int) -> list[Layer]:
    """Some hidden layers of an MLP as they are."""
    return [Layer(linear.weight, linear.bias, rows, mlp.rest[0]) for linear in linears]


def merged(second: Tensor, bias: Tensor, first: nn.Linear) -> tuple[Tensor, Tensor]:
    """Weight and bias of a linear layer after another, as one; the product in float64."""
    weight = (second.double() @ first.weight.double()).to(second)
    return weight, (second.double() @ first.bias.double() + bias.double()).to(second)


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
        with torch.no_grad():
            self.adjacency = adjacency_of(edge_index, node_count)
            self.prepare_nodes(network, node_count)
            self.prepare_edges(network, edge_index, node_count - body_nodes)

    @staticmethod
    def covers(network: EncodeProcessDecode) -> bool:
        """Whether the network has one message-passing step, no layer normalisation and no residual."""
        return (
            len(network.process) == 1
            and not network.process[0].residual
            and network.encode_nodes.norm is None
        )

    def prepare_nodes(self, network: EncodeProcessDecode, node_count: int) -> None:
        """Weights and memory of all that has V rows."""
        step = network.process[0]
        encode, update, decode = network.encode_nodes, step.node_mlp, network.decode
        _, receiver, sender = step.edge_mlp.first.weight.split(step.width, 1)
        kept, summed = update.first.weight.split(step.width, 1)
        self.encode_nodes = hidden_layers(encode, encode.linears[:-1], node_count)
        # What receivers and senders add to their edges, and nodes to their own update, side by side.
        stacked = torch.cat([receiver, sender, kept])
        self.project = Layer(
            *merged(stacked, torch.zeros_like(stacked[:, 0]), encode.linears[-1]), node_count
        )
        # The last layer of the edge update, behind the sum: its bias counts once per edge.
        last = step.edge_mlp.linears[-1]
        weight, once = merged(summed, torch.zeros_like(update.first.bias), last)
        self.summed_weight = weight.t().contiguous()
        self.update_bias = update.first.bias + self.adjacency.degree * once  # shape (H,) or (V, H)
        self.activation = update.rest[0]
        joined = merged(decode.first.weight, decode.first.bias, update.linears[-1])
        self.rest_of_nodes = [
            *hidden_layers(update, update.linears[1:-1], node_count),
            Layer(*joined, node_count, decode.rest[0]),
            *hidden_layers(decode, decode.linears[1:-1], node_count),
            Layer(decode.linears[-1].weight, decode.linears[-1].bias, node_count),
        ]
        self.width = step.edge_mlp.first.out_features
        self.summed = stacked.new_empty(node_count, self.width)
        self.updated = torch.empty_like(self.summed)

    def prepare_edges(self, network: EncodeProcessDecode, edge_index: Tensor, modes: int) -> None:
        """Weights and memory of all that has E rows."""
        update, encode = network.process[0].edge_mlp, network.encode_edges
        own = update.first.weight[:, : network.process[0].width]
        count = edge_index.shape[1]
        joined = merged(own, update.first.bias, encode.linears[-1])

        def layers(rows: int) -> list[Layer]:
            return [*hidden_layers(encode, encode.linears[:-1], rows), Layer(*joined, rows)]

        self.encode_edges = layers(count)
        self.update_edges = hidden_layers(update, update.linears[1:-1], count)
        self.spread = own.new_empty(count, self.width)
        self.modes = modes
        self.kept: Tensor | None = None
        if isinstance(self.adjacency, CompleteAdjacency):
            self.by_receiver = self.adjacency.by_receiver(self.spread[None])[0]
            self.by_turn = self.adjacency.by_turn(self.spread[None])[0]
            self.within_body = self.by_receiver[modes:, modes:].shape[:2].numel()
            changing = (edge_index < modes).any(0)
            self.changing = changing.nonzero().flatten()
            self.encode_changing = layers(len(self.changing))

    def __call__(self, nodes: Tensor, edges: Tensor, same_body: bool = False) -> Tensor:
        """Decoded quantities of every node, shape (V, outputs); overwritten by the next call.

        Args:
            nodes: Shape (V, node inputs).
            edges: Shape (E, edge inputs).
            same_body: Whether the edges within the body are those of the call before.
        """
        for layer in self.encode_nodes:
            nodes = layer(nodes)
        projected = self.project(nodes)
        receiver, sender, kept = projected.split(self.width, 1)
        messages = self.activate(self.first_of_edges(edges, receiver, sender, same_body))
        for layer in self.update_edges:
            messages = layer(messages)
        kept = kept + self.update_bias
        updated = torch.addmm(kept, self.gather(messages), self.summed_weight, out=self.updated)
        updated = self.activate(updated)
        for layer in self.rest_of_nodes:
            updated = layer(updated)
        return updated

    def activate(self, x: Tensor) -> Tensor:
        """The activation, in place where it can be."""
        return x.relu_() if isinstance(self.activation, nn.ReLU) else self.activation(x)

    def first_of_edges(self, edges: Tensor, receiver: Tensor, sender: Tensor, same_body: bool) -> Tensor:
        """The first layer of the edge update before its activation, shape (E, H)."""
        adjacency = self.adjacency
        if not isinstance(adjacency, CompleteAdjacency):
            torch.index_select(receiver, 0, adjacency.receiver, out=self.spread)
            own = through(self.encode_edges, edges)
            return self.spread.add_(own).add_(sender.index_select(0, adjacency.sender))
        if same_body and self.kept is not None:
            self.add_receivers_beside_kept(edges, receiver)
        else:
            own = through(self.encode_edges, edges).view_as(self.by_receiver)
            torch.add(own, receiver[:, None], out=self.by_receiver)
            if self.within_body:
                self.kept = own[self.modes :, self.modes :].clone()
        self.by_turn.add_(adjacency.senders(sender[None])[0])
        return self.spread

    def add_receivers_beside_kept(self, edges: Tensor, receiver: Tensor) -> None:
        """Fill `spread` with own shares and receivers', computing those of the edges outside the body only.

        In the order of a complete graph these are all edges to modes, then those from modes to each body node.
        """
        r = self.modes
        to_modes, to_body = self.by_receiver[:r], self.by_receiver[r:]
        changed = through(self.encode_changing, edges.index_select(0, self.changing))
        own, from_modes = changed.split([r * self.adjacency.degree, len(changed) - r * self.adjacency.degree])
        torch.add(own.view(to_modes.shape), receiver[:r, None], out=to_modes)
        torch.add(from_modes.view(-1, r, self.width), receiver[r:, None], out=to_body[:, :r])
        torch.add(self.kept, receiver[r:, None], out=to_body[:, r:])

    def gather(self, messages: Tensor) -> Tensor:
        """Sum of the edges at their receivers, shape (V, H)."""
        adjacency = self.adjacency
        if isinstance(adjacency, CompleteAdjacency):
            return torch.sum(messages.view_as(self.by_receiver), 1, out=self.summed)
        return self.summed.zero_().index_add_(0, adjacency.receiver, messages)


def through(layers: Sequence[Layer], x: Tensor) -> Tensor:
    """Some layers one after another."""
    for layer in layers:
        x = layer(x)
    return x
