"""Products and sums that the network is made of, in their fastest forms."""

from __future__ import annotations

from typing import Any, Protocol

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

# --- A linear layer, with or without ReLU, through the faster of the two matrix libraries that torch has on
# torch multiplies float32 matrices on the CPU with the BLAS it was built with. oneDNN, which it also holds, is as
# fast on some processors and twice as fast on others (experiments/rollout_speed), and applies bias and ReLU on
# the way.

# Below this many multiplications a product is over before oneDNN has begun.
_WORTH_IT = 2**22
# Rows whose products with each other are summed at once: more fall out of the cache, and take many times as long.
_ROWS_AT_ONCE = 2048
_AVAILABLE = torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_linear_pointwise")


def affine(x: Tensor, weight: Tensor, bias: Tensor, relu: bool = False) -> Tensor:
    """x Wᵀ + b, then ReLU if asked for; the function of `torch.nn.functional.linear`, to rounding.

    Args:
        x: Shape (..., inputs).
        weight: Shape (outputs, inputs).
        bias: Shape (outputs,).
        relu: Whether negative values become zero.

    Returns:
        Shape (..., outputs).
    """
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
# Shapes: B batch, V nodes, E edges, H width.


class Pairs(Protocol):
    """The edges of a graph, as two linear maps."""

    @property
    def degree(self) -> int | Tensor:
        """Edges that each node receives: a number, or one per node, shape (V, 1)."""

    def spread(self, edges: Tensor, receiver: Tensor, sender: Tensor) -> Tensor:
        """Each edge's own value plus that of its receiver and that of its sender.

        Args:
            edges: Shape (B, E, H); may be overwritten.
            receiver: Shape (B, V, H).
            sender: Shape (B, V, H).

        Returns:
            Shape (B, E, H).
        """

    def gather(self, edges: Tensor) -> Tensor:
        """Sum of the edges at their receivers, (B, E, H) to (B, V, H)."""


class CompletePairs:
    """Every ordered pair of nodes, receivers ascending: no index is needed.

    Args:
        node_count: V.
        self_loops: Whether a node is its own neighbour, too.
    """

    def __init__(self, node_count: int, self_loops: bool) -> None:
        self.node_count = node_count
        self.self_loops = self_loops

    @property
    def degree(self) -> int:
        """V, or V - 1 without self loops."""
        return self.node_count - (not self.self_loops)

    def spread(self, edges: Tensor, receiver: Tensor, sender: Tensor) -> Tensor:
        """As `Pairs.spread`, in place."""
        return _Spread.apply(edges, receiver, sender, self)

    def gather(self, edges: Tensor) -> Tensor:
        """As `Pairs.gather`."""
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
    """`CompletePairs.spread`: written by hand because it overwrites the edges instead of copying them twice."""

    @staticmethod
    def forward(ctx: Any, edges: Tensor, receiver: Tensor, sender: Tensor, pairs: CompletePairs) -> Tensor:
        ctx.pairs = pairs
        ctx.mark_dirty(edges)
        pairs.by_receiver(edges).add_(receiver[:, :, None])
        pairs.by_turn(edges).add_(pairs.senders(sender))
        return edges

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor, None]:
        gradient = gradient.contiguous()
        return gradient, ctx.pairs.gather(gradient), ctx.pairs.sum_at_senders(gradient), None


class IndexedPairs:
    """Any set of edges.

    Args:
        edge_index: Senders and receivers, shape (2, E).
        node_count: V.
    """

    def __init__(self, edge_index: Tensor, node_count: int) -> None:
        self.sender, self.receiver = edge_index
        self.node_count = node_count
        self.degree = torch.bincount(self.receiver, minlength=node_count)[:, None]

    def spread(self, edges: Tensor, receiver: Tensor, sender: Tensor) -> Tensor:
        """As `Pairs.spread`."""
        return edges + receiver.index_select(1, self.receiver) + sender.index_select(1, self.sender)

    def gather(self, edges: Tensor) -> Tensor:
        """As `Pairs.gather`."""
        empty = edges.new_zeros(len(edges), self.node_count, edges.shape[-1])
        return empty.index_add(1, self.receiver, edges)


def pairs_of(edge_index: Tensor, node_count: int) -> Pairs:
    """The quickest form of these edges; they are those of a complete graph only in its order."""
    for self_loops in (False, True):
        # Their number first: a graph of all particles has few edges, and all pairs of its nodes take tens of GB.
        if node_count < 2 or edge_index.shape[1] != node_count * (node_count - (not self_loops)):
            continue
        index = torch.arange(node_count, device=edge_index.device)
        receiver, sender = torch.meshgrid(index, index, indexing="ij")
        keep = (receiver != sender) | self_loops
        if torch.equal(edge_index, torch.stack([sender[keep], receiver[keep]])):
            return CompletePairs(node_count, self_loops)
    return IndexedPairs(edge_index, node_count)
