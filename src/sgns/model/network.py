"""Encode, pass messages, decode: the graph network of the paper (section 3.3), batched over graphs of one topology.

`MLP.forward`, `InteractionNetwork.forward` and `EncodeProcessDecode.plain` are the definition. What
`EncodeProcessDecode.forward` runs is the same function by exact algebra:

- the first layer of the edge update is linear, so its receiver and sender blocks are applied to the V nodes and
  not to the E edges, and its edge block can be multiplied into the last layer of whatever made the edges;
- the last layer of the edge update is linear, so it is applied to the V sums and not to the E edges;
- a complete graph needs no index: senders and receivers are broadcast (`CompleteAdjacency`);
- without gradients batches go through in blocks, so that memory is bounded and stays in the cache.

A layer normalisation stands in the way of the second, and of the multiplication in the first; the rest holds.

Shapes: B batch, V nodes, E edges, H hidden width.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch_geometric.nn import MessagePassing

from sgns.settings import ModelSettings

ACTIVATIONS: dict[str, type[nn.Module]] = {"relu": nn.ReLU, "silu": nn.SiLU, "gelu": nn.GELU, "tanh": nn.Tanh}
# Edges that go through the network at once on a CPU when nothing is kept for gradients.
EDGES_AT_ONCE = 4096


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
        return (_Affine.apply if torch.is_grad_enabled() else product)(x, weight, bias, relu)
    y = nn.functional.linear(x, weight, bias)
    return y.relu_() if relu else y


def prefers_onednn(x: Tensor, weight: Tensor) -> bool:
    """Whether oneDNN is there for this product and worth its start; not in a graph that is exported."""
    return (
        _AVAILABLE
        and not torch.compiler.is_compiling()
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
        # `data` is no view to autograd, which would forbid whoever comes next to work in place.
        y = product(x, weight, bias, relu).data
        ctx.relu = relu
        ctx.save_for_backward(x, weight, *([y] if relu else []))
        return y

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor, Tensor, None]:
        x, weight, *y = ctx.saved_tensors
        if ctx.relu:  # whatever torch has in public for this takes four times as long
            gradient = torch.ops.aten.threshold_backward(gradient, y[0], 0)
        rows, inputs = gradient.reshape(-1, gradient.shape[-1]), x.reshape(-1, x.shape[-1])
        to_x = product(gradient, weight.t().contiguous()) if ctx.needs_input_grad[0] else None
        to_weight = torch.zeros_like(weight)
        for row, value in zip(rows.split(_ROWS_AT_ONCE), inputs.split(_ROWS_AT_ONCE), strict=True):
            to_weight += product(row.t(), value.t())
        return to_x, to_weight, rows.sum(0), None


# --- Sums along the edges of a graph: nodes to their edges, edges to their receivers --------------------


class CompleteAdjacency:
    """Every ordered pair of V nodes, receivers ascending: no index is needed.

    Attributes:
        degree: Edges that each node receives: V, or V - 1 without self loops.
    """

    def __init__(self, node_count: int, self_loops: bool) -> None:
        self.node_count = node_count
        self.self_loops = self_loops
        self.degree = node_count - (not self_loops)

    def spread(self, edges: Tensor, receiver: Tensor, sender: Tensor) -> Tensor:
        """Each edge's own value (B, E, H), which is overwritten, plus that of its receiver and that of its sender
        (B, V, H)."""
        return _Spread.apply(edges, receiver, sender, self)

    def gather(self, edges: Tensor) -> Tensor:
        """Sum of the edges at their receivers, (B, E, H) to (B, V, H)."""
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
    """Any set of edges: senders and receivers (2, E) between V nodes; methods as of `CompleteAdjacency`."""

    def __init__(self, edge_index: Tensor, node_count: int) -> None:
        self.sender, self.receiver = edge_index
        self.node_count = node_count
        self.degree = torch.bincount(self.receiver, minlength=node_count)[:, None]

    def spread(self, edges: Tensor, receiver: Tensor, sender: Tensor) -> Tensor:
        return edges + receiver.index_select(1, self.receiver) + sender.index_select(1, self.sender)

    def gather(self, edges: Tensor) -> Tensor:
        empty = edges.new_zeros(len(edges), self.node_count, edges.shape[-1])
        return empty.index_add(1, self.receiver, edges)


Adjacency = CompleteAdjacency | IndexedAdjacency


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


# --- The network ------------------------------------------------------------------------------------------


def keep_freed_memory() -> None:
    """Have glibc keep the memory of a few megabytes that one step frees for the next.

    By default it goes back to the system and comes again page by page, which takes a third of a training step. The
    size up to which memory is kept follows the largest block freed so far, at most 32 MB (mallopt(3),
    M_MMAP_THRESHOLD): one such block is enough, and it is never touched.
    """
    torch.empty(2**25 - 2**16, dtype=torch.uint8)


def in_place(activation: nn.Module) -> Callable[[Tensor], Tensor]:
    """The activation, overwriting its input where it can."""
    return torch.relu_ if isinstance(activation, nn.ReLU) else activation


class MLP(nn.Module):
    """A multilayer perceptron: widths of input, hidden layers and output; the output may be layer-normalised."""

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

    @property
    def linears(self) -> list[nn.Linear]:
        """All linear layers in their order."""
        return [self.first, *(layer for layer in self.rest if isinstance(layer, nn.Linear))]

    @property
    def norm(self) -> nn.LayerNorm | None:
        """The layer normalisation at the end, if there is one."""
        last = self.rest[-1]
        return last if isinstance(last, nn.LayerNorm) else None

    def layers(self, x: Tensor, linears: Sequence[nn.Linear]) -> Tensor:
        """Some of the linear layers, each with its activation."""
        relu = isinstance(self.rest[0], nn.ReLU)
        for linear in linears:
            x = affine(x, linear.weight, linear.bias, relu)
            if not relu:
                x = self.rest[0](x)
        return x

    def hidden(self, x: Tensor) -> Tensor:
        """The last hidden layer, (..., inputs) to (..., hidden)."""
        return self.layers(x, self.linears[:-1])

    def ending(self, hidden: Tensor) -> Tensor | Unapplied:
        """The output from the last hidden layer; where the last step is linear it is left for later."""
        last = self.linears[-1]
        unapplied = Unapplied(hidden, last.weight, last.bias)
        return unapplied if self.norm is None else self.norm(unapplied.value())


class Unapplied(NamedTuple):
    """A linear layer, weight (outputs, hidden) and bias (outputs,), together with its input (..., hidden): it may be
    multiplied with the next, or moved behind a sum."""

    hidden: Tensor
    weight: Tensor
    bias: Tensor

    def value(self) -> Tensor:
        """The layer's output."""
        return affine(self.hidden, self.weight, self.bias)

    def into(self, weight: Tensor, bias: Tensor) -> Tensor:
        """The output of the linear layer that follows, as one product."""
        return affine(self.hidden, weight @ self.weight, torch.addmv(bias, weight, self.bias))

    def gathered(self, adjacency: Adjacency) -> Tensor:
        """Sum of the output at the receivers: the layer applied to the sum of its input."""
        return nn.functional.linear(adjacency.gather(self.hidden), self.weight) + adjacency.degree * self.bias


def value_of(features: Tensor | Unapplied) -> Tensor:
    """The features, the layer that makes them applied."""
    return features.value() if isinstance(features, Unapplied) else features


class InteractionNetwork(MessagePassing):
    r"""One message-passing step of an interaction network (Battaglia et al. 2016, arXiv:1612.00222).

    .. math::
        e'_{ij} = \phi_e([e_{ij}, v_i, v_j]), \qquad v'_i = \phi_v([v_i, \sum_j e'_{ij}])

    for the edge from sender j to receiver i; node and edge features are `width` wide. With `residual` updates are added
    to what they update.
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
        """New nodes (..., V, width) and edges (..., E, width) from old ones; senders are row 0 of edge_index (2, E)."""
        updated = self.edge_updater(edge_index, nodes=nodes, edges=edges)
        count = nodes.shape[-2]
        summed = self.propagate(edge_index, edges=updated, size=(count, count))
        moved = self.node_mlp(torch.cat([nodes, summed], dim=-1))
        return (nodes + moved, edges + updated) if self.residual else (moved, updated)

    def edge_update(self, nodes_i: Tensor, nodes_j: Tensor, edges: Tensor) -> Tensor:
        """The edge MLP on edge, receiver and sender; shape (..., E, width)."""
        return self.edge_mlp(torch.cat([edges, nodes_i, nodes_j], dim=-1))

    def message(self, edges: Tensor) -> Tensor:
        """What an edge sends is its updated feature."""
        return edges

    def rearranged(
        self, nodes: Tensor, edges: Tensor | Unapplied, adjacency: Adjacency
    ) -> tuple[Tensor, Tensor | Unapplied]:
        """The same by the algebra of this module's head; nodes (B, V, width), edges (B, E, width)."""
        first = self.edge_mlp.first
        own_weight, receiver_weight, sender_weight = first.weight.split(self.width, dim=1)
        if isinstance(edges, Unapplied):
            own = edges.into(own_weight, first.bias)
        else:
            own = affine(edges, own_weight, first.bias)
        spread = adjacency.spread(
            own, nn.functional.linear(nodes, receiver_weight), nn.functional.linear(nodes, sender_weight)
        )
        hidden = self.edge_mlp.layers(in_place(self.edge_mlp.rest[0])(spread), self.edge_mlp.linears[1:-1])
        updated = self.edge_mlp.ending(hidden)
        summed = updated.gathered(adjacency) if isinstance(updated, Unapplied) else adjacency.gather(updated)
        moved = value_of(self.node_mlp.ending(self.node_mlp.hidden(torch.cat([nodes, summed], dim=-1))))
        if self.residual:
            return nodes + moved, value_of(edges) + value_of(updated)
        return moved, updated


class EncodeProcessDecode(nn.Module):
    """Five MLPs: encoders of nodes and edges, edge and node updates of every message-passing step, decoder of nodes.

    Every layer and what is encoded is `hidden` wide; the layer normalisation comes after every MLP but the decoder.
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
        keep_freed_memory()
        self.encode_nodes = MLP(node_inputs, hidden, hidden_layers, hidden, layer_norm, activation)
        self.encode_edges = MLP(edge_inputs, hidden, hidden_layers, hidden, layer_norm, activation)
        process = nn.ModuleList(
            InteractionNetwork(hidden, hidden, hidden_layers, layer_norm, residual, activation)
            for _ in range(steps)
        )
        self.process = cast("Sequence[InteractionNetwork]", process)
        self.decode = MLP(hidden, hidden, hidden_layers, outputs, activation=activation)
        # The edges of the last call: a training or a rollout keeps them.
        self._known_adjacency: tuple[Tensor, Adjacency] | None = None

    @classmethod
    def of(
        cls, settings: ModelSettings, node_inputs: int, edge_inputs: int, outputs: int
    ) -> EncodeProcessDecode:
        """The network that the settings describe."""
        return cls(
            node_inputs,
            edge_inputs,
            outputs,
            settings.hidden_width,
            settings.hidden_layers,
            settings.message_passing_steps,
            settings.layer_norm,
            settings.residual,
            settings.activation,
        )

    def plain(self, nodes: Tensor, edges: Tensor, edge_index: Tensor) -> Tensor:
        """Node quantities (..., V, outputs) from a batch of graphs as defined: nodes (..., V, node_inputs), edges
        (..., E, edge_inputs), edge_index (2, E)."""
        nodes = self.encode_nodes(nodes)
        edges = self.encode_edges(edges)
        for step in self.process:
            nodes, edges = step(nodes, edges, edge_index)
        return self.decode(nodes)

    def forward(self, nodes: Tensor, edges: Tensor, edge_index: Tensor) -> Tensor:
        """`plain` to rounding, in less time and memory."""
        leading = nodes.shape[:-2]
        nodes, edges = nodes.reshape(-1, *nodes.shape[-2:]), edges.reshape(-1, *edges.shape[-2:])
        adjacency = self.adjacency(edge_index, nodes.shape[1])
        at_once = len(nodes)
        if nodes.device.type == "cpu" and not torch.is_grad_enabled():
            at_once = max(1, EDGES_AT_ONCE // max(1, edges.shape[1]))
        blocks = zip(nodes.split(at_once), edges.split(at_once), strict=True)
        decoded = torch.cat([self.rearranged(*block, adjacency) for block in blocks])
        return decoded.reshape(*leading, *decoded.shape[1:])

    def rearranged(self, nodes: Tensor, edges: Tensor, adjacency: Adjacency) -> Tensor:
        """`plain` by the algebra of this module's head; nodes (B, V, node_inputs), edges (B, E, edge_inputs)."""
        nodes = value_of(self.encode_nodes.ending(self.encode_nodes.hidden(nodes)))
        messages = self.encode_edges.ending(self.encode_edges.hidden(edges))
        for step in self.process:
            nodes, messages = step.rearranged(nodes, messages, adjacency)
        return value_of(self.decode.ending(self.decode.hidden(nodes)))

    def adjacency(self, edge_index: Tensor, node_count: int) -> Adjacency:
        """The edges as sums; looked at once per `edge_index` object."""
        known = self._known_adjacency  # looked up once: another thread may have other edges
        if known is None or known[0] is not edge_index:
            # What is made in inference mode could not be trained with later.
            with torch.inference_mode(False):
                known = self._known_adjacency = edge_index, adjacency_of(edge_index, node_count)
        return known[1]
