"""What the network is told: the graph, the body, the scene's constants, the steps under a slow tool."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from numbers import Real
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mpm_warp.poses import fitted_rotations, in_world_frame, rotation_matrices, rotation_vectors
from sgns.config import UserError
from sgns.reduction.reduce import ReducedRun

# --- The graph the network sees: one node per mode, one or more for the body, and edges between them ----
# Shapes: B batch, V nodes, E edges, d history positions, r modes.


def edge_indices(
    modes: int,
    body_nodes: int,
    edges: str = "complete",
    self_loops: bool = False,
    device: torch.device | str = "cpu",
) -> Tensor:
    """The edges between modes, which come first, and body nodes: senders in row 0 and receivers, ascending, in row 1
    (PyG's order), shape (2, E).

    "complete" is every ordered pair of different nodes; "star" only those with one mode and one body node.
    """
    index = torch.arange(modes + body_nodes, device=device)
    receiver, sender = torch.meshgrid(index, index, indexing="ij")
    keep = receiver != sender if edges == "complete" else (receiver < modes) != (sender < modes)
    if self_loops:
        keep = keep | (receiver == sender)
    return torch.stack([sender[keep], receiver[keep]])


def build_graph(
    mode_features: Tensor,
    body_features: Tensor,
    position: Tensor,
    edge_index: Tensor,
    edge_length: bool = True,
) -> tuple[Tensor, Tensor]:
    """Features of the nodes [1], shape (B, V, any), and of the edges [1], shape (B, E, 3 or 4).

    The narrower kind of node is padded with zeros so that one encoder serves both. An edge holds the sender's position
    relative to the receiver's, and its length if so set.

    Args:
        mode_features: [1], shape (B, r, any).
        body_features: [1], shape (B, N, any).
        position: Of all nodes, modes first, in the unit of edges [1], shape (B, V, 3).
        edge_index: Senders and receivers, shape (2, E).
        edge_length: Whether edges hold their length.
    """
    features = mode_features, body_features
    width = max(part.shape[-1] for part in features)
    padded = [torch.nn.functional.pad(part, (0, width - part.shape[-1])) for part in features]
    sender, receiver = edge_index
    edges = position.index_select(-2, sender) - position.index_select(-2, receiver)
    if edge_length:
        edges = torch.cat([edges, torch.linalg.vector_norm(edges, dim=-1, keepdim=True)], dim=-1)
    return torch.cat(padded, dim=-2), edges


# --- What the network is told about the body: where it is and how it moves, frame by frame --------------
# A tool's motion is prescribed. A wheel's height follows from the soil: of the node "pose" the network then
# predicts the height, of the nodes "points" everything.
#
# Shapes: T frames, M body points, N body nodes (1 for "pose", M for "points"), K motion components (6 or 3).


class BodyTrack(NamedTuple):
    """The body along a path.

    Attributes:
        position: Centre of mass, or the points [m], shape (..., T, N, 3).
        orientation: First two columns of the rotation matrix, body -> world [1], shape (..., T, N, 6); for
            "points", which show it themselves, shape (..., T, N, 0).
        motion: Movement since the previous frame, zero in the first: displacement [m], followed for "pose" by
            the rotation vector [rad]; shape (..., T, N, K).
    """

    position: Tensor
    orientation: Tensor
    motion: Tensor

    def frames(self, index: slice | Tensor) -> BodyTrack:
        """The track at some frames."""
        return BodyTrack(*(part[..., index, :, :] for part in self))

    def displaced(self, offset: Tensor) -> BodyTrack:
        """The track with offsets [m] of its positions, shape (..., T + 1, N, 3): those of the frame before the first
        and of every frame. Motions follow."""
        motion = self.motion.clone()
        motion[..., :3] += offset.diff(dim=-3)
        return self._replace(position=self.position + offset[..., 1:, :, :], motion=motion)

    def moved_last(self, displacement: Tensor) -> BodyTrack:
        """The track whose last frame lies a displacement [m] (..., N, 3) from the one before."""
        position = torch.cat(
            [self.position[..., :-1, :, :], (self.position[..., -2, :, :] + displacement).unsqueeze(-3)],
            dim=-3,
        )
        last = torch.cat([displacement, self.motion[..., -1, :, 3:]], dim=-1).unsqueeze(-3)
        return self._replace(position=position, motion=torch.cat([self.motion[..., :-1, :, :], last], dim=-3))


def body_track(poses: np.ndarray, points: np.ndarray | None, body_nodes: str) -> BodyTrack:
    """A path as the network sees it, float64.

    Args:
        poses: Centre of mass [m] and unit quaternion x, y, z, w, shape (T, 7).
        points: Body points in the world frame [m], shape (T, M, 3); only read for "points".
        body_nodes: "pose" (one node) or "points" (one node per point).
    """
    if body_nodes == "points":
        if points is None or points.shape[1] == 0:
            raise UserError(
                "model.body_nodes=points needs body points and the runs have none; use model.body_nodes=pose"
            )
        position = torch.as_tensor(np.array(points, dtype=np.float64))
        return BodyTrack(position, position[..., :0], position.diff(dim=0, prepend=position[:1]))
    poses = np.asarray(poses, dtype=np.float64)
    columns = rotation_matrices(poses[:, 3:])[:, :, :2]
    motion = np.zeros((len(poses), 6))
    motion[1:, :3] = poses[1:, :3] - poses[:-1, :3]
    motion[1:, 3:] = rotation_vectors(poses[:-1, 3:], poses[1:, 3:])
    return BodyTrack(
        torch.tensor(poses[:, None, :3]),
        torch.tensor(columns.transpose(0, 2, 1).reshape(len(poses), 1, 6)),
        torch.tensor(motion[:, None]),
    )


def pose_step(before: Sequence[float], pose: Sequence[float]) -> tuple[float, ...]:
    """What `body_track` says of the last of two poses (7,), in plain numbers, which takes a thirtieth of the time:
    position (3), orientation (6), displacement (3) and rotation vector (3); equal to the bit."""
    (a, b, c, *q), (x, y, z, *r) = before, pose
    i, j, k, w = r
    columns = (
        *(1 - 2 * (j * j + k * k), 2 * (i * j + k * w), 2 * (i * k - j * w)),
        *(2 * (i * j - k * w), 1 - 2 * (i * i + k * k), 2 * (j * k + i * w)),
    )
    return (x, y, z, *columns, x - a, y - b, z - c, *_rotation_vector(q, r))


def _rotation_vector(before: Sequence[float], after: Sequence[float]) -> tuple[float, float, float]:
    """`rotation_vectors` of two quaternions, in SciPy's order of operations; NaN where SciPy refuses one."""
    try:
        (a, b, c, s), (x, y, z, w) = _unit(before), _unit(after)
        # after * before^-1, the short way round.
        u, v, t, e = _unit(
            (
                w * -a + s * x + (y * -c - z * -b),
                w * -b + s * y + (z * -a - x * -c),
                w * -c + s * z + (x * -b - y * -a),
                w * s - x * -a - y * -b - z * -c,
            )
        )
    except ZeroDivisionError:
        return math.nan, math.nan, math.nan
    if e < 0:
        u, v, t, e = -u, -v, -t, -e
    angle = 2 * math.atan2(math.sqrt(u * u + v * v + t * t), e)
    square = angle * angle
    small = angle <= 1e-3
    scale = 2 + square / 12 + 7 * square * square / 2880 if small else angle / math.sin(angle / 2)
    return scale * u, scale * v, scale * t


def _unit(q: Sequence[float]) -> tuple[float, float, float, float]:
    x, y, z, w = q
    length = math.sqrt(x * x + y * y + z * z + w * w)
    return x / length, y / length, z / length, w / length


def free_axes(predicted: bool, body_nodes: str) -> Tensor:
    """Which axes of a body node's position the network predicts, shape (3,) of ones and zeros.

    Of a predicted body the node "pose" has a free height, as the axle of a wheel that is driven along a prescribed
    way; "points" are free particles that know of no way.
    """
    if not predicted:
        return torch.zeros(3, dtype=torch.float64)
    return torch.tensor([0.0, 0.0, 1.0] if body_nodes == "pose" else [1.0, 1.0, 1.0], dtype=torch.float64)


def is_wheel(scene: Mapping[str, Any]) -> bool:
    """Whether the body is a wheel, the only one whose height the soil decides (`mpm_warp.Scene.axle`)."""
    return scene.get("kind") == "wheel"


def moves_freely(runs: Sequence[ReducedRun]) -> bool:
    """Whether the body moves as the soil lets it, which only a wheel's axle does; refuses a mixture."""
    free = {is_wheel(run.scene) for run in runs}
    if len(free) > 1:
        raise UserError(
            "the training runs mix wheels, whose height is predicted, with bodies whose motion is prescribed; keep one "
            "dataset for each"
        )
    return free.pop()


def nearest_rigid(reference: Tensor, points: Tensor) -> Tensor:
    """The points of a body in any one pose (..., M, 3) [m], moved rigidly to where they lie nearest to some points
    (..., M, 3); not finite where these are not."""
    here, there = reference.mean(-2, keepdim=True), points.mean(-2, keepdim=True)
    rotation = torch.from_numpy(fitted_rotations(reference.cpu().numpy(), points.cpu().numpy()))
    return (reference - here) @ rotation.to(points.device).transpose(-1, -2) + there


# --- Constants of a run that the tool's path does not show: gravity, load, friction angle of the soil -----


def varying_context(runs: Sequence[ReducedRun], candidates: Sequence[str]) -> list[str]:
    """Those of the candidates, keys of the scene such as `load` or `material.friction_angle`, whose numbers differ
    between runs: a constant tells nothing.

    Raises:
        UserError: runs have different loads over time, which are no numbers.
    """
    loads = [run.scene.get("load") for run in runs]
    if any(isinstance(load, list) for load in loads) and any(load != loads[0] for load in loads):
        raise UserError(
            "the training runs have different scene.load over time, which a model cannot be told; give each run a "
            "constant scene.load, or all runs the same"
        )
    values = {key: {_value(run.scene, key) for run in runs} for key in candidates}
    return [
        key
        for key, found in values.items()
        if len(found) > 1 and all(value is not None and math.isfinite(value) for value in found)
    ]


def context_of(scene: Mapping[str, Any], keys: Sequence[str]) -> np.ndarray:
    """The numbers of a scene by their keys, in the units of the scene, shape (K,); UserError if one is missing or not
    finite."""
    values = []
    for key in keys:
        value = _value(scene, key)
        if value is None:
            raise UserError(
                f"the scene has no number {key}, which this network needs; "
                f"it was trained with different values of {', '.join(keys)}"
            )
        if not math.isfinite(value):
            raise UserError(f"the scene's {key} is {value}; it must be finite")
        values.append(value)
    return np.array(values, dtype=np.float64)


def _value(scene: Mapping[str, Any], key: str) -> float | None:
    found: Any = scene
    for part in key.split("."):
        found = found.get(part) if isinstance(found, Mapping) else None
    return float(found) if isinstance(found, Real) and not isinstance(found, bool) else None


# --- Rate independence: slow dry soil follows the way a tool goes, not the time that it takes -----------
# Dynamics learn from tools that move by so much per frame, and in every step they err a little: along a path
# much slower than that, or at rest, the errors of thousands of steps add up to soil that flows on its own.
# There the soil takes a step only each time that the tool has gone as far as the slowest trained one does in a
# frame.
#
# Shapes: T frames, M body points.

# A tool that moves less than this in a frame [m] rests: round-off of poses, not motion.
_STILL = 1e-9
# Of the training frames in which the tool moves this share may be slower than what is called the slowest: tools stop
# within a frame. As it is found again in paths of the same kind, it is lowered by more than round-off.
_STOPPING, _ROUNDING = 0.01, 0.01


class Pace(NamedTuple):
    """When soil takes a step under a prescribed tool.

    Attributes:
        least: How far the tool moves in a frame at least that is not called slow [m].
        settling: Frames that the soil follows the clock after that: what was thrown up comes down.
    """

    least: float
    settling: int

    @classmethod
    def of(cls, slowest_travel: float, settling: int) -> Pace:
        """Of training runs whose tools move by so much in a frame at least [m]."""
        return cls(max(slowest_travel, _STILL), settling)

    def after(self, slow: int, fast: bool, far: Callable[[], bool]) -> tuple[int, bool]:
        """Frames since the tool was last not slow, and whether the soil takes a step into this frame.

        Args:
            slow: These frames, of the frame before.
            fast: Whether the tool has moved as far as `least` since the frame before.
            far: Says whether it has since the soil took its last step.
        """
        slow = 0 if fast else slow + 1
        return slow, slow < self.settling or far()

    def slow_after(self, given: np.ndarray) -> int:
        """As `after`, of given frames of markers (any, M + 1, 3), before which the tool rested."""
        slow = self.settling
        for fast in (distance(given[1:], given[:-1]) >= self.least).tolist():
            slow = 0 if fast else slow + 1
        return slow

    def moved(self, points: np.ndarray, before: np.ndarray, pose: np.ndarray) -> bool:
        """Whether a tool with points in the body frame (M, 3) [m] has moved as far as `least` between two poses."""
        # Mostly its centre of mass alone says so, beyond round-off of one with the points.
        if math.dist(before[:3].tolist(), pose[:3].tolist()) > 1.000001 * self.least:
            return True
        both = np.stack([before, pose])
        return self.reached(*markers(both, in_world_frame(both, points)))

    def reached(self, here: np.ndarray, there: np.ndarray) -> bool:
        """Whether some markers (M + 1, 3) have."""
        return bool(distance(here, there) >= self.least)


class ToolMotion(NamedTuple):
    """How a tool has moved, as far as the next step of the soil depends on it."""

    pace: Pace
    here: np.ndarray  # where its markers are (see `markers`) [m], shape (M + 1, 3)
    stepped: np.ndarray  # where they were when the soil took its last step
    slow: int  # frames since it was last not slow
    steps: bool  # whether the soil takes a step into this frame

    @classmethod
    def along(cls, given: np.ndarray, pace: Pace) -> ToolMotion:
        """In the last of some given frames of markers (any, M + 1, 3), before which it rested."""
        return cls(pace, given[-1], given[-1], pace.slow_after(given), True)

    def moved(self, here: np.ndarray) -> ToolMotion:
        """One frame later."""
        reached = self.pace.reached
        slow, steps = self.pace.after(
            self.slow, reached(here, self.here), partial(reached, here, self.stepped)
        )
        return ToolMotion(self.pace, here, here if steps else self.stepped, slow, steps)


def step_frames(path: np.ndarray, stepped: np.ndarray, slow: int, pace: Pace) -> tuple[np.ndarray, int]:
    """Numbers of the frames of a path of markers (T, M + 1, 3), from 1, that the soil takes a step into, and the frames
    since the tool was last not slow in the end.

    Args:
        path: From where the tool is.
        stepped: Its markers when the soil took its last step, (M + 1, 3).
        slow: Frames since it was last not slow.
        pace: When soil takes a step.
    """
    fast = distance(path[1:], path[:-1]) >= pace.least
    if fast.all():
        return np.arange(1, len(path)), 0 if len(fast) else slow
    frames = []
    for t, is_fast in enumerate(fast.tolist(), 1):
        slow, steps = pace.after(slow, is_fast, partial(pace.reached, path[t], stepped))
        if steps:
            stepped = path[t]
            frames.append(t)
    return np.array(frames, dtype=np.int64), slow


def markers(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """What shows how far a tool moves: its centre of mass, of poses (T, 7), and its points in the world frame
    (T, M, 3); shape (T, M + 1, 3)."""
    return np.concatenate([np.asarray(poses)[:, None, :3], points], axis=1)


def distance(here: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Of the marker that is furthest from where it was [m], shape (...); markers of shape (..., M + 1, 3)."""
    with np.errstate(over="ignore"):  # of a tool that is nowhere
        return np.sqrt(np.square(here - there).sum(axis=-1).max(axis=-1))


def slowest_travel(runs: Sequence[ReducedRun]) -> float:
    """Distance that the tool moves at least in a frame while it moves in some runs [m]; 0 if it never does."""
    paths = [markers(run.pose, run.body_points) for run in runs]
    moved = np.concatenate([distance(path[1:], path[:-1]) for path in paths])
    moving = moved[moved > _STILL]
    return (1 - _ROUNDING) * float(np.quantile(moving, _STOPPING)) if len(moving) else 0.0
