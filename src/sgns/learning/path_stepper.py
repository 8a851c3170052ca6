"""One path, stepped quickly: the features of `LatentDynamics` written into kept memory, the network by
`GraphStepper`.

Shapes: d history positions, r modes, N body nodes, V = r + N nodes, E edges, T frames, W = T - d + 1 windows.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from sgns.learning.body import BodyTrack
from sgns.learning.graph_stepper import GraphStepper
from sgns.learning.prediction import Step

if TYPE_CHECKING:
    from sgns.learning.dynamics import LatentDynamics

__all__ = ["PathStepper"]

# A body whose nodes keep their places among themselves to this share of the positions' unit has only been shifted.
_SHIFTED = 1e-6


class Known(NamedTuple):
    """What is known of the body, for every window.

    Attributes:
        features: Of its nodes [1], shape (W, N, any).
        places: Of its nodes in the unit of the edges' features [1], float64, shape (W, N, 3).
    """

    features: Tensor
    places: Tensor


class Memory(NamedTuple):
    """What is kept from one step to the next; never overwritten, only replaced.

    Attributes:
        shape: Places of the body's nodes from its first when the edges within it were last computed [1], shape (N, 3).
        kept: What was computed of these edges (see `GraphStepper`), shape (N, any, H).
    """

    shape: Tensor | None
    kept: Tensor | None


class PathStepper:
    """`LatentDynamics.advance` and `unroll` for one path and without gradients; to rounding (1e-6) the same.

    Copies, pickled ones too, are built anew from the dynamics as they are then (see `GraphStepper`) and go on to the
    bit as this one does.

    Args:
        dynamics: Its weights and statistics are copied.
        body_nodes: N.
        context: Numbers of the run, shape (1, K); not needed when K is 0.
    """

    def __init__(self, dynamics: LatentDynamics, body_nodes: int, context: Tensor | None = None) -> None:
        self.arguments = dynamics, body_nodes, context
        self.dynamics = dynamics
        network, r = dynamics.network, dynamics.num_modes
        count = r + body_nodes
        self.edge_index = dynamics.edge_index(r, body_nodes, dynamics.force.mean.device)
        self.graph: GraphStepper | None = None
        with torch.inference_mode():
            if GraphStepper.covers(network):
                self.graph = GraphStepper(network, self.edge_index, count, body_nodes)
            self.prepare_features(dynamics.told(r, body_nodes, 1, context)[0])
            self.prepare_outputs()
        self.reset()

    def __getstate__(self) -> tuple[tuple[Any, ...], Memory]:
        return self.arguments, self.memory

    def __setstate__(self, state: tuple[tuple[Any, ...], Memory]) -> None:
        arguments, memory = state
        PathStepper.__init__(self, *arguments)
        self.memory = memory

    @property
    def memory(self) -> Memory:
        """All that a step depends on of those before it, besides what it is given."""
        return Memory(self.shape, None if self.graph is None else self.graph.kept)

    @memory.setter
    def memory(self, memory: Memory) -> None:
        self.shape = memory.shape
        if self.graph is not None:
            self.graph.kept = memory.kept

    def reset(self) -> None:
        """Forget the shape of the body seen last: what follows does not depend on what was stepped before."""
        self.shape: Tensor | None = None

    def prepare_features(self, told: Tensor) -> None:
        """Memory of the network's inputs; what the nodes are told once, shape (V, any), stays in it."""
        dynamics, settings = self.dynamics, self.dynamics.settings
        r, d = dynamics.num_modes, dynamics.history
        first, count = dynamics.network.encode_nodes.first, len(told)
        self.nodes = told.new_zeros(count, first.in_features)
        self.nodes[:, first.in_features - told.shape[1] :] = told
        place = 3 if settings.positions else 0
        columns = self.nodes[:r, place : place + 3 * (d - 1)]
        self.velocity_features = columns.unflatten(1, (d - 1, 3)).transpose(0, 1)
        self.velocity = dynamics.velocity.mean.new_empty(d - 1, r, 3)
        # Positions of all nodes and, as a product with them, of every edge's sender relative to its receiver.
        self.positions = told.new_empty(count, 3)
        self.mode_positions, self.places = self.positions[:r], self.positions[r:]
        self.position_features = self.nodes[:r, :3] if settings.positions else None
        self.body_rows = self.nodes[r:]
        self.velocity_mean, self.velocity_scale = dynamics.velocity.mean, dynamics.velocity.scale
        self.position_mean, self.position_scale = dynamics.position.mean, dynamics.position.scale
        self.edge_scale, self.edge_length = settings.edge_scale, settings.edge_length
        sender, receiver = torch.nn.functional.one_hot(self.edge_index, count).to(told)
        self.difference = sender - receiver
        edges = told.new_empty(4 if settings.edge_length else 3, len(sender))
        self.edges, self.relative, self.length = edges.t(), edges[:3].t(), edges[3:].flatten()
        self.squares = edges.new_empty(3, len(sender))

    def prepare_outputs(self) -> None:
        """Units of what the network decodes: the sum over nodes of forces and torques side by side."""
        dynamics = self.dynamics
        share = len(self.nodes) if dynamics.settings.force == "mean" else 1
        loads = [dynamics.force, *([dynamics.torque] if dynamics.settings.torque else [])]
        self.load_scale = torch.cat([load.scale for load in loads]) / share
        self.load_mean = torch.cat([load.mean for load in loads])
        self.change_mean, self.change_scale = dynamics.change.mean, dynamics.change.scale
        self.accelerates = dynamics.settings.predicts == "acceleration"
        self.nearest, self.furthest = dynamics.reach()

    def known(self, body: BodyTrack) -> Known:
        """What is known of the body (1, T, N, ...) in each of its windows of d frames."""
        d, dynamics = self.dynamics.history, self.dynamics
        windows = BodyTrack(*(part[0].unfold(0, d, 1).movedim(-1, 1) for part in body))
        places = windows.position[:, -2]
        if dynamics.settings.edge_scale is None:
            places = (places - dynamics.body_position.mean) / dynamics.body_position.scale
        else:
            places = places / dynamics.settings.edge_scale
        return Known(dynamics.body_features(windows), places)

    def has_only_shifted(self, places: Tensor) -> bool:
        """Whether the body's nodes (N, 3) lie to each other as they last did when this was not so."""
        shape = places - places[0]
        if self.shape is not None and float((shape - self.shape).abs().max()) <= _SHIFTED:
            return True
        self.shape = shape
        return False

    def decoded(self, latent: Tensor, features: Tensor, places: Tensor) -> Tensor:
        """What the network says, shape (V, 6 or 9); overwritten by the next call.

        Args:
            latent: Shape (d, r, 3).
            features: Of the body nodes, shape (N, any).
            places: Of the body nodes, shape (N, 3).
        """
        newest = latent[-1]
        torch.sub(latent[1:], latent[:-1], out=self.velocity)
        torch.div(self.velocity - self.velocity_mean, self.velocity_scale, out=self.velocity_features)
        position = (newest - self.position_mean).div_(self.position_scale)
        if self.position_features is not None:
            self.position_features.copy_(position)
        self.mode_positions.copy_(position if self.edge_scale is None else newest / self.edge_scale)
        self.places.copy_(places)
        self.body_rows[:, : features.shape[1]].copy_(features)
        torch.mm(self.difference, self.positions, out=self.relative)
        if self.edge_length:
            torch.mul(self.relative.t(), self.relative.t(), out=self.squares)
            torch.sum(self.squares, 0, out=self.length).sqrt_()
        if self.graph is None:
            return self.dynamics.network(self.nodes[None], self.edges[None], self.edge_index)[0]
        same_body = len(places) > 1 and self.has_only_shifted(places)
        return self.graph(self.nodes, self.edges, same_body)

    def outcome(self, decoded: Tensor, latent: Tensor) -> tuple[Tensor, Tensor]:
        """Next latent positions [m] (r, 3), and force [N] and torque [N m] side by side, (6,) or (3,)."""
        following = decoded[: len(self.change_scale), :3] * self.change_scale
        following.add_(self.change_mean).add_(latent[-1])
        if self.accelerates:
            following.add_(self.velocity[-1])
        torch.clamp(following, self.nearest, self.furthest, out=following)
        return following, decoded[:, 3:].sum(0, dtype=torch.float64).mul_(self.load_scale).add_(
            self.load_mean
        )

    def advance(self, latent: Tensor, body: BodyTrack) -> Step:
        """One step; latent (1, d, r, 3), body (1, d, N, ...) as for `LatentDynamics.forward`."""
        with torch.inference_mode():
            known = self.known(body)
            decoded = self.decoded(latent[0], known.features[0], known.places[0])
            if self.dynamics.predicts_body:
                return self.dynamics.stepped(self.dynamics.read(decoded[None]), latent, body)
            following, load = self.outcome(decoded, latent[0])
            torque = load[3:] if self.dynamics.settings.torque else self.dynamics.torque.mean
            return Step(following[None], load[None, :3], torque[None], body.motion[:, -1, :, :3])

    def follow(self, states: Tensor, body: BodyTrack) -> Tensor:
        """Steps along a prescribed body.

        Args:
            states: Latent positions [m], float64, shape (T, r, 3), whose first d frames are given; filled.
            body: Shape (1, T, N, ...).

        Returns:
            Force [N] and torque [N m] of frames d to T - 1, shape (T - d, 6), or (T - d, 3) of a network without
            torque.
        """
        d = self.dynamics.history
        self.reset()
        with torch.inference_mode():
            known = self.known(body)
            loads = self.load_mean.new_empty(len(states) - d, len(self.load_mean))
            for k, (features, places) in enumerate(zip(known.features[1:], known.places[1:], strict=True)):
                latent = states[k : k + d]
                states[k + d], loads[k] = self.outcome(self.decoded(latent, features, places), latent)
            return loads
