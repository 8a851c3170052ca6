"""The reference without a reduction: the graph network on every particle, edges between near ones, and its windows.

Letters: B batch, d history positions, n particles, N body nodes, V = n + N nodes, E edges, T frames.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor, nn
from torch.nn.functional import pad

from mpm_warp.poses import in_world_frame
from sgns.config import UserError
from sgns.data.run import Run
from sgns.evaluate.costs import forget_peak, peak_memory
from sgns.evaluate.results import FullSpaceCost
from sgns.model.dynamics import Standardiser
from sgns.model.features import BodyTrack, body_track
from sgns.model.network import EncodeProcessDecode
from sgns.numbers import elapsed
from sgns.rollout import single_thread
from sgns.settings import ModelSettings
from sgns.train.windows import random_walk


def box_surface(half_size: np.ndarray, spacing: float) -> np.ndarray:
    """Points on all six faces of a box, on a lattice that reaches its edges: body nodes close enough together that soil
    particles cannot pass between them unseen.

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


def radius_graph(points: Tensor, radius: float) -> Tensor:
    """Every ordered pair of different points (V, 3) [m] no further apart than a radius [m], receivers ascending.

    Returns:
        Senders in row 0 and receivers in row 1, int64, shape (2, E).
    """
    pairs = KDTree(points.detach().numpy()).query_pairs(radius, output_type="ndarray")
    edges = np.concatenate([pairs, pairs[:, ::-1]]).T
    return torch.from_numpy(edges[:, np.lexsort(edges)])


# --- The dynamics of every soil particle under a prescribed tool -----------------------------------------


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
        self.history = settings.history
        """d, positions of history."""
        self.radius = radius
        self.register_buffer("bin_size", bin_size.double())
        self.identity = nn.Embedding(2, settings.identity_width)
        inputs = 3 * settings.history + 5 + settings.identity_width
        self.network = EncodeProcessDecode.of(settings, inputs, edge_inputs=4, outputs=6)
        self.velocity = Standardiser.empty(3)
        self.acceleration = Standardiser.empty(3)
        self.body_motion = Standardiser.empty(3)
        self.force = Standardiser.empty(3)

    def forward(self, soil: Tensor, body: BodyTrack) -> tuple[Tensor, Tensor]:
        """Predict one step of every window in a batch.

        Args:
            soil: The last d positions of the particles, oldest first [m], float64, shape (B, d, n, 3).
            body: The d frames that end with the *next* one, the frame to be predicted; (B, d, N, ...).

        Returns:
            Second difference of each particle's position, normalised [1], (B, n, 3), and the force that every node
            adds, soil first [N], float64, (B, V, 3).
        """
        where = torch.cat([soil[:, -1], body.position[:, -2]], dim=1)
        batch, nodes, count = *where.shape[:2], soil.shape[2]
        # The graphs of a batch differ in their edges, so they are one large graph of separate parts.
        parts = [radius_graph(one, self.radius) + b * nodes for b, one in enumerate(where)]
        sender, receiver = edge_index = torch.cat(parts, dim=1)
        position = where.flatten(0, 1)
        relative = (position[sender] - position[receiver]).div_(self.radius).float()
        edges = torch.cat([relative, torch.linalg.vector_norm(relative, dim=-1, keepdim=True)], dim=-1)
        features = self.node_features(soil, body, where).flatten(0, 1)
        decoded = self.network(features, edges, edge_index).unflatten(0, (batch, -1))
        # A force is scaled by the number of nodes of its kind: the bed has a thousand times the nodes that touch the
        # tool, and without this their small errors would add up to more than the force.
        share = torch.full((nodes, 1), 1 / count, dtype=torch.float64)
        share[count:] = 1 / (nodes - count)
        forces = decoded[..., 3:].double() * share * self.force.scale + self.force.mean / nodes
        return decoded[:, :count, :3], forces

    def node_features(self, soil: Tensor, body: BodyTrack, where: Tensor) -> Tensor:
        """Motions, distances to the walls and identity [1], shape (B, V, features), soil first.

        The motion into the next frame is known for the body only; that of the soil is zero.
        """
        velocity = self.velocity.normalise(soil.diff(dim=1)).permute(0, 2, 1, 3).flatten(2)
        motion = self.body_motion.normalise(body.motion).permute(0, 2, 1, 3).flatten(2)
        moving = torch.cat([pad(velocity, (0, 3)), motion], dim=1)
        low, high = where[..., :2], self.bin_size[:2] - where[..., :2]
        floor = where[..., 2:] + self.bin_size[2]
        walls = (torch.cat([low, high, floor], dim=-1) / self.radius).clamp(-1.0, 1.0).float()
        kind = torch.arange(where.shape[1]) >= soil.shape[2]
        return torch.cat([moving, walls, self.identity(kind.long()).expand(len(soil), -1, -1)], dim=-1)

    def advance(self, soil: Tensor, body: BodyTrack) -> tuple[Tensor, Tensor]:
        """Take one step, x+ = x + (x - x-) + a: next positions [m] (B, n, 3) and force [N] (B, 3), float64; arguments
        as for `forward`."""
        acceleration, forces = self(soil, body)
        following = 2 * soil[:, -1] - soil[:, -2] + self.acceleration.denormalise(acceleration)
        return following, forces.sum(-2)


# --- Its training windows, read from the run files as they are drawn, and its loss ------------------------


class FullSpaceBatch(NamedTuple):
    """Windows of one optimisation step; as `sgns.train.windows.Batch`, with particles in the place of modes."""

    position: Tensor  # clean positions, the target last [m], float64, shape (B, d + 1, n, 3)
    noise: Tensor  # offset added to the history [m], float64, shape (B, d, n, 3)
    body: BodyTrack  # the d frames that end with the target's, (B, d, N, ...)
    force: Tensor  # at the target frame [N], shape (B, 3)

    @property
    def history(self) -> Tensor:
        """What the network is shown: the noisy history [m], shape (B, d, n, 3)."""
        return self.position[:, :-1] + self.noise

    @property
    def acceleration(self) -> Tensor:
        """The target [m], shape (B, n, 3): it undoes the noise of the velocity and keeps that of the position."""
        shown = self.history
        return self.position[:, -1] + self.noise[:, -1] - 2 * shown[:, -1] + shown[:, -2]


class FullSpaceRun:
    """The small series of a run, in memory; its soil stays in the file.

    Attributes:
        track: The body at all T frames: nodes given in the body frame [m], (N, 3), else the recorded body points.
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
            self.frame_rate = run.frame_rate

    def __len__(self) -> int:
        """T."""
        return len(self.force)

    def soil(self, frames: slice | np.ndarray = slice(None)) -> Tensor:
        """Particles [m] in the chosen frames, float64, shape (t, n, 3)."""
        with Run(self.path) as run:
            return torch.from_numpy(run.positions(frames)).double()


class FullSpaceWindows:
    """Windows of d positions of history drawn from runs of one bed with replacement; every frame but the first is a
    target, and before frame 0 a run is at rest. `seed` is that of order and noise.
    """

    def __init__(self, runs: Sequence[FullSpaceRun], history: int, seed: int = 0) -> None:
        self.runs, self.history, self.seed = list(runs), history, seed
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
        soil, force = torch.cat([w.position for w in windows]), torch.cat([w.force for w in windows])
        noise = random_walk(noise_scale.expand(soil.shape[2], 3), (size, self.history), source)
        return FullSpaceBatch(soil, noise, body, force)


def losses(dynamics: FullSpaceDynamics, batch: FullSpaceBatch) -> tuple[Tensor, Tensor]:
    """Squared errors of the normalised acceleration, mean over particles, and of the normalised force."""
    predicted, forces = dynamics(batch.history, batch.body)
    acceleration = predicted - dynamics.acceleration.normalise(batch.acceleration)
    force = dynamics.force.normalise(forces.sum(-2)) - dynamics.force.normalise(batch.force)
    return acceleration.square().sum(-1).mean(), force.square().sum(-1).mean()


# --- What the same network would cost on every particle: the paper's comparison, measured on this machine
# Costs do not depend on what a network has learned, so an untrained one is timed.

_BATCH = 2  # windows of a training step, the paper's
_REACH = 4 / 3  # radius of the neighbourhood in particle spacings: 6 neighbours in a bed at rest


def full_space_cost(path: Path, settings: ModelSettings, repeats: int) -> FullSpaceCost:
    """Time and memory of a step, with the tool half-way along a run; medians of repeats after one to warm up.

    The network's body has nodes on its surface whatever `body_nodes` says.
    """
    with Run(path) as run:
        spacing = float(np.prod(run.scene["bed"]["size"]) / run.particle_count) ** (1 / 3)
        blade = run.scene.get("blade")
    # Nodes of a blade as close together as particles, so that none slips between them; of other bodies as recorded.
    nodes = None
    if blade is not None:
        nodes = box_surface(np.array([blade["thickness"], blade["width"], blade["length"]]) / 2, spacing)
    one_run = FullSpaceRun(path, nodes)
    dynamics = FullSpaceDynamics(replace(settings, body_nodes="points"), _REACH * spacing, one_run.bin_size)
    windows = FullSpaceWindows([one_run], dynamics.history)
    window = windows.window(len(windows) // 2)
    still = torch.zeros(3, dtype=torch.float64)

    def training_step() -> None:
        dynamics.zero_grad()
        acceleration, force = losses(dynamics, windows.batch(0, _BATCH, still))
        (acceleration + force).backward()

    with single_thread():
        with torch.inference_mode():
            frame = wall_time(lambda: dynamics.advance(window.history, window.body), repeats)
        forget_peak()
        step = wall_time(training_step, repeats)
    return FullSpaceCost(
        parameters=sum(weight.numel() for weight in dynamics.parameters()),
        training_step=step,
        batch_size=_BATCH,
        rollout=frame * one_run.frame_rate,
        peak_bytes=peak_memory(),
    )


def wall_time(action: Callable[[], object], repeats: int) -> float:
    """Median after one call to warm up [s]."""
    action()
    found = []
    for _ in range(repeats):
        began = time.perf_counter()
        action()
        found.append(elapsed(began, time.perf_counter()))
    return statistics.median(found)
