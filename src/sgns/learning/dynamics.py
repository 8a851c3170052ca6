"""The dynamics of the latent soil under a prescribed tool: history and next tool motion in, next state and
force out.

Shapes: B batch, d history positions, r modes, N body nodes, V = r + N nodes, T frames.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from sgns.errors import UserError
from sgns.learning.body import BODY_NODES, BodyTrack
from sgns.learning.graph import build_graph, complete_graph
from sgns.learning.network import ACTIVATIONS, EncodeProcessDecode
from sgns.learning.normalisation import Standardiser

__all__ = ["LatentDynamics", "ModelSettings", "Prediction"]


@dataclass(frozen=True)
class ModelSettings:
    """What `conf/model` says; see there for the meaning of each key."""

    history: int
    body_nodes: str
    hidden_width: int
    hidden_layers: int
    message_passing_steps: int
    layer_norm: bool
    residual: bool
    activation: str
    identity_width: int

    def __post_init__(self) -> None:
        for key, low in (
            ("history", 2),
            ("hidden_width", 1),
            ("hidden_layers", 1),
            ("message_passing_steps", 1),
            ("identity_width", 0),
        ):
            if getattr(self, key) < low:
                raise UserError(f"model.{key} is {getattr(self, key)}; it must be at least {low}")
        for key, allowed in (("body_nodes", BODY_NODES), ("activation", tuple(ACTIVATIONS))):
            if getattr(self, key) not in allowed:
                raise UserError(f"model.{key} is {getattr(self, key)!r}; allowed: {', '.join(allowed)}")

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for a checkpoint."""
        return asdict(self)


class Prediction(NamedTuple):
    """What the network says of one step, normalised.

    Attributes:
        acceleration: Second difference of each mode [1], shape (B, r, 3).
        force: Contribution of every node [1], shape (B, V, 3).
        torque: Contribution of every node [1], shape (B, V, 3).
    """

    acceleration: Tensor
    force: Tensor
    torque: Tensor


class LatentDynamics(nn.Module):
    """Graph network on modes and body nodes, with the statistics that make its inputs and outputs of order
    one.

    Args:
        settings: What to build.
        num_modes: r.
    """

    def __init__(self, settings: ModelSettings, num_modes: int) -> None:
        super().__init__()
        self.settings = settings
        self.num_modes = num_modes
        pose = settings.body_nodes == "pose"
        motion = 6 if pose else 3
        mode_width = 3 * settings.history
        body_width = 3 + (6 if pose else 0) + motion * settings.history
        # Every mode is somebody: a learned vector each, and one for the body's nodes.
        self.identity = nn.Embedding(num_modes + 1, settings.identity_width)
        self.network = EncodeProcessDecode(
            max(mode_width, body_width) + settings.identity_width,
            4,
            9,
            settings.hidden_width,
            settings.hidden_layers,
            settings.message_passing_steps,
            settings.layer_norm,
            settings.residual,
            settings.activation,
        )
        self.position = Standardiser.empty(num_modes, 3)
        self.velocity = Standardiser.empty(num_modes, 3)
        self.acceleration = Standardiser.empty(num_modes, 3)
        self.body_position = Standardiser.empty(3)
        self.body_orientation = Standardiser.empty(6 if pose else 0)
        self.body_motion = Standardiser.empty(motion)
        self.force = Standardiser.empty(3)
        self.torque = Standardiser.empty(3)
        self._edges: dict[tuple[int, torch.device], Tensor] = {}

    @property
    def history(self) -> int:
        """d, positions of history."""
        return self.settings.history

    def forward(self, latent: Tensor, body: BodyTrack) -> Prediction:
        """Predict one step of every window in a batch.

        Args:
            latent: The last d latent positions, oldest first [m], float64, shape (B, d, r, 3).
            body: The d frames that end with the *next* one, the frame to be predicted; (B, d, N, ...).
        """
        velocity = latent[:, 1:] - latent[:, :-1]
        where, orientation, motion = body.position[:, -2], body.orientation[:, -2], body.motion
        batch, nodes = where.shape[:2]
        body_position = self.body_position.normalise(where)
        body_features = torch.cat(
            [
                body_position,
                self.body_orientation.normalise(orientation),
                self.body_motion.normalise(motion).permute(0, 2, 1, 3).flatten(2),
            ],
            dim=-1,
        )
        graph = build_graph(
            self.position.normalise(latent[:, -1]),
            self.velocity.normalise(velocity),
            body_position,
            body_features,
            self._edge_index(self.num_modes + nodes, latent.device),
        )
        identity = torch.cat([self.identity.weight[:-1], self.identity.weight[-1:].expand(nodes, -1)])
        node_inputs = torch.cat([graph.nodes, identity.expand(batch, -1, -1)], dim=-1)
        decoded = self.network(node_inputs, graph.edges, graph.edge_index)
        return Prediction(decoded[:, : self.num_modes, :3], decoded[..., 3:6], decoded[..., 6:])

    def force_contributions(self, prediction: Prediction) -> tuple[Tensor, Tensor]:
        """Force [N] and torque [N m] that each node adds; their sums over nodes are the force and the torque.

        Every node carries 1/V of the mean, so that the sum, not the average, is the physical quantity.

        Returns:
            Two float64 tensors of shape (B, V, 3).
        """
        count = prediction.force.shape[-2]
        return tuple(
            part.double() * standard.scale + standard.mean / count
            for part, standard in ((prediction.force, self.force), (prediction.torque, self.torque))
        )  # type: ignore[return-value]

    def advance(self, latent: Tensor, body: BodyTrack) -> tuple[Tensor, Tensor, Tensor]:
        """Take one step: z+ = z + (z - z-) + a.

        Args:
            latent: As for `forward`.
            body: As for `forward`.

        Returns:
            Next latent positions [m] (B, r, 3), force [N] (B, 3) and torque [N m] (B, 3), float64.
        """
        prediction = self(latent, body)
        acceleration = self.acceleration.denormalise(prediction.acceleration)
        force, torque = self.force_contributions(prediction)
        return 2 * latent[:, -1] - latent[:, -2] + acceleration, force.sum(-2), torque.sum(-2)

    def unroll(self, latent: Tensor, body: BodyTrack) -> tuple[Tensor, Tensor, Tensor]:
        """Follow whole tool paths from a given history, feeding predictions back.

        Args:
            latent: The first d latent positions of each path [m], shape (B, d, r, 3).
            body: The tool at all T frames, (B, T, N, ...).

        Returns:
            Latent positions (B, T, r, 3) whose first d frames are the given ones, force [N] and torque [N m],
            both (B, T, 3) and zero in the first d frames; float64.
        """
        d, frames = self.history, body.position.shape[1]
        states = torch.empty(
            (latent.shape[0], frames, *latent.shape[2:]), dtype=torch.float64, device=latent.device
        )
        states[:, :d] = latent
        force = torch.zeros((latent.shape[0], frames, 3), dtype=torch.float64, device=latent.device)
        torque = torch.zeros_like(force)
        for t in range(d, frames):
            window = body.frames(slice(t - d + 1, t + 1))
            states[:, t], force[:, t], torque[:, t] = self.advance(states[:, t - d : t], window)
        return states, force, torque

    def _edge_index(self, node_count: int, device: torch.device) -> Tensor:
        key = (node_count, device)
        if key not in self._edges:
            self._edges[key] = complete_graph(node_count, device)
        return self._edges[key]
