"""A checkpoint as a differentiable function in torch: tool path, context and start of the soil in; soil, force and
torque out, with their gradients.

Letters: B paths, T frames, n particles, M body points, d history positions, r modes, K context numbers; "..." stands
for B or nothing. Everything is float64.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from mpm_warp import Bed
from mpm_warp.poses import in_world_frame
from mpm_warp.settings import short
from sgns.config import UserError
from sgns.data.files import one_line
from sgns.data.surface import soil_surface
from sgns.model import training_range as known
from sgns.model.dynamics import Standardiser
from sgns.model.features import BodyTrack, ToolMotion, context_of, markers
from sgns.numbers import check_poses, is_whole
from sgns.simulator import Simulator

# Height over which lower particles lose their part in the surface, as a share of a column's edge: half a particle
# spacing. Among other heights and splines this comes nearest to the highest particle of a column.
_SHARPNESS = 1.0 / 4.0


class TorchPath(NamedTuple):
    """A tool path and what the soil does along it, float64; as of `Rollout`."""

    latent: Tensor  # modes [m], shape (..., T, r, 3)
    force: Tensor  # by the soil on the tool [N], shape (..., T, 3)
    torque: Tensor  # about its centre of mass [N m], shape (..., T, 3)
    poses: Tensor  # of the tool, shape (..., T, 7); predicted where it is free
    context: Tensor  # what the network was told, shape (..., K)


class TorchState(NamedTuple):
    """Soil and tool on some paths between two steps, float64."""

    latent: Tensor  # the last d positions of the modes, the newest last [m], shape (B, d, r, 3)
    force: Tensor  # shape (B, 3)
    torque: Tensor  # shape (B, 3)
    poses: Tensor  # of the tool then, shape (B, d, 7)
    context: Tensor  # shape (B, K)
    motion: tuple[ToolMotion, ...] | None  # of every tool; None: the soil takes a step into every frame


class TorchSimulator:
    """Steps of a simulator that torch can differentiate; to rounding they give what the simulator gives.

    Nothing of it changes from call to call. Values and gradients are those of a smooth answer but where the answer has
    steps or kinks: a network with ReLU has kinks, modes are held within their reach, and under a tool slower than all
    training runs the soil rests in some frames. There the gradient is that of one side. There is no second derivative.

    Args:
        simulator: Its network or polynomials are copied; of several members the first.

    Raises:
        UserError: The network moves the points of a wheel one by one (`model.body_nodes=points`).
    """

    def __init__(self, simulator: Simulator) -> None:
        self.dynamics = copy.deepcopy(simulator.dynamics).double().requires_grad_(False).eval()
        for module in self.dynamics.modules():
            if isinstance(module, Standardiser):
                module.shown = torch.float64
        if self.dynamics.predicts_body and self.dynamics.settings.body_nodes == "points":
            raise UserError(
                "a wheel whose points are moved one by one has no gradient here; train with model.body_nodes=pose"
            )
        self.history, self.context_keys = simulator.history, simulator.context_keys
        self.device, self.frame_rate = simulator.device, simulator.frame_rate
        self.basis = simulator.basis.to(self.device)
        self.scene = simulator.scene
        self.points = simulator.body_points
        self._simulator = simulator
        self._start = self.basis.transform(simulator.start_positions)
        self._known = simulator.training_range

    # --- Paths and steps ---

    def rollout(
        self,
        poses: Tensor | np.ndarray,
        context: Mapping[str, Any] | None = None,
        latent_history: Tensor | np.ndarray | None = None,
        segment: int | None = None,
    ) -> TorchPath:
        """Follow whole tool paths; as `Simulator.rollout`.

        Args:
            poses: Centre of mass [m] and quaternion x, y, z, w of the tool at every frame, shape (T, 7) or (B, T, 7).
                Quaternions are made exactly unit first. What is predicted of it is read in the given frames only.
            context: Numbers that the network is told, by their keys (`context_keys`), such as friction_angle, in the
                units of the scene; each a number or a tensor of shape () or (B,). Those left out: of the simulator's
                scene.
            latent_history: The first d frames [m], shape (d, r, 3) or (B, d, r, 3); None: the bed at rest in frame 0.
            segment: Steps that are computed again together in the backward pass, so that only their beginnings are
                remembered; None: √T. As many as frames: all is remembered, which is 1.8 times as quick and takes memory
                that grows with T.

        Raises:
            UserError: What is given is not of the shape and kind above.
        """
        paths, single = self._paths(poses, "tool path")
        (count, frames), d = paths.shape[:2], self.history
        given = 1 if latent_history is None else d
        if frames < given:
            raise UserError(f"the path has {frames} frames; with a given history it needs at least {d}")
        latent, told = self._history(latent_history, count), self._told(context, count)
        shown, newest = self.dynamics.frames_of(*self._plain(paths), self._simulator.pace, given)
        track = self._track(_chosen(paths, shown))
        longest = track.position.shape[1]
        every = math.ceil(math.sqrt(longest)) if segment is None else segment
        if not is_whole(every) or every < 1:
            raise UserError(f"segment is {segment!r}; it must be a whole number of steps, at least 1")
        seen, parts = track.frames(slice(1, d)), []
        last = latent
        for first in range(d, longest, every):
            arguments = last, seen, track.frames(slice(first, first + every)), told
            if every < longest - d and torch.is_grad_enabled():
                found = checkpoint(self._steps, *arguments, use_reentrant=False, preserve_rng_state=False)
            else:
                found = self._steps(*arguments)
            last, seen = found[:2]
            parts.append(found[2:])
        nothing = latent.new_zeros(count, d, 3)
        begins = latent, nothing, nothing, track.position[:, :d]
        whole = [
            torch.cat([begin, *(part[i] for part in parts)], 1)[:, d - given :]
            for i, begin in enumerate(begins)
        ]
        states, force, torque, places = (_chosen(part, newest) for part in whole)
        if self.dynamics.predicts_body:
            paths = torch.cat([places[:, :, 0], paths[..., 3:]], -1)
        path = TorchPath(states, force, torque, paths, told)
        return TorchPath(*(part[0] for part in path)) if single else path

    def start(
        self,
        poses: Tensor | np.ndarray,
        context: Mapping[str, Any] | None = None,
        latent_history: Tensor | np.ndarray | None = None,
    ) -> TorchState:
        """Where `step` begins.

        Args:
            poses: Of the tool over the bed at rest, shape (1, 7) or (B, 1, 7); of a history all d of them.
            context: As for `rollout`.
            latent_history: As for `rollout`.
        """
        paths, _ = self._paths(poses, "start of the tool")
        given = 1 if latent_history is None else self.history
        if paths.shape[1] != given:
            raise UserError(f"the tool's start has {paths.shape[1]} poses; this start needs {given}")
        motion = None
        if (pace := self._simulator.pace) is not None:
            each = (markers(*pair) for pair in zip(*self._plain(paths), strict=True))
            motion = tuple(ToolMotion.along(path, pace) for path in each)
        count, nothing = len(paths), paths.new_zeros(len(paths), 3)
        before = paths[:, :1].expand(-1, self.history - given, -1)
        told, latent = self._told(context, count), self._history(latent_history, count)
        return TorchState(latent, nothing, nothing, torch.cat([before, paths], 1), told, motion)

    def step(self, state: TorchState, pose: Tensor | np.ndarray) -> TorchState:
        """The state one frame later, with the tool at a pose (7,) or at poses (B, 7); as `Simulator.step`."""
        poses, count = self._tensor(pose), len(state.poses)
        if poses.shape not in ((7,), (count, 7)):
            raise UserError(f"the pose has shape {tuple(poses.shape)}; it needs (7,) or ({count}, 7)")
        paths, _ = self._paths(poses.expand(count, 7)[:, None], "pose")
        steps, motion = torch.ones(len(paths), dtype=torch.bool, device=self.device), None
        if state.motion is not None:
            here = [markers(*pair)[0] for pair in zip(*self._plain(paths), strict=True)]
            motion = tuple(one.moved(there) for one, there in zip(state.motion, here, strict=True))
            steps = torch.tensor([one.steps for one in motion], device=self.device)
        body = self._track(torch.cat([state.poses, paths], 1))
        coming = body.frames(slice(self.history, None))
        latent, _, _, force, torque, place = self._steps(
            state.latent, body.frames(slice(1, self.history)), coming, state.context
        )
        if self.dynamics.predicts_body:
            paths = torch.cat([place[:, :, 0], paths[..., 3:]], -1)
        new = latent, force[:, 0], torque[:, 0], torch.cat([state.poses[:, 1:], paths], 1)
        old = state.latent, state.force, state.torque, state.poses
        parts = (
            torch.where(steps.view(-1, *[1] * (a.dim() - 1)), a, b) for a, b in zip(new, old, strict=True)
        )
        latent, force, torque, poses = parts
        return TorchState(latent, force, torque, poses, state.context, motion)

    def _steps(
        self, latent: Tensor, seen: BodyTrack, coming: BodyTrack, told: Tensor
    ) -> tuple[Tensor, BodyTrack, Tensor, Tensor, Tensor, Tensor]:
        """Steps into the coming frames of a body, of which d - 1 frames before are seen. The last d latent positions
        and d - 1 frames then; of every step latent positions, force, torque and where the body is."""
        found = []
        for frame in range(coming.position.shape[1]):
            body = _joined(seen, coming.frames(slice(frame, frame + 1)))
            step = self.dynamics.advance(latent, body, told)
            if self.dynamics.predicts_body:
                body = body.moved_last(step.displacement)
            latent = torch.cat([latent[:, 1:], step.latent[:, None]], 1)
            seen = body.frames(slice(1, None))
            found.append((step.latent, step.force, step.torque, body.position[:, -1]))
        states, force, torque, places = (torch.stack(parts, 1) for parts in zip(*found, strict=True))
        return latent, seen, states, force, torque, places

    # --- What is asked of soil and path ---

    def soil(self, latent: Tensor) -> Tensor:
        """Positions of all particles [m]: (..., r, 3) to (..., n, 3)."""
        return self.basis.inverse(latent)

    def surface(self, latent: Tensor) -> Tensor:
        """Heights of the soil in the columns of `State.surface` [m]: (..., r, 3) to (..., nx, ny).

        A smooth maximum of the particles around: each counts by a quadratic spline that is two columns wide along x and
        y, and one that is lower by half a particle spacing counts e times less. At the start it is `State.surface`.
        """
        here, there = self.soil(self._start), self.soil(latent)
        found = self._smooth_heights(there.reshape(-1, *here.shape))
        heights = found - self._smooth_heights(here[None]) + self._heights_at_start
        return heights.reshape(*latent.shape[:-2], *heights.shape[1:])

    def moved_volume(self, latent: Tensor, distance: float = 0.05) -> Tensor:
        """Volume of the soil that has moved from the first to the last of some frames [m³]: (..., T, r, 3) to (...).

        Soil that has moved by u counts u² / (u² + distance²) times: half at the distance [m], fully far beyond it.
        """
        ends = self.soil(latent[..., [0, -1], :, :])
        squares = (ends[..., 1, :, :] - ends[..., 0, :, :]).square().sum(-1)
        bed = self._bed
        return (squares / (squares + distance**2)).sum(-1) * bed.particle_volume * bed.store_every

    def work(self, path: TorchPath) -> Tensor:
        """Work of the tool on the soil from the frame before to every frame [J], shape (..., T)."""
        moved = path.poses[..., 1:, :3] - path.poses[..., :-1, :3]
        turned = _rotation_vectors(path.poses[..., :-1, 3:], path.poses[..., 1:, 3:])
        given = -(path.force[..., 1:, :] * moved + path.torque[..., 1:, :] * turned).sum(-1)
        return torch.nn.functional.pad(given, (1, 0))

    def outside(self, path: TorchPath) -> Tensor:
        """How far every frame is outside of all that the training runs covered, as `State.outside` [1], shape
        (..., T); its square makes an optimiser stay inside."""
        place, turn, soil = path.poses[..., :3], path.poses[..., 3:], path.latent.flatten(-2)
        matrices, (before, after) = _rotation_matrices(turn), (turn[..., :-1, :], turn[..., 1:, :])
        still = torch.nn.functional.pad
        lowest = place[..., 2]
        if len(self.points):
            lowest = (matrices[..., 2, :] @ self._tensor(self.points).T).amin(-1) + place[..., 2]
        told = path.context[..., None, :].expand(*path.latent.shape[:-2], -1)
        found = {
            known.POSITION: place,
            known.LOWEST: lowest[..., None],
            known.ORIENTATION: matrices[..., :2].transpose(-1, -2).flatten(-2),
            known.DISPLACEMENT: still(place.diff(dim=-2), (0, 0, 1, 0)),
            known.ROTATION: still(_rotation_vectors(before, after), (0, 0, 1, 0)),
            known.SOIL: soil,
            known.VELOCITY: still(soil.diff(dim=-2), (0, 0, 1, 0)),
            **{key: told[..., i : i + 1] for i, key in enumerate(self.context_keys)},
        }
        amounts = []
        for name in (name for name in self._known.low if name in found):
            value = found[name]
            low, high = (side[name][: value.shape[-1]] for side in (self._known.low, self._known.high))
            beyond = torch.maximum(self._tensor(low) - value, value - self._tensor(high)).clamp_min(0.0)
            amounts.append(beyond / self._tensor(known.widths(low, high)))
        return torch.cat(amounts, -1).amax(-1)

    # --- Parts ---

    def _tensor(self, value: Any) -> Tensor:
        try:
            return torch.as_tensor(value, dtype=torch.float64, device=self.device)
        except (TypeError, ValueError, RuntimeError) as error:
            raise UserError(f"{short(value)} cannot be read as numbers ({one_line(error)})") from error

    def _paths(self, poses: Any, what: str) -> tuple[Tensor, bool]:
        """Paths (B, T, 7) with exactly unit quaternions, and whether it was one alone."""
        tensor = self._tensor(poses)
        if tensor.dim() not in (2, 3) or tensor.shape[-1] != 7 or 0 in tensor.shape:
            raise UserError(f"the {what} has shape {tuple(tensor.shape)}; it needs (T, 7) or (B, T, 7)")
        paths = tensor if tensor.dim() == 3 else tensor[None]
        for path in paths.detach().cpu().numpy():
            check_poses(path, what)
        turn = paths[..., 3:] / torch.linalg.vector_norm(paths[..., 3:], dim=-1, keepdim=True)
        return torch.cat([paths[..., :3], turn], -1), tensor.dim() == 2

    def _plain(self, paths: Tensor) -> tuple[np.ndarray, np.ndarray]:
        """Paths (B, T, 7) and body points along them (B, T, M, 3), without gradients."""
        plain = paths.detach().cpu().numpy()
        return plain, np.stack([in_world_frame(path, self.points) for path in plain])

    def _history(self, latent: Tensor | np.ndarray | None, count: int) -> Tensor:
        """The d latent positions that every path begins with (B, d, r, 3)."""
        shape = count, self.history, *self._start.shape
        if latent is None:
            return self._start.expand(shape)
        history = self._tensor(latent)
        if history.shape not in (shape, shape[1:]) or not bool(history.isfinite().all()):
            raise UserError(
                f"the latent history has shape {tuple(history.shape)}; it needs {shape[1:]} or {shape}, all finite"
            )
        return history.expand(shape)

    def _told(self, context: Mapping[str, Any] | None, count: int) -> Tensor:
        """The numbers of every path (B, K)."""
        given = dict(context or {})
        if odd := [key for key in given if key not in self.context_keys]:
            names = ", ".join(self.context_keys) or "none"
            raise UserError(f"this checkpoint is not told {odd[0]}; the numbers that it is told: {names}")
        own = context_of(self.scene, self.context_keys)
        columns = []
        for key, value in zip(self.context_keys, own, strict=True):
            number = self._tensor(given.get(key, value))
            if number.shape not in ((), (count,)) or not bool(number.isfinite().all()):
                raise UserError(
                    f"{key} has shape {tuple(number.shape)}; it needs () or ({count},), all finite"
                )
            columns.append(number.expand(count))
        return torch.stack(columns, -1) if columns else self._start.new_zeros(count, 0)

    def _track(self, poses: Tensor) -> BodyTrack:
        """Paths (B, T, 7) as the dynamics see them; as `body_track`."""
        matrices, place = _rotation_matrices(poses[..., 3:]), poses[..., :3]
        if self.dynamics.settings.body_nodes == "points":
            position = (matrices @ self._tensor(self.points).T).transpose(-1, -2) + place[..., None, :]
            return BodyTrack(position, position[..., :0], position.diff(dim=1, prepend=position[:, :1]))
        turned = _rotation_vectors(poses[:, :-1, 3:], poses[:, 1:, 3:])
        motion = torch.nn.functional.pad(torch.cat([place.diff(dim=1), turned], -1), (0, 0, 1, 0))
        columns = matrices[..., :2].transpose(-1, -2).flatten(-2)
        return BodyTrack(*(part[:, :, None] for part in (place, columns, motion)))

    @cached_property
    def _heights_at_start(self) -> Tensor:
        return self._tensor(soil_surface(self.soil(self._start).cpu().numpy(), self.scene).z)

    @property
    def _bed(self) -> Bed:
        assert self._heights_at_start.numel()  # without a bed it says so
        return Bed.from_dict(self.scene["bed"])

    def _smooth_heights(self, soil: Tensor) -> Tensor:
        """Smooth maximum of the heights of particles (B, n, 3) in columns [m], shape (B, nx, ny)."""
        counts = self._heights_at_start.shape
        edges = self._tensor([size / count for size, count in zip(self._bed.size[:2], counts, strict=True)])
        share, sharpness = soil[..., :2] / edges, _SHARPNESS * float(edges.min())
        # The columns before, here and after, along each axis.
        place = share.detach().floor().long()[..., None] + torch.tensor([-1, 0, 1], device=self.device)
        away = 1.5 * (share[..., None] - place - 0.5).abs()
        weights = torch.where(away < 0.5, 0.75 - away.square(), 0.5 * (1.5 - away).clamp_min(0.0).square())
        limits = torch.tensor(counts, device=self.device)[:, None]
        weights = weights * ((place >= 0) & (place < limits))
        place = torch.minimum(place.clamp_min(0), limits - 1)
        index = (place[..., 0, :, None] * counts[1] + place[..., 1, None, :]).flatten(1)
        weight = (weights[..., 0, :, None] * weights[..., 1, None, :]).flatten(1)
        height = soil[..., 2, None].expand(-1, -1, 9).flatten(1)
        highest = height.detach().new_full((len(soil), counts.numel()), -math.inf)
        highest = highest.scatter_reduce(1, index, height.detach(), "amax")
        share_of = weight * ((height - highest.gather(1, index)) / sharpness).exp()
        total = torch.zeros_like(highest).scatter_add(1, index, share_of)
        empty = total <= 0.0
        found = sharpness * torch.where(empty, 1.0, total).log() + highest
        return torch.where(empty, math.nan, found).unflatten(1, tuple(counts))


def tool_poses(position: Tensor, rotation: Tensor) -> Tensor:
    """Poses (..., 7) of a tool at places [m] (..., 3), turned by rotation vectors [rad] (..., 3): (0, a, 0) is a turn
    by a about +y."""
    angle = torch.linalg.vector_norm(rotation, dim=-1, keepdim=True)
    vector = 0.5 * rotation * torch.sinc(angle / (2.0 * math.pi))
    return torch.cat([position, vector, torch.cos(0.5 * angle)], -1)


def _joined(seen: BodyTrack, coming: BodyTrack) -> BodyTrack:
    """Frames one after another."""
    return BodyTrack(*(torch.cat(parts, 1) for parts in zip(seen, coming, strict=True)))


def _chosen(values: Tensor, frames: np.ndarray | Sequence[Any]) -> Tensor:
    """Of every path (B, T, ...) some frames (B, any)."""
    index = torch.as_tensor(np.asarray(frames), device=values.device)
    return values[torch.arange(len(values), device=values.device)[:, None], index]


def _rotation_matrices(turn: Tensor) -> Tensor:
    """As `mpm_warp.poses.rotation_matrices`, of unit quaternions (..., 4); shape (..., 3, 3)."""
    x, y, z, w = turn.unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def _rotation_vectors(before: Tensor, after: Tensor) -> Tensor:
    """As `mpm_warp.poses.rotation_vectors`: (..., 4) and (..., 4) to (..., 3) [rad]."""
    (a, p), (b, q) = (before[..., :3], before[..., 3:]), (after[..., :3], after[..., 3:])
    along = (before * after).sum(-1, keepdim=True)
    vector = (b * p - a * q - torch.linalg.cross(b, a)) * torch.where(along < 0.0, -1.0, 1.0)
    squares = vector.square().sum(-1, keepdim=True)
    # Twice the sine of a small angle's half is the angle; its root has no gradient at zero.
    small = squares < 1e-16
    size = torch.where(small, 1.0, squares).sqrt()
    return vector * torch.where(small, 2.0, 2.0 * torch.atan2(size, along.abs()) / size)
