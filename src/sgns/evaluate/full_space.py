"""The reference without a reduction: the graph network on every particle, edges between near ones, and its windows.

Letters: B batch, d history positions, n particles, N body nodes, V = n + N nodes, E edges, T frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import warp as wp
from torch import Tensor, nn
from torch.nn.functional import pad
from tqdm import tqdm

from mpm_warp.launch import start_warp
from mpm_warp.poses import in_world_frame
from sgns.config import UserError
from sgns.data.run import Run
from sgns.model.dynamics import Standardiser
from sgns.model.features import BodyTrack, body_track
from sgns.model.network import EncodeProcessDecode
from sgns.model.settings import ModelSettings
from sgns.train.windows import random_walk

# --- Body nodes close enough together that soil particles cannot pass between them unseen ---------------


def box_surface(half_size: np.ndarray, spacing: float) -> np.ndarray:
    """Points on all six faces of a box, on a lattice that reaches its edges.

    Args:
        half_size: Half the sides of the box [m], shape (3,).
        spacing: Largest distance between neighbours along an axis [m].

    Returns:
        Points in the body frame [m], shape (N, 3), every one once.
    """
    half_size = np.asarray(half_size, dtype=np.float64)
    counts = np.maximum(np.ceil(2 * half_size / spacing - 1e-9).astype(int), 1) + 1
    index = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, 3)
    outside = ((index == 0) | (index == counts - 1)).any(axis=1)
    return (2 * index[outside] / (counts - 1) - 1) * half_size


# --- Which points are near each other: the edges of a graph in full space, found with Warp's hash grid --

# Cells per axis of the hash grid; what lies outside wraps around and is told apart by its distance.
_CELLS = 64


@wp.kernel(enable_backward=False)
def count_neighbours(
    grid: wp.uint64, points: wp.array(dtype=wp.vec3), radius: float, counts: wp.array(dtype=wp.int64)
):
    receiver = wp.tid()
    centre = points[receiver]
    query = wp.hash_grid_query(grid, centre, radius)
    sender = wp.int32(0)
    count = wp.int64(0)
    while wp.hash_grid_query_next(query, sender):
        offset = points[sender] - centre
        if sender != receiver and wp.dot(offset, offset) <= radius * radius:
            count += wp.int64(1)
    counts[receiver] = count


@wp.kernel(enable_backward=False)
def list_neighbours(
    grid: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    radius: float,
    ends: wp.array(dtype=wp.int64),
    senders: wp.array(dtype=wp.int64),
    receivers: wp.array(dtype=wp.int64),
):
    receiver = wp.tid()
    centre = points[receiver]
    place = wp.int64(0)
    if receiver > 0:
        place = ends[receiver - 1]
    query = wp.hash_grid_query(grid, centre, radius)
    sender = wp.int32(0)
    while wp.hash_grid_query_next(query, sender):
        offset = points[sender] - centre
        if sender != receiver and wp.dot(offset, offset) <= radius * radius:
            senders[place] = wp.int64(sender)
            receivers[place] = wp.int64(receiver)
            place += wp.int64(1)


def radius_graph(points: Tensor, radius: float) -> Tensor:
    """Every ordered pair of different points no further apart than a radius, receivers ascending.

    Distances are taken in float32 on the device of the points.

    Args:
        points: Positions [m], shape (V, 3).
        radius: [m].

    Returns:
        Senders in row 0 and receivers in row 1, int64, shape (2, E).

    Raises:
        UserError: The radius is not positive, or a position is not finite.
    """
    if not radius > 0:
        raise UserError(f"the radius of the neighbours is {radius}; it must be above 0 m")
    if not bool(torch.isfinite(points).all()):
        raise UserError(
            "positions are not finite, so they have no neighbours; the rollout ran away or the run is damaged"
        )
    if len(points) == 0:
        return torch.empty((2, 0), dtype=torch.int64, device=points.device)
    where = points.detach().float().contiguous()
    start_warp()
    # torch's stream, so that neither library reads what the other has not finished.
    stream = wp.stream_from_torch(where.device) if where.is_cuda else None
    with wp.ScopedDevice(wp.device_from_torch(where.device)), wp.ScopedStream(stream):
        array = wp.from_torch(where, dtype=wp.vec3)
        grid = wp.HashGrid(_CELLS, _CELLS, _CELLS)
        grid.build(array, radius)
        counts = torch.empty(len(where), dtype=torch.int64, device=where.device)
        wp.launch(count_neighbours, len(where), [grid.id, array, radius], [wp.from_torch(counts)])
        ends = counts.cumsum(0)
        edges = torch.empty((2, int(ends[-1])), dtype=torch.int64, device=where.device)
        if edges.shape[1]:
            out = [wp.from_torch(row) for row in edges]
            wp.launch(list_neighbours, len(where), [grid.id, array, radius, wp.from_torch(ends)], out)
    return edges


# --- The dynamics of every soil particle under a prescribed tool -----------------------------------------


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
        identity = self.identity.weight
        identity = torch.cat(
            [identity[:1].expand(soil.shape[2], -1), identity[1:].expand(motion.shape[1], -1)]
        )
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
        """Take one step, x+ = x + (x - x-) + a: next positions [m] (B, n, 3) and force [N] (B, 3), float64; arguments
        as for `forward`."""
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


# --- Its training windows, read from the run files as they are drawn, and its loss ------------------------


class FullSpaceBatch(NamedTuple):
    """Windows of one optimisation step; as `sgns.train.windows.Batch`, with particles in the place of modes.

    Attributes:
        position: Clean positions, the target last [m], float64, shape (B, d + 1, n, 3).
        noise: Offset added to the history [m], float64, shape (B, d, n, 3).
        body: The d frames that end with the target's, (B, d, N, ...).
        force: At the target frame [N], shape (B, 3).
    """

    position: Tensor
    noise: Tensor
    body: BodyTrack
    force: Tensor

    @property
    def history(self) -> Tensor:
        """What the network is shown: the noisy history [m], shape (B, d, n, 3)."""
        return self.position[:, :-1] + self.noise

    @property
    def acceleration(self) -> Tensor:
        """The target [m], shape (B, n, 3): it undoes the noise of the velocity and keeps that of the position."""
        shown = self.history
        return self.position[:, -1] + self.noise[:, -1] - 2 * shown[:, -1] + shown[:, -2]

    def to(self, device: torch.device) -> FullSpaceBatch:
        """The batch on another device."""
        body = BodyTrack(*(part.to(device) for part in self.body))
        return FullSpaceBatch(self.position.to(device), self.noise.to(device), body, self.force.to(device))


class FullSpaceRun:
    """The small series of a run, in memory; its soil stays in the file.

    Args:
        path: The run file.
        body_nodes: In the body frame [m], shape (N, 3); None: the body points that the run recorded.

    Attributes:
        track: The body at all T frames.
        force: By the soil on the body [N], shape (T, 3), float64.
        bin_size: Lx, Ly, Lz [m], shape (3,), float64.
    """

    def __init__(self, path: str | Path, body_nodes: np.ndarray | None = None) -> None:
        self.path = Path(path)
        with Run(path) as run:
            points = run.body_points if body_nodes is None else in_world_frame(run.pose, body_nodes)
            if points.shape[1] == 0:
                raise UserError(f"{path} has no body points; give body nodes of your own")
            self.track = body_track(run.pose, points, "points")
            self.force = torch.as_tensor(run.force)
            self.bin_size = torch.tensor(run.scene["bed"]["size"], dtype=torch.float64)
            self.arrangement_hash, self.frame_rate = run.arrangement_hash, run.frame_rate
            self.particle_count = run.particle_count

    def __len__(self) -> int:
        """T."""
        return len(self.force)

    def soil(self, frames: slice | np.ndarray = slice(None)) -> Tensor:
        """Particles [m] in the chosen frames, float64, shape (t, n, 3)."""
        with Run(self.path) as run:
            return torch.from_numpy(run.positions(frames)).double()


class FullSpaceWindows:
    """Windows drawn from a set of runs with replacement, every frame but the first of each being a target.

    Before frame 0 a run is at rest, as for the reduced windows.

    Args:
        runs: Of one bed.
        history: d.
        seed: Of order and noise.

    Raises:
        UserError: No runs, or runs that do not belong together.
    """

    def __init__(self, runs: Sequence[FullSpaceRun], history: int, seed: int = 0) -> None:
        if not runs or all(len(run) < 2 for run in runs):
            raise UserError(
                "there are no training runs of two frames or more; make some: sgns simulate dataset=quick"
            )
        for run in runs[1:]:
            one, other = (
                (r.arrangement_hash, r.frame_rate, r.track.position.shape[1], r.bin_size.tolist())
                for r in (runs[0], run)
            )
            if one != other:
                raise UserError(
                    f"{runs[0].path} and {run.path} differ in bed, frame rate or number of body nodes; train on runs "
                    "of one bed"
                )
        self.runs = list(runs)
        self.history = history
        self.seed = seed
        self.targets = [(run, frame) for run in self.runs for frame in range(1, len(run))]

    def __len__(self) -> int:
        """The number of windows."""
        return len(self.targets)

    def window(self, index: int) -> FullSpaceBatch:
        """One window without noise, B = 1."""
        run, target = self.targets[index]
        frames = np.maximum(np.arange(target - self.history, target + 1), 0)
        soil = run.soil(frames)[None]
        body = BodyTrack(*(part[None] for part in run.track.frames(torch.from_numpy(frames[1:]))))
        return FullSpaceBatch(soil, torch.zeros_like(soil[:, :-1]), body, run.force[None, target])

    def batch(self, step: int, size: int, noise_scale: Tensor) -> FullSpaceBatch:
        """The batch of an optimisation step from 0, a function of (seed, step) and nothing else; `noise_scale` is the
        deviation of the newest velocity's noise [m], shape (3,)."""
        source = torch.Generator().manual_seed(
            int(np.random.SeedSequence([self.seed, step]).generate_state(1)[0])
        )
        drawn = torch.randint(len(self), (size,), generator=source).tolist()
        windows = [self.window(index) for index in drawn]
        body = BodyTrack(*(torch.cat(parts) for parts in zip(*(w.body for w in windows), strict=True)))
        soil, force = (torch.cat([getattr(w, name) for w in windows]) for name in ("position", "force"))
        noise = random_walk(noise_scale.expand(soil.shape[2], 3), (size, self.history), source)
        return FullSpaceBatch(soil, noise, body, force)


def losses(dynamics: FullSpaceDynamics, batch: FullSpaceBatch) -> tuple[Tensor, Tensor]:
    """Squared errors of the normalised acceleration, mean over particles, and of the normalised force; the batch is
    taken to the device of the dynamics."""
    batch = batch.to(dynamics.bin_size.device)
    prediction = dynamics(batch.history, batch.body)
    acceleration = prediction.acceleration - dynamics.acceleration.normalise(batch.acceleration)
    force = dynamics.force.normalise(dynamics.force_contributions(prediction).sum(-2))
    force = force - dynamics.force.normalise(batch.force)
    return acceleration.square().sum(-1).mean(), force.square().sum(-1).mean()
