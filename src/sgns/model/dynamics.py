"""The interface of all latent dynamics, the network's and the polynomials': steps, and paths of them; and the
normalisation of what they see and say.

Shapes: B batch, d history positions, r modes, N body nodes, V = r + N nodes, K context numbers, T frames.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from mpm_warp.poses import fitted_poses, in_world_frame
from sgns.config import UserError
from sgns.model.features import BodyTrack, Pace, body_track, markers, pose_step, step_frames
from sgns.numbers import is_whole
from sgns.settings import ModelSettings, PolynomialSettings

# No latent position goes further than this from its mean, in deviations; training runs stay within about half of it. It
# keeps a rollout finite that has left everything the dynamics know.
_REACH = 10.0


class Standardiser(nn.Module):
    """Shift and scale a quantity to zero mean and unit deviation, in float64; kept with the model.

    Latent positions are large and their differences tiny, so the subtraction happens before anything becomes
    float32.

    Args:
        mean: Mean of the quantity [its unit], any shape that broadcasts against the quantity.
        scale: Deviation of the quantity [its unit], same shape, positive.

    Attributes:
        shown: Type of what a network is shown.
    """

    mean: Tensor
    scale: Tensor
    shown = torch.float32

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
        """Value in deviations from the mean [1], of the type `shown`, same shape."""
        return ((value - self.mean) / self.scale).to(self.shown)

    def denormalise(self, value: Tensor) -> Tensor:
        """Back to the quantity's unit, float64, same shape."""
        return value.double() * self.scale + self.mean


COVERED = 0.9
"""Share of the truth that a band is to hold."""


def together(members: np.ndarray, band: np.ndarray | float) -> tuple[np.ndarray, np.ndarray | None]:
    """Mean of what some members say (m, ...) and half the width of their band; of one alone what it says, and None."""
    if len(members) == 1:
        return members[0], None
    return members.mean(axis=0), band * members.std(axis=0, ddof=1)


def fitted_band(members: np.ndarray, truth: np.ndarray) -> float:
    """How many deviations of the members (m, ...) to both sides of their mean hold the share `COVERED` of the truth
    (...); what they agree on to the bit, or what is not finite, does not count."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.abs(members.mean(axis=0) - truth) / members.std(axis=0, ddof=1)
    ratio = ratio[np.isfinite(ratio)]
    return float(np.quantile(ratio, COVERED)) if ratio.size else 1.0


class Step(NamedTuple):
    """One step in physical units, float64. The displacement is the prescribed one, with what is predicted in its place
    along the free axes."""

    latent: Tensor  # next positions [m], shape (B, r, 3)
    force: Tensor  # on the body [N], shape (B, 3)
    torque: Tensor  # on the body [N m], shape (B, 3)
    displacement: Tensor  # of the body nodes [m], shape (B, N, 3)


class Path(NamedTuple):
    """A whole path, float64. The first d frames hold the given positions and no force or torque."""

    latent: Tensor  # positions [m], shape (B, T, r, 3)
    force: Tensor  # [N], shape (B, T, 3)
    torque: Tensor  # [N m], shape (B, T, 3)
    body: BodyTrack  # at all frames, predicted where it is free


class Place(NamedTuple):
    """Where bed and tool are as one member of dynamics has them: all that its next steps follow from.

    Attributes:
        poses: Of the tool in the d frames that the soil last took a step into, (7,) each; none: it is nowhere yet.
        latent: Positions in these frames [m], shape (d, r, 3).
        force: Over the last step [N], shape (3,).
        torque: [N m], shape (3,).
        slow: Frames since the tool was last not slow (see `Pace`); None: the soil always steps, or there is no tool.
        memory: Of the stepper (see `Stepper.memory`).
    """

    poses: Sequence[np.ndarray]
    latent: Tensor
    force: np.ndarray
    torque: np.ndarray
    slow: int | None
    memory: Any = None


class Dynamics(nn.Module):
    """History of the modes and motion of the body in, next state and force out.

    Args:
        settings: What was built.
        num_modes: r.
        context: Keys of the scene whose numbers are told, K of them.
        predicts_body: Whether the body moves as the soil lets it (see `free_axes`).

    Attributes:
        lowest: Latent positions that no step goes below [m], shape (r, 3) or those of more modes; without bound until
            the surrogate that it is a part of tells it.
        highest: Likewise.
        band: Of several members, how many of their deviations to both sides of their mean hold 90 % of the validation
            runs, shape (4,): force x, y, z, and all the modes' coordinates.
    """

    force: Standardiser
    lowest: Tensor
    highest: Tensor
    band: Tensor

    def __init__(
        self,
        settings: ModelSettings | PolynomialSettings,
        num_modes: int,
        context: tuple[str, ...],
        predicts_body: bool,
    ) -> None:
        super().__init__()
        self.settings = settings
        self.num_modes = num_modes
        self.context_keys = tuple(context)
        self.predicts_body = predicts_body
        unbounded = torch.full((num_modes, 3), math.inf, dtype=torch.float64)
        self.register_buffer("lowest", -unbounded, persistent=False)
        self.register_buffer("highest", unbounded, persistent=False)

    @property
    def history(self) -> int:
        """d, positions of history."""
        return self.settings.history

    @property
    def members(self) -> int:
        """Of an ensemble, how many dynamics it is."""
        return 1

    def member(self, index: int) -> Dynamics:
        """One of them, from 0, alone; the weights are shared."""
        return self

    def card(self) -> dict[str, Any]:
        """Plain values from which the same dynamics can be built, to be filled from a state dict."""
        return {
            "model": self.settings.to_dict(),
            "num_modes": self.num_modes,
            "context": list(self.context_keys),
            "predicts_body": self.predicts_body,
        }

    @classmethod
    @abstractmethod
    def from_card(cls, card: Mapping[str, Any], state: Mapping[str, Tensor]) -> Dynamics:
        """What a card describes (see `card`), to be filled from a state dict.

        Raises:
            KeyError, TypeError, ValueError, UserError: It is no such card, or describes more than the state holds; this
                is found out before anything is built.
        """

    @abstractmethod
    def with_modes(self, num_modes: int) -> Dynamics:
        """The same dynamics of the first modes only.

        Raises:
            UserError: More modes than it was trained with.
        """

    @abstractmethod
    def latent_statistics(self) -> tuple[Tensor, Tensor]:
        """Mean and deviation of the latent positions in the training windows [m], shape (r, 3) each."""

    def reach(self) -> tuple[Tensor, Tensor]:
        """Smallest and largest latent positions that a step leads to [m], shape (r, 3) each."""
        mean, scale = self.latent_statistics()
        return (
            torch.maximum(mean - _REACH * scale, self.lowest[: self.num_modes]),
            torch.minimum(mean + _REACH * scale, self.highest[: self.num_modes]),
        )

    @abstractmethod
    def advance(self, latent: Tensor, body: BodyTrack, context: Tensor | None = None) -> Step:
        """Take one step of every window in a batch.

        Args:
            latent: The last d latent positions, oldest first [m], float64, shape (B, d, r, 3).
            body: The d frames that end with the *next* one, the frame to be predicted; (B, d, N, ...). Where it is
                then, and how it gets there along the free axes, is not looked at.
            context: Numbers of the runs, shape (B, K); not needed when K is 0.
        """

    def stepper(self, body_points: int, context: Tensor | None = None) -> Stepper:
        """Takes the steps of one path under a body of M points without gradients, with the weights as they are now;
        context (1, K)."""
        return Stepper(self, context)

    def unroll(
        self, latent: Tensor, body: BodyTrack, context: Tensor | None = None, memory: Any = None
    ) -> Path:
        """Follow whole tool paths from a given history, feeding predictions back.

        Args:
            latent: The first d latent positions of each path [m], shape (B, d, r, 3).
            body: The body at all T frames, (B, T, N, ...); what is predicted of it is read in the first d frames only.
            context: As for `advance`.
            memory: Of a stepper at the beginning of one path alone.
        """
        return unrolled(
            lambda history, window: self.advance(history, window, context), latent, body, self.predicts_body
        )

    def follow(
        self,
        poses: np.ndarray,
        points: np.ndarray,
        context: Tensor,
        places: Sequence[Place],
        pace: Pace | None,
        given: int = 1,
        loads: Sequence[np.ndarray | None] = (None, None),
    ) -> tuple[list[np.ndarray], list[Place]]:
        """Latent positions, force, torque, poses and body points in the world frame along some paths of a tool, and
        where each ends.

        Args:
            poses: Shape (B, T, 7).
            points: In the body frame [m], shape (M, 3).
            context: Shape (1, K) or (B, K).
            places: Where each path begins, B of them.
            pace: When the soil takes a step; None: into every frame.
            given: Frames of the paths that are those places' last ones: 1, or d.
            loads: Force and torque of these frames where they are not those of the places.
        """
        count, d = len(poses), self.history
        worlds = np.stack([in_world_frame(path, points) for path in poses])
        before = np.stack([np.stack(place.poses) for place in places])
        before_worlds = np.stack([in_world_frame(path, points) for path in before])
        frames, slow = [np.arange(given, poses.shape[1])] * count, [place.slow for place in places]
        if pace is not None:
            for i, path in enumerate(markers(*pair) for pair in zip(poses, worlds, strict=True)):
                stepped, known = markers(before[i, -1:], before_worlds[i, -1:])[0], slow[i]
                assert known is not None
                found, slow[i] = step_frames(path[given - 1 :], stepped, known, pace)
                frames[i] = found + (given - 1)
        shown, newest = self.side_by_side(frames, poses.shape[1], given)
        newest += d - given
        tracks = []
        for i, later in enumerate(shown[:, d:]):
            pairs = (before[i], poses[i, later]), (before_worlds[i], worlds[i, later])
            tracks.append(self.track(*map(np.concatenate, pairs)))
        track = BodyTrack(*(torch.cat(parts) for parts in zip(*tracks, strict=True)))
        with torch.inference_mode():
            start = torch.stack([place.latent for place in places]).to(self.lowest.device)
            whole = self.unroll(start, track, context.expand(count, -1), places[0].memory)
            parts = [part.cpu().numpy() for part in (whole.latent, whole.force, whole.torque)]
            nodes = whole.body.position.cpu().numpy()
        for part, load, name in zip(parts[1:], loads, ("force", "torque"), strict=True):
            if load is None:
                part[:, d - 1] = [getattr(place, name) for place in places]
            else:
                part[:, d - given : d] = load
        latent, force, torque, nodes = (part[np.arange(count)[:, None], newest] for part in (*parts, nodes))
        if self.predicts_body:
            poses = np.stack([self.predicted_poses(*pair, points) for pair in zip(poses, nodes, strict=True)])
            worlds = nodes
            if self.settings.body_nodes == "pose":
                worlds = np.stack([in_world_frame(path, points) for path in poses])
        ends = []
        for i, each in enumerate(frames):
            last, stop = np.concatenate([before[i], poses[i, each]])[-d:].copy(), d + len(each)
            positions = torch.tensor(parts[0][i, stop - d : stop])
            ends.append(Place(list(last), positions, force[i, -1].copy(), torque[i, -1].copy(), slow[i]))
        return [latent, force, torque, poses, worlds], ends

    def frames_of(
        self, poses: np.ndarray, worlds: np.ndarray, pace: Pace | None, given: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """`side_by_side` of the frames that the soil takes a step into along paths (B, T, 7) with body points in the
        world frame (B, T, M, 3), before which the tool rested. Other arguments as of `follow`."""
        frames = [np.arange(given, poses.shape[1])] * len(poses)
        if pace is not None:
            paths = [markers(*path) for path in zip(poses, worlds, strict=True)]
            found = [
                step_frames(path[given - 1 :], path[given - 1], pace.slow_after(path[:given]), pace)[0]
                for path in paths
            ]
            frames = [each + given - 1 for each in found]
        return self.side_by_side(frames, poses.shape[1], given)

    def side_by_side(
        self, frames: Sequence[np.ndarray], count: int, given: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """The d frames that paths of so many frames begin with and those after them that the soil takes a step into,
        shape (B, any); and for every frame of a path which of them, the d but the given left out, is the newest, shape
        (B, T)."""
        # Before its first frame a bed is at rest. Side by side all take as many steps: those that are done rest.
        each = [np.concatenate([np.arange(given), one]) for one in frames]
        every, padding, longest = np.arange(count), self.history - given, max(map(len, each))
        newest = [np.searchsorted(one, every, side="right") - 1 for one in each]
        shown = [np.pad(one, (padding, longest - len(one)), mode="edge") for one in each]
        return np.stack(shown), np.stack(newest)

    def track(self, poses: np.ndarray, points: np.ndarray) -> BodyTrack:
        """Of poses (T, 7) and body points in the world frame (T, M, 3), with B = 1."""
        track, device = body_track(poses, points, self.settings.body_nodes), self.lowest.device
        return BodyTrack(*(part[None].to(device) for part in track))

    def rows(self, poses: np.ndarray, points: np.ndarray) -> np.ndarray:
        """What `track` says of poses (T, 7) and body points in the body frame (M, 3), side by side, to be continued
        frame by frame; shape (T, N, any)."""
        track = body_track(poses, in_world_frame(poses, points), self.settings.body_nodes)
        return np.concatenate([part.numpy() for part in track], axis=-1)

    def next_rows(
        self, rows: np.ndarray, before: np.ndarray, pose: np.ndarray, points: np.ndarray
    ) -> np.ndarray:
        """The rows of one frame later: the first frame leaves, the pose (7,) that comes after `before` joins."""
        if self.settings.body_nodes == "points":
            return np.concatenate([rows[1:], self.rows(np.stack([before, pose]), points)[1:]])
        row = np.array(pose_step(before.tolist(), pose.tolist()))
        return np.concatenate([rows[1:], row[None, None]])

    def track_of(self, rows: np.ndarray) -> BodyTrack:
        """The track of some rows, with B = 1."""
        whole = torch.from_numpy(rows)[None].to(self.lowest.device)
        motion = 9 if self.settings.body_nodes == "pose" else 3
        return BodyTrack(whole[..., :3], whole[..., 3:motion], whole[..., motion:])

    def predicted_poses(self, poses: np.ndarray, nodes: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Poses (T, 7) of body nodes (T, N, 3) [m]; the prescribed orientation of a pose node is kept."""
        if self.settings.body_nodes == "points":
            return fitted_poses(points, nodes)
        return np.concatenate([nodes[:, 0], poses[:, 3:]], axis=1)

    def check_modes(self, num_modes: int) -> None:
        """For `with_modes`."""
        if not is_whole(num_modes) or not 1 <= num_modes <= self.num_modes:
            raise UserError(
                f"num_modes is {num_modes!r}; allowed: 1 to {self.num_modes}, with which the {self.settings.kind} was "
                "trained"
            )

    def known_context(self, context: Tensor | None) -> Tensor:
        """The context, where there is one to be known."""
        if context is None:
            raise UserError(
                f"this {self.settings.kind} needs the scene's {', '.join(self.context_keys)}; give it a scene"
            )
        return context


class Stepper:
    """Takes the steps of one path without gradients; made by `Dynamics.stepper`.

    Attributes:
        memory: All that a step depends on of those before it, besides what it is given; put back, it undoes them.
    """

    memory: Any = None

    def __init__(self, dynamics: Dynamics, context: Tensor | None) -> None:
        self.dynamics = dynamics
        self.context = context

    def advance(self, latent: Tensor, body: BodyTrack) -> Step:
        """One step; latent (1, d, r, 3) and body (1, d, N, ...) as for `Dynamics.advance`."""
        with torch.inference_mode():
            return self.dynamics.advance(latent, body, self.context)

    def step(self, latent: Tensor, rows: np.ndarray) -> Step:
        """As `advance`, of the body's rows of d frames (see `Dynamics.rows`)."""
        return self.advance(latent, self.dynamics.track_of(rows))


def unrolled(
    advance: Callable[[Tensor, BodyTrack], Step], latent: Tensor, body: BodyTrack, predicts_body: bool
) -> Path:
    """Whole paths by steps that see what the steps before said; a predicted body goes where they say. Arguments as for
    `Dynamics.unroll`."""
    d, frames = latent.shape[1], body.position.shape[1]
    states = latent.new_empty((latent.shape[0], frames, *latent.shape[2:]), dtype=torch.float64)
    states[:, :d] = latent
    force = latent.new_zeros((latent.shape[0], frames, 3), dtype=torch.float64)
    torque = torch.zeros_like(force)
    if predicts_body:
        body = body._replace(position=body.position.clone(), motion=body.motion.clone())
    for t in range(d, frames):
        step = advance(states[:, t - d : t], body.frames(slice(t - d + 1, t + 1)))
        states[:, t], force[:, t], torque[:, t] = step.latent, step.force, step.torque
        if predicts_body:
            body.motion[:, t, :, :3] = step.displacement
            body.position[:, t] = body.position[:, t - 1] + step.displacement
    return Path(states, force, torque, body)
