"""Encode, pass messages, decode: the graph network of the paper (section 3.3), batched over graphs of one
topology.

Every part is written twice. `forward` of `MLP` and `InteractionNetwork` and `EncodeProcessDecode.plain` are the
definition. What `EncodeProcessDecode.forward` runs is the same function by exact algebra:

- the first layer of the edge update is linear, so its receiver and sender blocks are applied to the V nodes and
  not to the E edges, and its edge block can be multiplied into the last layer of whatever made the edges;
- the last layer of the edge update is linear, so it is applied to the V sums and not to the E edges;
- a complete graph needs no index: senders and receivers are broadcast (`adjacency`);
- without gradients batches go through in blocks, so that memory is bounded and stays in the cache.

A layer normalisation stands in the way of the second, and of the multiplication in the first; the rest holds.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch_geometric.nn import MessagePassing

from sgns.model.algebra import Adjacency, adjacency_of, affine

ACTIVATIONS: dict[str, type[nn.Module]] = {"relu": nn.ReLU, "silu": nn.SiLU, "gelu": nn.GELU, "tanh": nn.Tanh}
# Edges that go through the network at once on a CPU when nothing is kept for gradients.
EDGES_AT_ONCE = 4096


def keep_freed_memory() -> None:
    """Have glibc keep the memory of a few megabytes that one step frees for the next.

    By default it goes back to the system and comes again page by page, which takes a third of a training step. The
    size up to which memory is kept follows the largest block freed so far, at most 32 MB (mallopt(3),
    M_MMAP_THRESHOLD): one such block is enough, and it is never touched.
    """
    torch.empty(2**25 - 2**16, dtype=torch.uint8)


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

    def activate(self, x: Tensor) -> Tensor:
        """The activation; ReLU overwrites `x`."""
        activation = self.rest[0]
        return x.relu_() if isinstance(activation, nn.ReLU) else activation(x)

    def layer(self, x: Tensor, linear: nn.Linear) -> Tensor:
        """A linear layer and the activation."""
        relu = isinstance(self.rest[0], nn.ReLU)
        y = affine(x, linear.weight, linear.bias, relu)
        return y if relu else self.rest[0](y)

    def hidden(self, x: Tensor) -> Tensor:
        """The last hidden layer, (..., inputs) to (..., hidden)."""
        for linear in self.linears[:-1]:
            x = self.layer(x, linear)
        return x

    def hidden_after_first(self, x: Tensor) -> Tensor:
        """The last hidden layer from what the first linear layer gives, which is overwritten."""
        x = self.activate(x)
        for linear in self.linears[1:-1]:
            x = self.layer(x, linear)
        return x

    def ending(self, hidden: Tensor) -> Tensor | Unapplied:
        """The output from the last hidden layer; where the last step is linear it is left for later."""
        last = self.linears[-1]
        unapplied = Unapplied(hidden, last.weight, last.bias)
        return unapplied if self.norm is None else self.norm(unapplied.value())


class Unapplied(NamedTuple):
    """A linear layer together with its input: it may be multiplied with the next, or moved behind a sum.

    Attributes:
        hidden: Input, shape (..., hidden).
        weight: Shape (outputs, hidden).
        bias: Shape (outputs,).
    """

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

    for the edge from sender j to receiver i.

    Args:
        width: Of node and edge features.
        hidden: Width of the hidden layers of each MLP.
        hidden_layers: Their number.
        layer_norm: Whether updates are layer-normalised.
        residual: Whether updates are added to what they update.
        activation: Between layers.

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
        updated = self.edge_updater(edge_index, nodes=nodes, edges=edges)
        count = nodes.shape[-2]
        summed = self.propagate(edge_index, edges=updated, size=(count, count))
        moved = self.node_mlp(torch.cat([nodes, summed], dim=-1))
        if self.residual:
            return nodes + moved, edges + updated
        return moved, updated

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
        own = (
            edges.into(own_weight, first.bias)
            if isinstance(edges, Unapplied)
            else affine(edges, own_weight, first.bias)
        )
        spread = adjacency.spread(
            own, nn.functional.linear(nodes, receiver_weight), nn.functional.linear(nodes, sender_weight)
        )
        updated = self.edge_mlp.ending(self.edge_mlp.hidden_after_first(spread))
        summed = updated.gathered(adjacency) if isinstance(updated, Unapplied) else adjacency.gather(updated)
        moved = value_of(self.node_mlp.ending(self.node_mlp.hidden(torch.cat([nodes, summed], dim=-1))))
        if self.residual:
            return nodes + moved, value_of(edges) + value_of(updated)
        return moved, updated


class EncodeProcessDecode(nn.Module):
    """Five MLPs: encoders of nodes and edges, edge and node updates of every message-passing step, decoder of nodes.

    Every layer and what is encoded is `hidden` wide; the layer normalisation comes after every MLP but the decoder.

    Shapes:
        nodes (..., V, node_inputs), edges (..., E, edge_inputs), edge_index (2, E). Returns (..., V, outputs).
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
        self.process = nn.ModuleList(
            InteractionNetwork(hidden, hidden, hidden_layers, layer_norm, residual, activation)
            for _ in range(steps)
        )
        self.decode = MLP(hidden, hidden, hidden_layers, outputs, activation=activation)
        # The edges of the last call: a training or a rollout keeps them.
        self._known_adjacency: tuple[Tensor, Adjacency] | None = None

    def plain(self, nodes: Tensor, edges: Tensor, edge_index: Tensor) -> Tensor:
        """Node quantities from a batch of graphs, as defined."""
        nodes = self.encode_nodes(nodes)
        edges = self.encode_edges(edges)
        for step in self.process:
            nodes, edges = step(nodes, edges, edge_index)
        return self.decode(nodes)

    def forward(self, nodes: Tensor, edges: Tensor, edge_index: Tensor) -> Tensor:
        """Node quantities from a batch of graphs: `plain` to rounding, in less time and memory."""
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


# --- Mean and scale of a quantity on the training windows, kept with the model --------------------------


class Standardiser(nn.Module):
    """Shift and scale a quantity to zero mean and unit deviation, in float64.

    Latent positions are large and their differences tiny, so the subtraction happens before anything becomes
    float32.

    Args:
        mean: Mean of the quantity [its unit], any shape that broadcasts against the quantity.
        scale: Deviation of the quantity [its unit], same shape, positive.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self, mean: Tensor, scale: Tensor) -> None:
        super().__init__()
        self.register_buffer("mean", mean.double().clone())
        self.register_buffer("scale", scale.double().clone())

    @classmethod
    def fit(cls, samples: Tensor, floor: float = 0.0, centred: bool = True) -> Standardiser:
        """Statistics over the first dimension; a quantity that never varies gets scale one.

        Args:
            samples: Training values [unit], shape (samples, ...).
            floor: Smallest scale as a share of the largest one; a direction in which (almost) nothing happens, such as
                the lateral one by symmetry, keeps a small normalised value instead of being blown up.
            centred: Whether the mean is subtracted; without it zero stays zero and the scale is the root mean square.
        """
        samples = samples.double()
        if samples[0].numel() == 0:
            return cls.empty(*samples.shape[1:])
        mean = samples.mean(0) if centred else torch.zeros_like(samples[0])
        scale = (samples - mean).square().mean(0).sqrt()
        largest = float(scale.max())
        # Round-off of a constant is not variation: below 1e-12 of the values themselves the scale is one.
        if largest <= 1e-12 * float(samples.abs().max()) or largest == 0.0:
            return cls(mean, torch.ones_like(scale))
        return cls(mean, scale.clamp_min(max(floor, 1e-9) * largest))

    def __getitem__(self, index: slice | Tensor) -> Standardiser:
        """Of a part of the quantity."""
        return Standardiser(self.mean[index], self.scale[index])

    @classmethod
    def cat(cls, parts: Iterable[Standardiser]) -> Standardiser:
        """Of several quantities side by side."""
        return cls(*(torch.cat(values) for values in zip(*((p.mean, p.scale) for p in parts), strict=True)))

    @classmethod
    def empty(cls, *shape: int) -> Standardiser:
        """A neutral one of the given shape, to be filled from a checkpoint."""
        return cls(torch.zeros(shape, dtype=torch.float64), torch.ones(shape, dtype=torch.float64))

    def normalise(self, value: Tensor) -> Tensor:
        """Value in deviations from the mean [1], float32, same shape."""
        return ((value - self.mean) / self.scale).float()

    def denormalise(self, value: Tensor) -> Tensor:
        """Back to the quantity's unit, float64, same shape."""
        return value.double() * self.scale + self.mean
