"""The dynamics of every soil particle under a prescribed tool: the network of the latent dynamics on a graph
of near particles.

Shapes: B batch, d history positions, n particles, N body nodes, V = n + N nodes, E edges, T frames.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import pad
from tqdm import tqdm

from sgns.errors import UserError
from sgns.full_space.neighbours import radius_graph
from sgns.learning.body import BodyTrack
from sgns.learning.dynamics import ModelSettings
from sgns.learning.network import EncodeProcessDecode
from sgns.learning.normalisation import Standardiser

__all__ = ["FullSpaceDynamics", "FullSpacePrediction"]


class FullSpacePrediction(NamedTuple):
    """What the network says of one step, normalised.

    Attributes:
        acceleration: Second difference of each particle's position [1], shape (B, n, 3).
        force: Contribution of every node to the force [1], shape (B, V, 3), soil first: in units of the force's
            deviation divided by the number of nodes of its kind.
    """

    acceleration: Tensor
    force: Tensor


class FullSpaceDynamics(nn.Module):
    """Graph network on all particles and on body nodes, edges between nodes within a radius.

    Positions enter as differences between neighbours and as distances to the walls of the bin, cut off at the
    radius; so far from the walls nothing depends on the place, as in Sanchez-Gonzalez et al. 2020
    (arXiv:2002.09405).

    Args:
        settings: As for the latent dynamics; `identity_width` is that of the learned vectors of soil and body.
        radius: Of the neighbourhood [m].
        bin_size: Lx, Ly, Lz of the bin [m], shape (3,).
    """

    bin_size: Tensor

    def __init__(self, settings: ModelSettings, radius: float, bin_size: Tensor) -> None:
        super().__init__()
        if settings.body_nodes != "points":
            raise UserError(
                f"model.body_nodes is {settings.body_nodes!r}; a node acts on the soil near it, so full space "
                "needs model.body_nodes=points"
            )
        self.settings = settings
        self.radius = radius
        self.register_buffer("bin_size", bin_size.double())
        self.identity = nn.Embedding(2, settings.identity_width)
        self.network = EncodeProcessDecode(
            3 * settings.history + 5 + settings.identity_width,
            4,
            6,
            settings.hidden_width,
            settings.hidden_layers,
            settings.message_passing_steps,
            settings.layer_norm,
            settings.residual,
            settings.activation,
        )
        self.velocity = Standardiser.empty(3)
        self.acceleration = Standardiser.empty(3)
        self.body_motion = Standardiser.empty(3)
        self.force = Standardiser.empty(3)

    @property
    def history(self) -> int:
        """d, positions of history."""
        return self.settings.history

    def forward(self, soil: Tensor, body: BodyTrack) -> FullSpacePrediction:
        """Predict one step of every window in a batch.

        Args:
            soil: The last d positions of the particles, oldest first [m], float64, shape (B, d, n, 3).
            body: The d frames that end with the *next* one, the frame to be predicted; (B, d, N, ...).
        """
        batch, count = soil.shape[0], soil.shape[2]
        position = torch.cat([soil[:, -1], body.position[:, -2]], dim=1)
        # The graphs of a batch differ in their edges, so they are one large graph of separate parts.
        edge_index = torch.cat(
            [radius_graph(one, self.radius) + b * position.shape[1] for b, one in enumerate(position)], dim=1
        )
        nodes = self.node_features(soil, body).flatten(0, 1)
        decoded = self.network(nodes, self.edge_features(position.flatten(0, 1), edge_index), edge_index)
        decoded = decoded.unflatten(0, (batch, -1))
        return FullSpacePrediction(decoded[:, :count, :3], decoded[..., 3:])

    def node_features(self, soil: Tensor, body: BodyTrack) -> Tensor:
        """Motions, distances to the walls and identity [1], shape (B, V, features), soil first.

        The motion into the next frame is known for the body only; that of the soil is zero.
        """
        velocity = self.velocity.normalise(soil[:, 1:] - soil[:, :-1]).permute(0, 2, 1, 3).flatten(2)
        motion = self.body_motion.normalise(body.motion).permute(0, 2, 1, 3).flatten(2)
        moving = torch.cat([pad(velocity, (0, 3)), motion], dim=1)
        where = torch.cat([soil[:, -1], body.position[:, -2]], dim=1)
        low, high = where[..., :2], self.bin_size[:2] - where[..., :2]
        floor = where[..., 2:] + self.bin_size[2]
        walls = (torch.cat([low, high, floor], dim=-1) / self.radius).clamp(-1.0, 1.0).float()
        kinds = self.identity.weight
        identity = torch.cat([kinds[:1].expand(soil.shape[2], -1), kinds[1:].expand(motion.shape[1], -1)])
        return torch.cat([moving, walls, identity.expand(len(soil), -1, -1)], dim=-1)

    def edge_features(self, position: Tensor, edge_index: Tensor) -> Tensor:
        """Sender's place relative to the receiver's and its distance, in radii [1], shape (E, 4)."""
        sender, receiver = edge_index
        relative = (position[sender] - position[receiver]).div_(self.radius).float()
        return torch.cat([relative, torch.linalg.vector_norm(relative, dim=-1, keepdim=True)], dim=-1)

    def force_contributions(self, prediction: FullSpacePrediction) -> Tensor:
        """Force that each node adds [N], float64, shape (B, V, 3); their sum is the force.

        A contribution is scaled by the number of nodes of its kind: the bed has a thousand times the nodes that
        touch the tool, and without this their small errors would add up to more than the force.
        """
        count, nodes = prediction.acceleration.shape[-2], prediction.force.shape[-2]
        share = torch.full((nodes, 1), 1 / count, dtype=torch.float64, device=prediction.force.device)
        share[count:] = 1 / (nodes - count)
        return prediction.force.double() * share * self.force.scale + self.force.mean / nodes

    def advance(self, soil: Tensor, body: BodyTrack) -> tuple[Tensor, Tensor]:
        """Take one step: x+ = x + (x - x-) + a.

        Args:
            soil: As for `forward`.
            body: As for `forward`.

        Returns:
            Next positions [m] (B, n, 3) and force [N] (B, 3), float64.
        """
        prediction = self(soil, body)
        acceleration = self.acceleration.denormalise(prediction.acceleration)
        following = 2 * soil[:, -1] - soil[:, -2] + acceleration
        return following, self.force_contributions(prediction).sum(-2)

    def unroll(self, soil: Tensor, body: BodyTrack, progress: bool = False) -> tuple[Tensor, Tensor]:
        """Follow whole tool paths from a given history, feeding predictions back.

        Args:
            soil: The first d positions of each path [m], shape (B, d, n, 3).
            body: The tool at all T frames, (B, T, N, ...).
            progress: Whether to show a bar.

        Returns:
            Positions [m] (B, T, n, 3) whose first d frames are the given ones, and force [N] (B, T, 3), zero in the
            first d frames; float64.
        """
        d, frames = self.history, body.position.shape[1]
        states = soil.new_empty((soil.shape[0], frames, *soil.shape[2:]))
        states[:, :d] = soil
        force = soil.new_zeros((soil.shape[0], frames, 3))
        for t in tqdm(range(d, frames), desc="full space", unit="frame", leave=False, disable=not progress):
            states[:, t], force[:, t] = self.advance(
                states[:, t - d : t], body.frames(slice(t - d + 1, t + 1))
            )
        return states, force
