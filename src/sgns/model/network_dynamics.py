"""Latent dynamics as a graph network: history and next tool motion in, next state and force out; and one path stepped
quickly.

Shapes: B batch, d history positions, r modes, N body nodes, V = r + N nodes, E edges, K context numbers, T frames,
W = T - d + 1 windows.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from sgns.model.dynamics import Dynamics, Path, Standardiser, Step, Stepper, unrolled
from sgns.model.fast_step import GraphStepper
from sgns.model.features import BodyTrack, build_graph, edge_indices, free_axes, nearest_rigid
from sgns.model.network import EncodeProcessDecode
from sgns.settings import ModelSettings


class Prediction(NamedTuple):
    """What the network says of every node in one step, normalised [1], shape (B, V, 3) each; modes first.

    The change is the position's second difference, or with `model.predicts=velocity` its first; of a body node only
    what is free counts. Force and torque are what the node contributes to them.
    """

    change: Tensor
    force: Tensor
    torque: Tensor


class LatentDynamics(Dynamics):
    """Graph network on modes and body nodes, with the statistics that make its inputs and outputs of order one.

    Arguments as of `Dynamics`; every node is told the context. Of several members each has a network of its own: a
    batch is theirs in turn, in equal shares.
    """

    settings: ModelSettings
    free: Tensor
    others: Any  # what the members after the first have of their own

    def __init__(
        self,
        settings: ModelSettings,
        num_modes: int,
        context: tuple[str, ...] = (),
        predicts_body: bool = False,
        members: int = 1,
    ) -> None:
        super().__init__(settings, num_modes, context, predicts_body)
        pose = settings.body_nodes == "pose"
        motion = 6 if pose else 3
        place = 3 if settings.positions else 0
        motions = settings.history if settings.next_motion else settings.history - 1
        mode_width = place + 3 * (settings.history - 1)
        body_width = place + (6 if pose else 0) + motion * motions
        # A learned vector for each mode, or one for all of them, and one for the body's nodes.
        vectors = num_modes if settings.identity == "mode" else 1

        def learned() -> dict[str, nn.Module]:
            identity = nn.Embedding(vectors + 1, settings.identity_width)
            network = EncodeProcessDecode.of(
                settings,
                max(mode_width, body_width) + settings.identity_width + len(context),
                edge_inputs=4 if settings.edge_length else 3,
                outputs=9 if settings.torque else 6,
            )
            return {"identity": identity, "network": network}

        self.identity: nn.Embedding
        self.network: EncodeProcessDecode
        for name, part in learned().items():
            self.add_module(name, part)
        self.others = nn.ModuleList(nn.ModuleDict(learned()) for _ in range(members - 1))
        if members > 1:
            self.register_buffer("band", torch.ones(4, dtype=torch.float64))
        self.position = Standardiser.empty(num_modes, 3)
        self.velocity = Standardiser.empty(num_modes, 3)
        self.change = Standardiser.empty(num_modes, 3)
        self.body_position = Standardiser.empty(3)
        self.body_orientation = Standardiser.empty(6 if pose else 0)
        self.body_motion = Standardiser.empty(motion)
        self.body_change = Standardiser.empty(3)
        self.force = Standardiser.empty(3)
        self.torque = Standardiser.empty(3)
        self.context = Standardiser.empty(len(context))
        self.register_buffer("free", free_axes(predicts_body, settings.body_nodes), persistent=False)
        self._edges: dict[tuple[int, torch.device], Tensor] = {}

    @classmethod
    def from_card(cls, card: Mapping[str, Any], state: Mapping[str, Tensor]) -> LatentDynamics:
        model = card["model"]
        for key in ("hidden_layers", "message_passing_steps"):
            if model[key] > len(state):
                raise ValueError(f"model.{key} is {model[key]}, but there are {len(state)} tensors of it")
        told = tuple(map(str, card["context"])), bool(card["predicts_body"])
        if not 1 <= (members := int(card.get("members", 1))) <= len(state):
            raise ValueError(f"members is {members}, but there are {len(state)} tensors of them")
        arguments = ModelSettings(**model), int(card["num_modes"]), *told, members
        with torch.device("meta"):  # shapes without memory
            described = cls(*arguments).state_dict()
        for name, value in described.items():
            if state[name].shape != value.shape:
                raise ValueError(f"{name} has not the shape {tuple(value.shape)} that its card says")
        return cls(*arguments)

    def with_modes(self, num_modes: int) -> LatentDynamics:
        """As for all `Dynamics`; the weights are shared."""
        self.check_modes(num_modes)
        fewer = copy.copy(self)
        fewer._modules = dict(self._modules)
        fewer.num_modes, fewer._edges = num_modes, {}
        for name in ("position", "velocity", "change"):
            setattr(fewer, name, getattr(self, name)[:num_modes])

        def first(identity: nn.Embedding) -> nn.Embedding:
            weight = torch.cat([identity.weight[:num_modes], identity.weight[-1:]])
            return nn.Embedding.from_pretrained(weight, freeze=False)

        if self.settings.identity == "mode":
            fewer.identity = first(self.identity)
            fewer.others = nn.ModuleList(
                nn.ModuleDict(dict(other.items()) | {"identity": first(other["identity"])})
                for other in self.others
            )
        return fewer

    @property
    def members(self) -> int:
        return 1 + len(self.others)

    def card(self) -> dict[str, Any]:
        return super().card() | ({"members": self.members} if self.members > 1 else {})

    def member(self, index: int) -> LatentDynamics:
        if self.members == 1:
            return self
        alone = copy.copy(self)
        alone._modules = dict(self._modules)
        if index > 0:
            for name, part in self.others[index - 1].items():
                alone.add_module(name, part)
        alone.others = nn.ModuleList()
        return alone

    def forward(self, latent: Tensor, body: BodyTrack, context: Tensor | None = None) -> Prediction:
        """Predict one step of every window in a batch; arguments as for `advance`. The first windows are the first
        member's, the next ones the second's."""
        modes, nodes = latent.shape[-2], body.position.shape[-2]
        edge_index = self.edge_index(modes, nodes, latent.device)
        features, edges = build_graph(
            self._mode_features(latent),
            self.body_features(body),
            self._edge_positions(latent[:, -1], body.position[:, -2]),
            edge_index,
            self.settings.edge_length,
        )
        share = latent.shape[0] // self.members

        def shares(part: Tensor) -> Sequence[Tensor]:
            return part.split(share) if self.members > 1 else [part]

        contexts: Sequence[Tensor | None] = [None] * self.members
        if context is not None:
            contexts = shares(context)
        decoded = [
            member.network(
                torch.cat([own, member.told(modes, nodes, share, numbers)], dim=-1), own_edges, edge_index
            )
            for member, own, own_edges, numbers in zip(
                map(self.member, range(self.members)), shares(features), shares(edges), contexts, strict=True
            )
        ]
        return self.read(torch.cat(decoded))

    def read(self, decoded: Tensor) -> Prediction:
        """The prediction in what the network decodes, shape (B, V, 6 or 9)."""
        force = decoded[..., 3:6]
        torque = decoded[..., 6:] if self.settings.torque else torch.zeros_like(force)
        if self.settings.force == "mean":
            force, torque = force / decoded.shape[-2], torque / decoded.shape[-2]
        return Prediction(decoded[..., :3], force, torque)

    def _mode_features(self, latent: Tensor) -> Tensor:
        """Past velocities of the modes, and where they are: the bed does not move with the tool, so that places
        matter. Shape (B, r, any)."""
        velocity = self.velocity.normalise(latent[:, 1:] - latent[:, :-1]).permute(0, 2, 1, 3).flatten(2)
        if not self.settings.positions:
            return velocity
        return torch.cat([self.position.normalise(latent[:, -1]), velocity], dim=-1)

    def body_features(self, body: BodyTrack) -> Tensor:
        """Place, past motions and what is prescribed of the next one, shape (B, N, any)."""
        motion = self.body_motion.normalise(body.motion)
        if not self.settings.next_motion:
            motion = motion[:, :-1]
        elif self.predicts_body:
            known = torch.nn.functional.pad(1.0 - self.free, (0, motion.shape[-1] - 3), value=1.0)
            motion = torch.cat([motion[:, :-1], motion[:, -1:] * known.to(motion)], dim=1)
        parts = [
            self.body_orientation.normalise(body.orientation[:, -2]),
            motion.permute(0, 2, 1, 3).flatten(2),
        ]
        if self.settings.positions:
            parts.insert(0, self.body_position.normalise(body.position[:, -2]))
        return torch.cat(parts, dim=-1)

    def _edge_positions(self, modes: Tensor, body: Tensor) -> Tensor:
        """Positions of all nodes in the unit of the edges' features, shape (B, V, 3)."""
        if self.settings.edge_scale is not None:
            return (torch.cat([modes, body], dim=-2) / self.settings.edge_scale).to(self.position.shown)
        return torch.cat([self.position.normalise(modes), self.body_position.normalise(body)], dim=-2)

    def told(self, modes: int, nodes: int, batch: int, context: Tensor | None) -> Tensor:
        """What every node is told besides: who it is, and the context; shape (B, V, any)."""
        weight = self.identity.weight
        own = weight[:-1] if self.settings.identity == "mode" else weight[:1].expand(modes, -1)
        told = torch.cat([own, weight[-1:].expand(nodes, -1)]).expand(batch, -1, -1)
        if not self.context_keys:
            return told
        numbers = self.context.normalise(self.known_context(context))[:, None].expand(-1, modes + nodes, -1)
        return torch.cat([told, numbers], dim=-1)

    def advance(self, latent: Tensor, body: BodyTrack, context: Tensor | None = None) -> Step:
        """As for all `Dynamics`: z+ = z + (z - z-) + a, or z + v; a predicted body of points kept rigid if so set."""
        return self.stepped(self(latent, body, context), latent, body)

    def stepped(self, prediction: Prediction, latent: Tensor, body: BodyTrack) -> Step:
        """The step of a prediction, a predicted body of points kept rigid if it is to be."""
        step = self.taken(prediction, latent, body)
        if self.predicts_body and self.settings.rigid and self.settings.body_nodes == "points":
            here = body.position[:, -2]
            step = step._replace(displacement=nearest_rigid(here, here + step.displacement) - here)
        return step

    def taken(self, prediction: Prediction, latent: Tensor, body: BodyTrack) -> Step:
        """The step of a prediction, as it is."""
        # Every node carries 1/V of the mean, so that the sum over nodes, not the average, is the physical quantity.
        nodes = prediction.force.shape[-2]
        force = prediction.force.double() * self.force.scale + self.force.mean / nodes
        torque = prediction.torque.double() * self.torque.scale + self.torque.mean / nodes
        following = latent[:, -1] + self.change.denormalise(prediction.change[:, : self.num_modes])
        if self.settings.predicts == "acceleration":
            following = following + (latent[:, -1] - latent[:, -2])
        following = torch.clamp(following, *self.reach())
        displacement = body.motion[:, -1, :, :3]
        if self.predicts_body:
            displacement = torch.where(self.free > 0, self.body_displacement(prediction, body), displacement)
        return Step(following, force.sum(-2), torque.sum(-2), displacement)

    def latent_statistics(self) -> tuple[Tensor, Tensor]:
        return self.position.mean, self.position.scale

    def body_displacement(self, prediction: Prediction, body: BodyTrack) -> Tensor:
        """How the body nodes move in the network's eyes [m], on all axes, shape (B, N, 3)."""
        change = self.body_change.denormalise(prediction.change[:, self.num_modes :])
        return change + body.motion[:, -2, :, :3] if self.settings.predicts == "acceleration" else change

    def stepper(self, body_points: int, context: Tensor | None = None) -> PathStepper:
        """As for all `Dynamics`, but much faster than `advance`."""
        return PathStepper(self, 1 if self.settings.body_nodes == "pose" else body_points, context)

    def unroll(
        self, latent: Tensor, body: BodyTrack, context: Tensor | None = None, memory: Any = None
    ) -> Path:
        """As for all `Dynamics`; one path alone by the fast stepper."""
        if latent.shape[0] > 1 or torch.is_grad_enabled():
            return super().unroll(latent, body, context)
        stepper = self.stepper(body.position.shape[-2], context)
        if memory is not None:
            stepper.memory = memory
        if self.predicts_body:
            return unrolled(stepper.advance, latent, body, self.predicts_body)
        return stepper.unroll(latent, body)

    def edge_index(self, modes: int, body_nodes: int, device: torch.device) -> Tensor:
        """Senders and receivers, made once."""
        key = (body_nodes, device)
        if key not in self._edges:
            # What is made in inference mode could not be trained with later.
            with torch.inference_mode(False):
                self._edges[key] = edge_indices(
                    modes, body_nodes, self.settings.edges, self.settings.self_loops, device
                )
        return self._edges[key]


# --- One path: the features of `LatentDynamics` written into kept memory, the network by `GraphStepper` ---

# A body whose nodes keep their places among themselves to this share of the positions' unit has only been shifted.
_SHIFTED = 1e-6


class PathStepper(Stepper):
    """`LatentDynamics.advance` and `unroll` for one path and without gradients; to rounding (1e-6) the same.

    Copies, pickled ones too, are built anew from the dynamics as they are then (see `GraphStepper`) and go on to the
    bit as this one does.

    Args:
        dynamics: Its weights and statistics are copied.
        body_nodes: N.
        context: Numbers of the run, shape (1, K); not needed when K is 0.
    """

    dynamics: LatentDynamics

    def __init__(self, dynamics: LatentDynamics, body_nodes: int, context: Tensor | None = None) -> None:
        super().__init__(dynamics, context)
        self.body_nodes = body_nodes
        self.graph: GraphStepper | None = None
        # Places of the body's nodes from its first when the edges within it were last computed [1], shape (N, 3).
        self.shape: Tensor | None = None
        r, count = dynamics.num_modes, dynamics.num_modes + body_nodes
        self.edge_index = dynamics.edge_index(r, body_nodes, dynamics.force.mean.device)
        with torch.inference_mode():
            if GraphStepper.covers(dynamics.network):
                self.graph = GraphStepper(dynamics.network, self.edge_index, count, body_nodes)
            self.prepare_features(dynamics.told(r, body_nodes, 1, context)[0])
            self.prepare_outputs()

    def __reduce__(self) -> tuple[Any, ...]:
        state = None, {"memory": self.memory}  # in this form it is set as any attribute
        return PathStepper, (self.dynamics, self.body_nodes, self.context), state

    @property
    def memory(self) -> tuple[Tensor | None, Tensor | None]:
        """`shape`, and what was computed of the edges within the body then (see `GraphStepper`), shape (N, any, H);
        never overwritten, only replaced."""
        return self.shape, None if self.graph is None else self.graph.kept

    @memory.setter
    def memory(self, memory: tuple[Tensor | None, Tensor | None] | None) -> None:
        self.shape, kept = memory or (None, None)
        if self.graph is not None:
            self.graph.kept = kept

    def prepare_features(self, told: Tensor) -> None:
        """Memory of the network's inputs; what the nodes are told once, shape (V, any), stays in it."""
        dynamics, settings = self.dynamics, self.dynamics.settings
        r, d, count = dynamics.num_modes, dynamics.history, len(told)
        width = dynamics.network.encode_nodes.first.in_features
        self.nodes = told.new_zeros(count, width)
        self.nodes[:, width - told.shape[1] :] = told
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
        self.row_units = None
        by_numpy = self.nodes.device.type == "cpu" and self.nodes.dtype != torch.bfloat16
        if dynamics.settings.next_motion and not dynamics.predicts_body and by_numpy:
            row = Standardiser.cat([dynamics.body_position, dynamics.body_orientation, dynamics.body_motion])
            self.row_units = row.mean.numpy(), row.scale.numpy()
        self.accelerates = dynamics.settings.predicts == "acceleration"
        self.nearest, self.furthest = dynamics.reach()

    def windows(self, body: BodyTrack) -> tuple[Tensor, Tensor]:
        """Features of the nodes of the body (1, T, N, ...) in each of its windows of d frames [1], shape (W, N, any),
        and their places in the unit of the edges' features [1], float64, shape (W, N, 3)."""
        d, dynamics = self.dynamics.history, self.dynamics
        windows = BodyTrack(*(part[0].unfold(0, d, 1).movedim(-1, 1) for part in body))
        places = windows.position[:, -2]
        if dynamics.settings.edge_scale is None:
            places = (places - dynamics.body_position.mean) / dynamics.body_position.scale
        else:
            places = places / dynamics.settings.edge_scale
        return dynamics.body_features(windows), places

    def has_only_shifted(self, places: Tensor) -> bool:
        """Whether the body's nodes (N, 3) lie to each other as they last did when this was not so."""
        shape = places - places[0]
        known = self.shape
        # A path may go on from the memory of one under a tool with other points.
        alike = known is not None and known.shape == shape.shape
        if known is not None and alike and float((shape - known).abs().max()) <= _SHIFTED:
            return True
        self.shape = shape
        return False

    def decoded(self, latent: Tensor, features: Tensor, places: Tensor) -> Tensor:
        """What the network says of latent positions (d, r, 3) and of the body nodes' features (N, any) and places
        (N, 3), shape (V, 6 or 9); overwritten by the next call."""
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
        load = decoded[:, 3:].sum(0, dtype=torch.float64).mul_(self.load_scale).add_(self.load_mean)
        return following, load

    def advance(self, latent: Tensor, body: BodyTrack) -> Step:
        with torch.inference_mode():
            features, places = self.windows(body)
            decoded = self.decoded(latent[0], features[0], places[0])
            if self.dynamics.predicts_body:
                return self.dynamics.stepped(self.dynamics.read(decoded[None]), latent, body)
            return self.said(decoded, latent, body.motion[:, -1, :, :3])

    def step(self, latent: Tensor, rows: np.ndarray) -> Step:
        if self.row_units is None:
            return super().step(latent, rows)
        # As `windows`, by NumPy: its calls take a third of torch's time.
        settings, (mean, scale) = self.dynamics.settings, self.row_units
        motion = 9 if settings.body_nodes == "pose" else 3
        with np.errstate(over="ignore"):  # of a tool that is nowhere
            normal = (rows - mean) / scale
        places = normal[-2, :, :3] if settings.edge_scale is None else rows[-2, :, :3] / settings.edge_scale
        own = normal[-2, :, 0 if settings.positions else 3 : motion]
        moved = normal[:, :, motion:].transpose(1, 0, 2).reshape(len(own), -1)
        features = torch.from_numpy(np.concatenate([own, moved], axis=1)).float()
        with torch.inference_mode():
            decoded = self.decoded(latent[0], features, torch.from_numpy(places))
            return self.said(decoded, latent, torch.from_numpy(rows[None, -1, :, motion : motion + 3]))

    def said(self, decoded: Tensor, latent: Tensor, displacement: Tensor) -> Step:
        """The step under a prescribed body."""
        following, load = self.outcome(decoded, latent[0])
        torque = load[3:] if self.dynamics.settings.torque else self.dynamics.torque.mean
        return Step(following[None], load[None, :3], torque[None], displacement)

    def unroll(self, latent: Tensor, body: BodyTrack) -> Path:
        """A whole path along a prescribed body; arguments as for `Dynamics.unroll`, B = 1."""
        d, frames = latent.shape[1], body.position.shape[1]
        states = latent.new_empty((1, frames, *latent.shape[2:]), dtype=torch.float64)
        states[:, :d] = latent
        path = states[0]
        loads = self.load_mean.new_zeros(frames, len(self.load_mean))
        with torch.inference_mode():
            for t, features, places in zip(
                range(d, frames), *(part[1:] for part in self.windows(body)), strict=True
            ):
                seen = path[t - d : t]
                path[t], loads[t] = self.outcome(self.decoded(seen, features, places), seen)
        torque = loads[:, 3:]
        if not self.dynamics.settings.torque:
            torque = self.dynamics.torque.mean.repeat(frames, 1)
            torque[:d] = 0.0
        return Path(states, loads[None, :, :3], torque[None], body)
