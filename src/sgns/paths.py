"""Tool paths side by side: what each begins with, what the dynamics say along it, and where it ends.

Letters: B paths, T frames, M body points, K context numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mpm_warp.settings import short
from sgns.config import UserError
from sgns.model.dynamics import Dynamics, Place, together
from sgns.model.features import Pace
from sgns.state import Snapshot


class Paths(NamedTuple):
    """What B paths begin with."""

    poses: np.ndarray  # of the tool, shape (B, T, 7)
    points: np.ndarray  # of all, in the body frame [m], shape (M, 3)
    contexts: list[dict[str, float]]  # what the network is told of each
    places: list[Sequence[Place]]  # of each, where every member is
    starts: Sequence[Snapshot | None]

    def part(self, some: slice) -> Paths:
        """Some of them."""
        return Paths(self.poses[some], self.points, self.contexts[some], self.places[some], self.starts[some])


class Followed(NamedTuple):
    """What the dynamics say of B paths, see `Rollout`; arrays of shape (B, T, ...)."""

    latent: np.ndarray
    force: np.ndarray
    torque: np.ndarray
    poses: np.ndarray
    worlds: np.ndarray | None
    force_spread: np.ndarray | None
    latent_spread: np.ndarray | None
    ends: list[Sequence[Place]]  # of each path, where every member is in the end


def followed(
    members: Sequence[Dynamics],
    band: np.ndarray,
    pace: Pace | None,
    begin: Paths,
    given: int = 1,
    loads: Sequence[np.ndarray | None] = (None, None),
) -> Followed:
    """What `Dynamics.follow` finds, the mean of all members, then the spread of force and modes in their band (4,)."""
    told = told_numbers(begin.contexts, members[0].lowest.device)
    each, last = [], []
    for member, places in zip(members, zip(*begin.places, strict=True), strict=True):
        parts, final = member.follow(begin.poses, begin.points, told, places, pace, given, loads)
        each.append(parts)
        last.append(final)
    ends: list[Sequence[Place]] = list(zip(*last, strict=True))
    if len(each) == 1:
        states, force, torque, poses, worlds = each[0]
        return Followed(states, force, torque, poses, worlds, None, None, ends)
    states, force, torque, poses, worlds = (np.stack(parts) for parts in zip(*each, strict=True))
    states, latent_spread = together(states, band[3])
    force, force_spread = together(force, band[:3])
    torque, worlds = (together(part, 1.0)[0] for part in (torque, worlds))
    return Followed(states, force, torque, mean_pose(list(poses)), worlds, force_spread, latent_spread, ends)


def ends_of(found: Followed, begin: Paths, made_by: str) -> list[Snapshot]:
    """Where each path ends, of the simulator with this name (see `Snapshot`)."""
    ends = []
    for i, (places, start) in enumerate(zip(found.ends, begin.starts, strict=True)):
        frame = found.latent.shape[1] - 1 + (0 if start is None else start.frame)
        answer = (found.latent, found.force, found.torque, found.force_spread, found.latent_spread)
        last = [part if part is None else part[i, -1].copy() for part in answer]
        pairs = zip(found.poses[i, -2:].copy(), found.latent[i, -2:].copy(), strict=True)
        told = begin.points, begin.contexts[i], made_by
        ends.append(Snapshot.of(frame, tuple(last), list(pairs), places, *told))
    return ends


def told_numbers(contexts: Sequence[Mapping[str, float]], device: torch.device) -> Tensor:
    """Contexts as the dynamics take them, shape (B, K)."""
    rows = [list(context.values()) for context in contexts]
    return torch.tensor(rows, dtype=torch.float64, device=device)


def mean_pose(poses: Sequence[np.ndarray]) -> np.ndarray:
    """Of the poses (..., 7) that members predict, or that all were given."""
    if all(np.array_equal(pose, poses[0]) for pose in poses[1:]):
        return poses[0]
    mean = np.mean(poses, axis=0)
    mean[..., 3:] /= np.linalg.norm(mean[..., 3:], axis=-1, keepdims=True)
    return mean


def same_pose(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two poses (7,) are the same within a micrometre and 0.1 mrad."""
    return bool(np.abs(one[:3] - other[:3]).max() < 1e-6 and 1.0 - abs(one[3:] @ other[3:]) < 1e-9)


def one_each(value: Any, kind: type, name: str, count: int) -> list[Any]:
    """What is given for all paths, or a list of one for each, as such a list."""
    if value is None or isinstance(value, kind):
        return [value] * count
    if not isinstance(value, (list, tuple)) or len(value) != count:
        raise UserError(
            f"{name} is {short(value)}; it must be one for all paths, or a list of {count}, one for each"
        )
    return list(value)
