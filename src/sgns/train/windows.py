"""Training windows of reduced runs, and the scales of all quantities in them."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from sgns.config import UserError
from sgns.model.dynamics import Standardiser
from sgns.model.features import BodyTrack, body_track, context_of, free_axes
from sgns.model.network_dynamics import LatentDynamics

if TYPE_CHECKING:
    import lightning as L

    from sgns.reduction.reduce import ReducedRun


# --- Training windows: d positions of history and h targets, all in memory, drawn from (seed, step) alone
# Shapes: B batch, d history positions, h steps of the horizon, r modes, N body nodes, K context numbers, W windows,
# F stacked frames of all runs.

# Streams of random numbers that must not be the same.
_SAMPLING, _NOISE, _BODY_NOISE = 0, 1, 2


class NoiseScales(NamedTuple):
    """Deviations of the newest velocity's noise."""

    latent: Tensor  # of the modes [m], shape (r, 3)
    body: Tensor  # of the body nodes [m], shape (3,); zero along axes that are prescribed


class Batch(NamedTuple):
    """Windows of one optimisation step; [m] in float64."""

    latent: Tensor  # clean latent positions, the targets last [m], shape (B, d + h, r, 3)
    noise: Tensor  # offset added to the history [m], shape (B, d, r, 3)
    body: BodyTrack  # the d - 1 + h frames that end with the last target's, clean, (B, d - 1 + h, N, ...)
    body_noise: Tensor  # offset added to the body in the history [m], shape (B, d, N, 3)
    force: Tensor  # at the target frames [N], shape (B, h, 3)
    torque: Tensor  # at the target frames [N m], shape (B, h, 3)
    context: Tensor  # of the runs, shape (B, K)

    @property
    def horizon(self) -> int:
        """h, steps to be predicted."""
        return self.force.shape[1]

    @property
    def history(self) -> Tensor:
        """What the network is shown: the noisy history [m], shape (B, d, r, 3)."""
        return self.latent[:, : -self.horizon] + self.noise

    @property
    def shown_body(self) -> BodyTrack:
        """The body with the noise of the history; later frames go on from its newest offset."""
        later = self.body_noise[:, -1:].expand(-1, self.horizon, -1, -1)
        return self.body.displaced(torch.cat([self.body_noise, later], dim=1))

    @property
    def following(self) -> Tensor:
        """Where the modes are to go [m], shape (B, h, r, 3).

        The clean next positions moved by the newest noise: the network learns to undo errors of the velocity and lets
        those of the position be, as in Sanchez-Gonzalez et al. 2020 (arXiv:2002.09405, appendix B).
        """
        return self.latent[:, -self.horizon :] + self.noise[:, -1:]


class TrainingWindows:
    """Every window of a set of runs, which may have more than the `num_modes` modes that are used.

    Each run is preceded by d - 1 copies of its frame 0, so that starts at rest are among the windows and
    every frame but the first is a target. `context` are keys of the scene whose numbers go with every window.
    """

    def __init__(
        self,
        runs: Sequence[ReducedRun],
        num_modes: int,
        history: int,
        body_nodes: str,
        seed: int = 0,
        horizon: int = 1,
        context: Sequence[str] = (),
    ) -> None:
        self.history, self.horizon, self.seed = history, horizon, seed
        for run in runs:
            require_finite(run)

        def stacked(parts: Iterable[np.ndarray | Tensor]) -> Tensor:
            return torch.cat([pad_start(torch.as_tensor(part), history - 1) for part in parts])

        self.latent = stacked(run.latent[:, :num_modes] for run in runs)
        self.force = stacked(run.force for run in runs)
        self.torque = stacked(run.torque for run in runs)
        tracks = [body_track(run.pose, run.body_points, body_nodes) for run in runs]
        self.body = BodyTrack(*(stacked(filled(parts)) for parts in zip(*tracks, strict=True)))
        self.body_nodes = torch.tensor([track.position.shape[1] for track in tracks])
        lengths = [history - 1 + len(run.latent) for run in runs]
        self.of_run = torch.arange(len(runs)).repeat_interleave(torch.tensor(lengths))
        # Frames of a run with a whole history before them and the rest of the horizon after them.
        whole = [torch.arange(length) for length in lengths]
        self.targets = torch.cat([(f >= history) & (f <= len(f) - horizon) for f in whole]).nonzero()[:, 0]
        self.context = torch.as_tensor(np.stack([context_of(run.scene, context) for run in runs]))
        if len(self.targets) == 0:
            raise UserError(
                f"the training runs are too short for training.horizon={horizon}: they need {horizon + 1} frames"
            )
        # Windows of one batch have the same number of body nodes.
        nodes = self.body_nodes[self.of_run[self.targets]]
        self.groups = [self.targets[nodes == count] for count in nodes.unique()]

    def __len__(self) -> int:
        """W, the number of windows."""
        return len(self.targets)

    def windows(self, targets: Tensor, noise: tuple[Tensor, Tensor] | None = None) -> Batch:
        """The windows whose first targets are the given stacked frames, shape (B,), of runs with the same number of
        body nodes; without noise unless the offsets of modes and body are given."""
        frames = targets[:, None] + torch.arange(-self.history, self.horizon)
        latent = self.latent[frames]
        nodes = int(self.body_nodes[self.of_run[targets[0]]])
        body = BodyTrack(*(part[frames[:, 1:], :nodes] for part in self.body))
        if noise is None:
            shown = len(targets), self.history
            noise = latent.new_zeros(*shown, *latent.shape[2:]), latent.new_zeros(*shown, nodes, 3)
        last = frames[:, self.history :]
        context = self.context[self.of_run[targets]]
        return Batch(latent, noise[0], body, noise[1], self.force[last], self.torque[last], context)

    def batch(self, step: int, size: int, noise: NoiseScales, share: Tensor | None = None) -> Batch:
        """The batch of an optimisation step from 0: a function of (seed, step) and nothing else, so that resuming
        changes nothing; of its windows those with the numbers `share`, if that is given."""
        chance = generator(self.seed, step, _SAMPLING)
        sizes = torch.tensor([float(len(group)) for group in self.groups])
        group = self.groups[int(torch.multinomial(sizes, 1, generator=chance))]
        targets = group[torch.randint(len(group), (size,), generator=chance)]
        nodes = int(self.body_nodes[self.of_run[targets[0]]])
        shape = (size, self.history)
        offsets = random_walk(noise.latent, shape, generator(self.seed, step, _NOISE))
        body_offsets = random_walk(
            noise.body.expand(nodes, 3), shape, generator(self.seed, step, _BODY_NOISE)
        )
        if share is not None:
            targets, offsets, body_offsets = targets[share], offsets[share], body_offsets[share]
        return self.windows(targets, (offsets, body_offsets))


def require_finite(run: ReducedRun) -> None:
    """Refuses a run of which one number would spoil everything that is learned; the line says where it is."""
    series = {
        "the soil's modes are": run.latent,
        "the body's pose is": run.pose,
        "the body's points are": run.body_points,
        "the force is": run.force,
        "the torque is": run.torque,
    }
    for what, values in series.items():
        bad = ~np.isfinite(values).reshape(len(values), -1).all(axis=1)
        if bad.any():
            raise UserError(
                f"{what} not finite at frame {int(bad.argmax())} of the reduced run {run.name}; check the run with: "
                f"sgns check {run.name}.h5, and simulate it again, or remove it"
            )


def filled(parts: Sequence[Tensor]) -> list[Tensor]:
    """Series of body nodes (T, N, K) filled up with NaN to the largest N."""
    most = max(part.shape[1] for part in parts)
    return [torch.nn.functional.pad(part, (0, 0, 0, most - part.shape[1]), value=torch.nan) for part in parts]


def pad_start(values: Tensor, count: int) -> Tensor:
    """`count` copies of the first row (frame) put before all rows."""
    return torch.cat([values[:1].expand(count, *values.shape[1:]), values])


def generator(seed: int, index: int, stream: int) -> torch.Generator:
    """A generator that depends on its arguments only."""
    state = np.random.SeedSequence([seed, index, stream]).generate_state(1, np.uint64)[0]
    return torch.Generator().manual_seed(int(state) & (2**63 - 1))


def random_walk(scale: Tensor, shape: tuple[int, int], source: torch.Generator) -> Tensor:
    """Noise on histories of `shape` (B, d) whose velocity errors add up, as those of a rollout do.

    `scale` (r or N, 3) is the deviation of the newest velocity's noise [m]. Returns offsets [m], float64, shape
    (B, d, r or N, 3); zero at the oldest position.
    """
    batch, d = shape
    steps = torch.randn((batch, d - 1, *scale.shape), generator=source, dtype=torch.float64)
    velocity = torch.cumsum(steps * scale / (d - 1) ** 0.5, dim=1)
    return torch.nn.functional.pad(torch.cumsum(velocity, dim=1), (0, 0, 0, 0, 1, 0))


class WindowLoader:
    """Batches without end, from the step that a trainer, resumed or not, stands at.

    Everything is in memory and a batch is a few tensor look-ups, so there are no worker processes.
    """

    def __init__(
        self, windows: TrainingWindows, batch_size: int, noise: NoiseScales, share: Tensor | None = None
    ) -> None:
        self.training_windows = windows
        self.batch_size = batch_size
        self.noise = noise
        self.share = share
        self.trainer: L.Trainer | None = None

    def __iter__(self) -> Iterator[Batch]:
        first = 0 if self.trainer is None else self.trainer.global_step
        for step in itertools.count(first):
            yield self.training_windows.batch(step, self.batch_size, self.noise, self.share)


# --- Scales of all quantities, from the training windows, and of the noise that is added to them --------
# Shapes: r modes, N body nodes, F stacked frames of all runs.


def fit_normalisation(
    dynamics: LatentDynamics,
    windows: TrainingWindows,
    noise: float,
    noise_unit: str,
    scales: str,
    floor: float,
) -> NoiseScales:
    """Give the dynamics the statistics of the training windows.

    Modes differ by more than an order of magnitude. "per_mode" gives every mode and axis its scale; velocities and
    their changes keep their zero, which means rest. "pooled" has a mean and a scale for each axis, over all modes and
    points of the body together, as the paper does.

    `noise` is the deviation of the velocity noise, by `noise_unit` a share of the velocity scale of each mode and axis
    or in metres; the deviations of modes and body are returned. No scale is below the share `floor` of the quantity's
    largest.
    """
    targets = windows.targets
    position, velocity, change = motions(windows.latent, targets)
    body_position, body_velocity, body_change = map(nodes, motions(windows.body.position, targets))
    motion = nodes(windows.body.motion[targets])
    if scales == "pooled":
        # Rigid points and modes together; the pose node's rotation has a scale of its own.
        pose = dynamics.settings.body_nodes == "pose"
        dynamics.position, dynamics.body_position = pooled(position, body_position)
        dynamics.velocity, moved = pooled(velocity, body_velocity)
        turned = Standardiser.fit(motion[:, 3:], floor, centred=True)
        dynamics.body_motion = Standardiser.cat([moved, turned]) if pose else moved
        clean, body_clean = pooled(change, body_change)
    else:
        dynamics.position = Standardiser.fit(position, floor)
        dynamics.velocity = Standardiser.fit(velocity, floor, centred=False)
        dynamics.body_position = Standardiser.fit(body_position, floor)
        # Displacement [m] and rotation [rad] have their own largest scale each.
        parts = motion.split(3, dim=-1)
        dynamics.body_motion = Standardiser.cat(
            Standardiser.fit(part, floor, centred=False) for part in parts
        )
        clean = Standardiser.fit(change, floor, centred=False)
        # No floor here: a wheel rises and sinks far less than it drives, and that little is to be predicted.
        body_clean = Standardiser.fit(body_change, centred=False)
        moved = Standardiser.fit(body_velocity, centred=False)

    free = free_axes(dynamics.predicts_body, dynamics.settings.body_nodes)
    if noise_unit == "metre":
        scale = NoiseScales(torch.full_like(dynamics.velocity.scale, noise), noise * free)
    else:
        scale = NoiseScales(noise * dynamics.velocity.scale, noise * moved.scale * free)
    if dynamics.settings.predicts == "velocity":
        dynamics.change, dynamics.body_change = dynamics.velocity, moved
    else:
        # The target contains the correction of the velocity's noise; without either it would be constant.
        dynamics.change = widened(clean, scale.latent)
        dynamics.body_change = widened(body_clean, scale.body)
    dynamics.body_orientation = Standardiser.fit(nodes(windows.body.orientation[targets - 1]), floor)
    dynamics.force = Standardiser.fit(windows.force[targets], floor)
    dynamics.torque = Standardiser.fit(windows.torque[targets], floor)
    dynamics.context = Standardiser.fit(windows.context[windows.of_run[targets]])
    return scale


def motions(position: Tensor, targets: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Where things are before the given frames, their velocity into them, and how that changes; (W, r or N, 3)."""
    velocity = position[targets] - position[targets - 1]
    return position[targets - 1], velocity, velocity - (position[targets - 1] - position[targets - 2])


def nodes(values: Tensor) -> Tensor:
    """All body nodes one below the other, those that fill up to the largest number left out; (W N, K)."""
    flat = values.flatten(0, 1)
    return flat[~flat.isnan().any(-1)]


def pooled(modes: Tensor, body: Tensor) -> tuple[Standardiser, Standardiser]:
    """One mean and scale per axis over all nodes, for the modes (r, 3) and for a body node (3,)."""
    both = Standardiser.fit(torch.cat([modes.flatten(0, 1), body]))
    count = modes.shape[1]
    return Standardiser(both.mean.expand(count, 3), both.scale.expand(count, 3)), both


def widened(clean: Standardiser, noise: Tensor) -> Standardiser:
    """The scale of a change together with the correction of the noise."""
    return Standardiser(clean.mean, (clean.scale.square() + noise.square()).sqrt())
