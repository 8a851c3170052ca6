"""What a simulator answers: the state of one frame, a rollout along one path, rollouts along many; and how it follows
paths side by side.

Letters: B paths, T frames, n particles, M body points, r modes, K context numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mpm_warp.settings import short, short_repr
from sgns.config import UserError, library
from sgns.data.run import AXES, POSE
from sgns.data.surface import Surface, soil_surface
from sgns.model.dynamics import Dynamics, Place, together
from sgns.model.features import Pace
from sgns.model.training_range import Excess
from sgns.numbers import counted, is_whole
from sgns.reduction.basis import Basis

if TYPE_CHECKING:
    import xarray


@dataclass(frozen=True, eq=False)
class State:
    """The bed and the tool at one frame.

    Attributes:
        frame: 0 at the reset.
        latent: Modes [m], shape (r, 3).
        force: By the soil on the tool over the last frame [N], world frame, shape (3,); zero at the reset.
        torque: About the tool's centre of mass [N m], shape (3,).
        pose: Tool's centre of mass [m] and quaternion x, y, z, w, shape (7,).
        force_spread: With `spread`, half the width of the band around the force that is to hold 90 % [N], shape (3,);
            else None.
        latent_spread: Likewise of the modes [m], shape (r, 3).
    """

    def __repr__(self) -> str:
        return f"{short_repr(self)[:-1]}, outside={self.outside:.3g})"

    frame: int
    latent: np.ndarray
    force: np.ndarray
    torque: np.ndarray
    pose: np.ndarray
    _basis: Basis = field(repr=False)
    _scene: Mapping[str, Any] = field(repr=False)
    _excess: Callable[[], Excess | None] = field(repr=False)
    force_spread: np.ndarray | None = None
    latent_spread: np.ndarray | None = None

    @property
    def outside(self) -> float:
        """How far this frame is from all that the training runs covered [1]: the distance of the worst of the tool's
        pose and motion, the soil's modes and their velocity, and the context from its training range, in widths of
        that range. 0: inside every range; above 0.05 the answer is a guess; NaN: the tool is nowhere yet."""
        found = self._excess()
        return np.nan if found is None else float(found.amount[-1])

    def soil(self) -> np.ndarray:
        """Positions of all particles [m], shape (n, 3); decoded when asked for."""
        return self._basis.inverse(self.latent).numpy()

    def surface(self, resolution: float | None = None) -> Surface:
        """The soil's surface: x (nx,), y (ny,) and heights z (nx, ny) [m]; in cells with this edge [m], or in columns
        two particle spacings wide; as `Run.surface`."""
        return soil_surface(self.soil(), self._scene, resolution)

    def to_xarray(self) -> xarray.Dataset:
        """All of it with named dimensions and units, and `position` of all particles. Needs xarray."""
        position = ("particle", "axis"), self.soil(), {"units": "m"}
        return _dataset(self, (), self._scene, position=position)


@dataclass(frozen=True, eq=False)
class Snapshot:
    """Where a simulator is, or where a path ends: soil, tool, and all that the next steps follow from. Made by
    `Simulator.save`; small, and may be pickled.

    Attributes:
        frame: As of `State`.
        latent: Likewise.
        pose: Likewise.
    """

    __repr__ = short_repr

    frame: int
    latent: np.ndarray
    pose: np.ndarray
    _answer: tuple[Any, ...] = field(repr=False)
    _shown: Sequence[tuple[np.ndarray, np.ndarray]] = field(repr=False)
    _places: Sequence[Place] = field(repr=False)
    _points: np.ndarray = field(repr=False)
    _context: dict[str, float] = field(repr=False)
    _made_by: str = field(repr=False)

    @classmethod
    def of(
        cls, frame: int, answer: tuple[Any, ...], shown: Sequence[tuple[np.ndarray, np.ndarray]], *rest: Any
    ) -> Snapshot:
        """What may be written to is a copy."""
        return cls(frame, answer[0].copy(), shown[-1][0].copy(), answer, shown, *rest)


def require_index(name: str, index: Any, count: int) -> None:
    """Refuse what is no index of so many."""
    if not is_whole(index) or not -count <= index < count:
        raise UserError(f"{name} is {index!r}; there are {counted(count, name)}: 0 to {count - 1}")


@dataclass(frozen=True, eq=False)
class Rollout:
    """A whole tool path.

    Attributes:
        latent: Modes [m], shape (T, r, 3), float64.
        force: By the soil on the tool [N], shape (T, 3).
        torque: About its centre of mass [N m], shape (T, 3).
        poses: Of the tool, shape (T, 7); predicted where the tool is free.
        body_points: World frame [m], shape (T, M, 3).
        wall_time_s: Time of all steps, force included, decoding not [s].
        end: Where the path ends; other paths may start there.
        force_spread: As of `State`, shape (T, 3), or None.
        latent_spread: Shape (T, r, 3), or None.
    """

    def __repr__(self) -> str:
        return f"{short_repr(self)[:-1]}, outside={self.outside:.3g})"

    latent: np.ndarray
    force: np.ndarray
    torque: np.ndarray
    poses: np.ndarray
    body_points: np.ndarray
    wall_time_s: float
    end: Snapshot = field(repr=False)
    _basis: Basis = field(repr=False)
    _scene: Mapping[str, Any] = field(repr=False)
    _excess: Callable[[], Excess | None] = field(repr=False)
    force_spread: np.ndarray | None = None
    latent_spread: np.ndarray | None = None

    @cached_property
    def excess(self) -> Excess | None:
        """How far every frame is outside the training runs' range, see `State.outside`, and in what; None: a
        predicted tool is nowhere."""
        return self._excess()

    @property
    def outside(self) -> float:
        """The largest of all frames, as `State.outside`."""
        return np.nan if self.excess is None else self.excess.largest

    def soil(self, frame: int = -1) -> np.ndarray:
        """Positions of all particles at a frame, the last one by default [m], shape (n, 3); decoded when asked for."""
        require_index("frame", frame, len(self.latent))
        return self._basis.inverse(self.latent[frame]).numpy()

    def surface(self, frame: int = -1, resolution: float | None = None) -> Surface:
        """The soil's surface there, as `State.surface`."""
        return soil_surface(self.soil(frame), self._scene, resolution)

    def to_xarray(self) -> xarray.Dataset:
        """All frames with named dimensions and units, as `Run.to_xarray`, but modes in place of particles. Needs
        xarray."""
        return _dataset(self, ("time",), self._scene)


@dataclass(frozen=True, eq=False)
class Rollouts:
    """Many tool paths: as of `Rollout`, with B before every shape; `wall_time_s` is that of all of them, and `ends` are
    where they end."""

    __repr__ = short_repr

    latent: np.ndarray
    force: np.ndarray
    torque: np.ndarray
    poses: np.ndarray
    wall_time_s: float
    ends: list[Snapshot] = field(repr=False)
    _basis: Basis = field(repr=False)
    _scene: Mapping[str, Any] = field(repr=False)
    _excess: Callable[..., Excess | None] = field(repr=False)
    _contexts: list[dict[str, float]] = field(repr=False)
    force_spread: np.ndarray | None = None
    latent_spread: np.ndarray | None = None

    @cached_property
    def outside(self) -> np.ndarray:
        """Of every path the largest of all frames, as `Rollout.outside`, shape (B,); computed when asked for."""
        each = [
            self._excess(path, latent=latent, context=context)
            for path, latent, context in zip(self.poses, self.latent, self._contexts, strict=True)
        ]
        return np.array([np.nan if found is None else found.largest for found in each])

    def soil(self, path: int, frame: int = -1) -> np.ndarray:
        """Positions of all particles on a path at a frame, the last one by default [m], shape (n, 3); decoded when
        asked for."""
        for name, index, count in zip(("path", "frame"), (path, frame), self.latent.shape, strict=False):
            require_index(name, index, count)
        return self._basis.inverse(self.latent[path, frame]).numpy()

    def surface(self, path: int, frame: int = -1, resolution: float | None = None) -> Surface:
        """The soil's surface there, as `State.surface`."""
        return soil_surface(self.soil(path, frame), self._scene, resolution)

    def to_xarray(self) -> xarray.Dataset:
        """As `Rollout.to_xarray`, with the dimension `path` and how far each is `outside`. Needs xarray."""
        return _dataset(self, ("path", "time"), self._scene, outside=("path", self.outside))


# What an answer may hold: the name of its variable, its dimensions in a frame, its unit.
_NAMED = {
    "latent": ("latent", ("mode", "axis"), "m"),
    "force": ("force", ("axis",), "N"),
    "torque": ("torque", ("axis",), "N m"),
    "pose": ("pose", ("component",), "m, 1"),
    "poses": ("pose", ("component",), "m, 1"),
    "body_points": ("body_points", ("point", "axis"), "m"),
    "force_spread": ("force_spread", ("axis",), "N"),
    "latent_spread": ("latent_spread", ("mode", "axis"), "m"),
}


def _dataset(answer: Any, lead: tuple[str, ...], scene: Mapping[str, Any], **more: Any) -> xarray.Dataset:
    """An answer whose arrays begin with some dimensions, and more variables."""
    xr = library("xarray", f"{type(answer).__name__.lower()}.to_xarray()")
    variables = {
        name: ((*lead, *dims), getattr(answer, field), {"units": unit})
        for field, (name, dims, unit) in _NAMED.items()
        if getattr(answer, field, None) is not None
    }
    frames = np.arange(answer.force.shape[-2]) if "time" in lead else answer.frame
    time = ("time",) if "time" in lead else (), frames / scene["frame_rate"], {"units": "s"}
    coords = {"time": time, "axis": AXES, "component": POSE}
    return xr.Dataset(variables | more, coords, {"frame_rate": scene["frame_rate"]})


# --- Paths side by side: what they begin with, what the dynamics say along them, where they end -----------


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
