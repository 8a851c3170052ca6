"""Learned soil as gymnasium environments: digging to a target profile, and driving with traction.

`import sgns.envs` registers "sgns/Dig-v0" and "sgns/Drive-v0", one at a time and many side by side
(`gymnasium.make_vec`).

Letters: B beds, r modes, K columns of the profile.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from numbers import Real
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from mpm_warp import Scene
from mpm_warp.motions import sinkage
from mpm_warp.poses import in_world_frame, rotation_matrices
from sgns.beds import Beds
from sgns.config import UserError
from sgns.model.features import context_of
from sgns.model.training_range import TrainingRange
from sgns.numbers import finite_array, is_whole
from sgns.simulator import Simulator

try:
    import gymnasium
    from gymnasium.spaces import Box
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise UserError(
        "sgns.envs needs gymnasium, which is not installed; run: pip install 'sgns[rl]'"
    ) from error

COLUMNS = 20
"""K, columns of the soil's profile along x."""
EFFORT = 0.001
"""Reward that a joule against the soil costs in digging [1/J]."""
DRIVE_COST = 0.2
"""Share of the work of driving that is taken from the work of pulling."""
MOST_SEEN = 10.0
"""What is seen is cut off here [1]; it is of order 1."""


class _Profile:
    """Height of the soil along x at mid-width, from the modes: what is in a column, at the density of the bed at rest.

    The highest particle, as `State.surface` has it, would jump by a grain from step to step.
    """

    def __init__(self, simulator: Simulator, scene: Scene) -> None:
        length, width, self.depth = scene.bed.size
        spacing = scene.bed.particle_spacing * scene.bed.store_every ** (1 / 3)
        middle = np.abs(simulator.start_positions[:, 1] - 0.5 * width) < max(2 * spacing, 0.05 * width)
        rows = torch.from_numpy(middle)
        self.modes = simulator.basis.modes[rows].float().T.contiguous()
        self.mean = simulator.basis.mean[rows].float()
        self.x = (np.arange(COLUMNS) + 0.5) * length / COLUMNS  # (K,) [m]
        self.scale, self.size = COLUMNS / length, spacing * COLUMNS / length
        start = simulator.basis.transform(simulator.start_positions)
        self.at_rest = self._filled(start[None]).clamp_min(1e-9)

    def __call__(self, latent: Tensor) -> np.ndarray:
        """Heights [m] of beds (B, r, 3), shape (B, K)."""
        return self.depth * (self._filled(latent) / self.at_rest - 1.0).double().numpy()

    def _filled(self, latent: Tensor) -> Tensor:
        """Particles in every column, shape (B, K); each is as wide as it has room at rest, and may lie in two."""
        x = latent[..., 0].float() @ self.modes + self.mean[:, 0]
        begin = (x * self.scale - 0.5 * self.size).clamp_(0.0, COLUMNS - 1e-3)
        column = begin.floor()
        beyond = ((begin - column + (self.size - 1.0)) / self.size).clamp_(0.0, 1.0)
        filled, column = x.new_zeros(len(x), COLUMNS + 1), column.long()
        filled.scatter_add_(1, column, 1.0 - beyond).scatter_add_(1, column + 1, beyond)
        return filled[:, :COLUMNS]


class SoilEnvs(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """What the tasks share: beds, episodes of one length, resets at the step after an episode's last.

    Args:
        num_envs: B.
        simulator: A `Simulator`, or a checkpoint's file or name.
        scene: Whose tool and first pose are taken, and the numbers that the network is told; None: those of the
            training runs.
        seconds: Length of an episode.
        frames_per_action: Frames of the soil that an action holds for.
        half: As of `Beds`.

    Raises:
        UserError: The checkpoint or the scene is not for this task.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.NEXT_STEP, "render_modes": []}  # noqa: RUF012  # as of gymnasium
    free_tool: ClassVar[bool]
    actions: ClassVar[int]

    def __init__(
        self,
        num_envs: int = 1,
        simulator: Simulator | str | Path = "excavation",
        scene: Scene | None = None,
        seconds: float = 4.0,
        frames_per_action: int = 6,
        half: bool = False,
    ) -> None:
        for name, value in (("num_envs", num_envs), ("frames_per_action", frames_per_action)):
            if not is_whole(value) or value < 1:
                raise UserError(f"{name} is {value!r}; it must be a whole number, at least 1")
        self.simulator = simulator if isinstance(simulator, Simulator) else Simulator.load(simulator)
        if self.simulator.predicts_body != self.free_tool:
            what = "a wheel, whose height it predicts", "a tool on a prescribed path"
            raise UserError(
                f"{type(self).__name__} needs a network of {what[not self.free_tool]}; this one is of "
                f"{what[self.free_tool]}"
            )
        if self.simulator.device.type != "cpu":
            raise UserError('environments compute on the CPU; load the simulator with device="cpu"')
        self.scene = scene or Scene.from_dict(self.simulator.scene)
        copy.copy(self.simulator).reset(self.scene)  # refuses a scene on another bed
        self.known = TrainingRange.from_plain(self.simulator.card["training_range"])
        self.num_envs, self.frames = num_envs, frames_per_action
        self.frame_time = 1.0 / self.simulator.frame_rate
        whole = isinstance(seconds, Real) and math.isfinite(seconds)
        self.length = round(seconds * self.simulator.frame_rate / frames_per_action) if whole else 0
        if self.length < 1:
            raise UserError(
                f"seconds is {seconds!r}; an episode needs at least one action, {frames_per_action} frames"
            )
        self.start = self.scene.body_poses()[0]
        self.beds = Beds(self.simulator, num_envs, self.scene.body_points(), half)
        self.beds.context[:] = context_of(self.scene.to_dict(), self.simulator.context_keys)
        self.profile = _Profile(self.simulator, self.scene)
        self.elapsed, self.over = np.zeros(num_envs, int), np.zeros(num_envs, bool)
        self.single_action_space = Box(-1.0, 1.0, (self.actions,), np.float32)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._started = False

    def _spaces(self) -> None:
        """The spaces of what is seen, once a task is ready to be looked at."""
        self._begin(np.ones(self.num_envs, bool), np.random.default_rng(0), {})
        self.single_observation_space = Box(-MOST_SEEN, MOST_SEEN, self._seen()[0].shape, np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """All beds at rest, with new targets; options as of the task. Targets are drawn one after the other: of a list
        with a seed for each bed every seed changes all that follows."""
        super().reset(seed=one_seed(seed, self.num_envs))
        self._started = True
        self.elapsed[:], self.over[:] = 0, False
        self._begin(np.ones(self.num_envs, bool), self.np_random, dict(options or {}))
        return self._seen(), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Hold actions (B, actions) for some frames; where an episode is over, begin a new one instead."""
        if not self._started:
            raise UserError("the environment was not reset; call reset() before step()")
        actions = finite_array(actions, "array of actions", (self.num_envs, self.actions)).clip(-1.0, 1.0)
        fresh, rewards = self.over, np.zeros(self.num_envs)
        which = None if not fresh.any() else ~fresh
        earned, info = self._act(actions, which)
        rewards[~fresh] = earned[~fresh]
        self.elapsed += 1
        if fresh.any():
            self.elapsed[fresh] = 0
            self._begin(fresh, self.np_random, {})
        self.over = self.elapsed >= self.length
        return self._seen(), rewards, np.zeros(self.num_envs, bool), self.over.copy(), info

    def _seen(self) -> np.ndarray:
        """What is seen of every bed, shape (B, any), float32."""
        left = 1.0 - self.elapsed / self.length
        seen = np.concatenate([left[:, None], *self._parts()], axis=1)
        return seen.clip(-MOST_SEEN, MOST_SEEN).astype(np.float32)

    def _begin(self, which: np.ndarray, rng: np.random.Generator, options: dict[str, Any]) -> None:
        """New episodes of the beds in a mask (B,)."""
        raise NotImplementedError

    def _act(self, actions: np.ndarray, which: np.ndarray | None) -> tuple[np.ndarray, dict[str, Any]]:
        """Reward (B,) of actions and information."""
        raise NotImplementedError

    def _parts(self) -> list[np.ndarray]:
        """What is seen of the task, (B, any) each."""
        raise NotImplementedError


def one_seed(seed: int | Sequence[int | None] | None, count: int) -> int | None:
    """A seed, or a list of so many, as one; None: nothing is seeded."""
    if seed is None or is_whole(seed):
        return seed  # type: ignore[return-value]  # a whole number
    if not isinstance(seed, (list, tuple)) or len(seed) != count:
        raise UserError(
            f"seed is {seed!r}; it must be one whole number, or a list of {count}, one for each bed"
        )
    if all(one is None for one in seed):
        return None
    if not all(one is None or (is_whole(one) and one >= 0) for one in seed):
        raise UserError(f"seed is {seed!r}; each must be a whole number of 0 or more, or None")
    numbers = [np.random.SeedSequence().entropy if one is None else int(one) for one in seed]
    return int(np.random.SeedSequence(numbers).generate_state(1)[0])  # type: ignore[arg-type]  # whole numbers


class DigEnvs(SoilEnvs):
    """Dig a trench: many beds at once; arguments as of `SoilEnvs`.

    The tool keeps its orientation and goes forward and up or down within the training range.

    Action (2): forward speed, from −1 (rest) to 1 (the fastest trained one), and vertical speed, from −1 (down) to 1.

    Seen: time left [1]; tool's place from its start, x and z, in units of the deepest trained cut; its velocity of the
    last action, x and z, in units of the fastest; force x and z in units of the training runs' mean; height of the soil
    at K places along x at mid-width, and the target there, in units of the deepest cut.

    Reward: how much nearer the soil is to the target, as share of what there was to dig, less `EFFORT` for each joule
    against the soil. "Nearer" is the mean |height − target| over the trench. So a return of 1 is a perfect trench for
    nothing, and 0 a bed at rest.

    Reset option `target`: heights [m] at the K places `profile.x` for all beds, at most 0; else a trench of random
    place, length and depth.
    """

    free_tool = False
    actions = 2

    def __init__(self, num_envs: int = 1, **settings: Any) -> None:
        super().__init__(num_envs, **settings)
        low, high = self.known.low, self.known.high
        self.fastest = float(high["the tool's displacement per frame"][0])  # [m] per frame
        below = float((self._lowest(self.start[None]) - self.start[2])[0])
        self.deepest = -float(low["the tool's lowest point"][0])  # [m]
        if not (self.fastest > 0.0 and self.deepest > 0.0):
            raise UserError("the training runs of this checkpoint never move forward or dig; train on cuts")
        self.low = np.array([self.start[0], -self.deepest - below])  # of x and z [m]
        self.high = np.array(
            [high["the tool's position"][0], max(high["the tool's lowest point"][0] - below, self.start[2])]
        )
        self.high[0] = max(self.high[0], self.low[0])
        self.load = max(float(np.linalg.norm(self.simulator.mean_force)), 1e-9)
        self.tip = float(
            in_world_frame(self.start[None], self.beds.points)[0, :, 0].max(initial=self.start[0])
        )
        self.target, self.error = np.zeros((num_envs, COLUMNS)), np.zeros(num_envs)
        self.to_dig, self.speed = np.ones(num_envs), np.zeros((num_envs, 2))
        self.heights = np.zeros((num_envs, COLUMNS))
        self._spaces()

    def _lowest(self, poses: np.ndarray) -> np.ndarray:
        return in_world_frame(poses, self.beds.points)[:, :, 2].min(axis=1, initial=np.inf)

    def _begin(self, which: np.ndarray, rng: np.random.Generator, options: dict[str, Any]) -> None:
        count, x = int(which.sum()), self.profile.x
        if (given := options.get("target")) is not None:
            target = np.tile(finite_array(given, "target", (COLUMNS,)), (count, 1))
            if not target.max() <= 0.0 or not target.min() < 0.0:
                raise UserError(
                    "the target has heights above 0, or digs nothing; heights are 0 or negative [m]"
                )
        else:
            way = self.high[0] - self.low[0]
            # What is dug is pushed ahead of the tool, beyond the trench.
            begin = self.tip + rng.uniform(0.05, 0.2, (count, 1)) * way
            end = begin + rng.uniform(0.3, 0.5, (count, 1)) * way
            depth = rng.uniform(0.3, 0.8, (count, 1)) * self.deepest
            target = -np.clip(np.minimum(x - begin, end - x), 0.0, depth)  # sides of 45°
        self.target[which], self.speed[which] = target, 0.0
        self.beds.reset(which, np.tile(self.start, (count, 1)))
        self.heights[which] = self.profile(self.beds.latent[which, -1])
        self.error[which] = self._error()[which]
        self.to_dig[which] = np.maximum(self.error[which], 1e-9)

    def _error(self) -> np.ndarray:
        """Mean distance of soil and target over the trench [m], shape (B,)."""
        dug = self.target < 0.0
        return (np.abs(self.heights - self.target) * dug).sum(1) / np.maximum(dug.sum(1), 1)

    def _act(self, actions: np.ndarray, which: np.ndarray | None) -> tuple[np.ndarray, dict[str, Any]]:
        self.speed = np.stack([0.5 * (actions[:, 0] + 1.0), actions[:, 1]], 1)
        work = np.zeros(self.num_envs)
        for _ in range(self.frames):
            poses = self.beds.pose.copy()
            poses[:, [0, 2]] = np.clip(poses[:, [0, 2]] + self.fastest * self.speed, self.low, self.high)
            before = self.beds.pose[:, :3].copy()
            self.beds.step(poses, which)
            work -= (self.beds.force * (self.beds.pose[:, :3] - before)).sum(1)
        self.heights, error = self.profile(self.beds.latent[:, -1]), self.error
        self.error = self._error()
        return (error - self.error) / self.to_dig - EFFORT * work, {"work": work, "error": self.error.copy()}

    def _parts(self) -> list[np.ndarray]:
        place = (self.beds.pose[:, [0, 2]] - self.start[[0, 2]]) / self.deepest
        force = self.beds.force[:, [0, 2]] / self.load
        return [place, self.speed, force, self.heights / self.deepest, self.target / self.deepest]


class DriveEnvs(SoilEnvs):
    """Drive a wheel with traction: many beds at once; arguments as of `SoilEnvs`, the simulator one of wheels.

    The rim turns at the scene's speed; the wheel settles first, before what is seen at the reset.

    Action (1): slip, from −1 (the least) to 1 (the most) of the training runs; 0 to 0.8 where they had only one.

    Seen: time left [1]; way in units of the wheel's diameter; slip; sinkage in diameters; drawbar pull, lateral and
    vertical force in units of the load; drive torque in units of load times radius; the context, from 0 to 1 of its
    training range; height of the soil at K places along x at mid-width in diameters.

    Reward: work of the pull, less `DRIVE_COST` of the work of driving, in units of load times radius.

    Loads, gravity and friction angles that the network was trained with are drawn anew for each episode.
    """

    free_tool = True
    actions = 1
    drawn: ClassVar = ("load", "gravity", "friction_angle", "material.friction_angle")

    def __init__(self, num_envs: int = 1, simulator: Simulator | str | Path = "", **settings: Any) -> None:
        if isinstance(simulator, str) and not simulator:
            raise UserError(
                "DriveEnvs needs simulator=, a network of wheels; train one: sgns train dataset=quick_wheel"
            )
        super().__init__(num_envs, simulator, **settings)
        values: Mapping[str, Any] = self.scene.to_dict()
        self.values = values
        self.radius, self.rim_speed = 0.5 * values["diameter"], float(values["rim_speed"])
        keys = self.simulator.context_keys
        self.low, self.width = np.zeros(len(keys)), np.ones(len(keys))
        for i, key in enumerate(keys):
            self.low[i] = self.known.low[key][0]
            self.width[i] = self.known.high[key][0] - self.low[i]
        self.column = {key: i for i, key in enumerate(keys)}
        self.least, self.most = 0.0, 0.8
        if "slip" in self.column:
            self.least = float(self.low[self.column["slip"]])
            self.most = self.least + float(self.width[self.column["slip"]])
        load = values["load"]
        self.load = load if isinstance(load, (int, float)) else max(row[1] for row in load)
        self.settling = round(values["settle"] / self.frame_time)
        self.angle, self.slip = np.zeros(num_envs), np.full(num_envs, self.least)
        self._spaces()

    def _begin(self, which: np.ndarray, rng: np.random.Generator, options: dict[str, Any]) -> None:
        count = int(which.sum())
        self.beds.context[which] = context_of(self.scene.to_dict(), self.simulator.context_keys)
        for key in self.drawn:
            if key in self.column:
                i = self.column[key]
                self.beds.context[which, i] = self.low[i] + self.width[i] * rng.random(count)
        self.angle[which], self.slip[which] = 0.0, self.least
        self._tell_slip()
        self.beds.reset(which, np.tile(self.start, (count, 1)))
        for _ in range(self.settling):
            self.beds.step(self.beds.pose.copy(), which)

    def _tell_slip(self) -> None:
        if "slip" in self.column:
            self.beds.context[:, self.column["slip"]] = self.slip

    def _travel(self) -> np.ndarray:
        """Of the wheels per way of their rims, shape (B,); see `slip` and `travel_speed` of `mpm_warp.Wheel`."""
        if self.scene.travel_speed is None:  # type: ignore[attr-defined]  # of a wheel
            return 1.0 - self.slip
        return np.where(self.slip < 0.0, 1.0 / (1.0 + np.clip(self.slip, -0.99, 0.0)), 1.0 - self.slip)

    def _loads(self) -> np.ndarray:
        """Weight that every wheel carries [N], shape (B,)."""
        if "load" in self.column:
            return self.beds.context[:, self.column["load"]]
        return np.full(self.num_envs, self.load)

    def _axes(self) -> tuple[np.ndarray, np.ndarray]:
        """The wheels' headings and axles, unit vectors, shape (B, 3) each."""
        axle = rotation_matrices(self.beds.pose[:, 3:])[:, :, 1]
        return np.cross(axle, [0.0, 0.0, 1.0]), axle

    def _act(self, actions: np.ndarray, which: np.ndarray | None) -> tuple[np.ndarray, dict[str, Any]]:
        moving = np.ones(self.num_envs, bool) if which is None else which
        self.slip[moving] = (self.least + 0.5 * (actions[:, 0] + 1.0) * (self.most - self.least))[moving]
        self._tell_slip()
        way = self.rim_speed * self.frame_time * self._travel()
        way, turn = way * moving, self.rim_speed * self.frame_time / self.radius * moving
        pulled, driven = np.zeros(self.num_envs), np.zeros(self.num_envs)
        for _ in range(self.frames):
            self.angle += turn
            poses = self.beds.pose.copy()
            poses[:, 0] += way
            poses[:, 3:] = _turned(self.start[3:], self.angle)
            self.beds.step(poses, which)
            heading, axle = self._axes()
            pulled += (self.beds.force * heading).sum(1) * way
            driven -= (self.beds.torque * axle).sum(1) * turn
        unit = self._loads() * self.radius
        return (pulled - DRIVE_COST * driven) / unit, {"pull_work": pulled, "drive_work": driven}

    def _parts(self) -> list[np.ndarray]:
        diameter, loads, (heading, axle) = 2.0 * self.radius, self._loads(), self._axes()
        way, depth = self.beds.pose[:, 0] - self.start[0], sinkage(self.values, self.beds.pose)
        vectors = heading, axle, np.array([0.0, 0.0, 1.0])
        forces = [(self.beds.force * vector).sum(1) / loads for vector in vectors]
        torque = (self.beds.torque * axle).sum(1) / (loads * self.radius)
        context = (self.beds.context - self.low) / np.maximum(self.width, 1e-12)
        heights = self.profile(self.beds.latent[:, -1]) / diameter
        own = [way / diameter, self.slip, depth / diameter, *forces, torque]
        return [np.stack(own, 1), context, heights]


def _turned(start: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """A quaternion turned about its own y axis by angles (B,) [rad], shape (B, 4)."""
    (x, y, z, w), s, c = start, np.sin(0.5 * angles), np.cos(0.5 * angles)
    return np.stack([x * c - z * s, y * c + w * s, z * c + x * s, w * c - y * s], 1)


class _Alone(gymnasium.Env[np.ndarray, np.ndarray]):
    """One bed of a task."""

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  # as of gymnasium
    many: ClassVar[type[SoilEnvs]]

    def __init__(self, **settings: Any) -> None:
        self.envs = self.many(1, **settings)
        self.observation_space = self.envs.single_observation_space
        self.action_space = self.envs.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """As of the task's environments."""
        super().reset(seed=seed)
        self.envs.np_random = self.np_random
        seen, info = self.envs.reset(options=options)
        return seen[0], info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """As of the task's environments; after an episode's end comes `reset`."""
        seen, reward, ended, over, info = self.envs.step(np.asarray(action)[None])
        plain = {key: float(value[0]) for key, value in info.items()}
        return seen[0], float(reward[0]), bool(ended[0]), bool(over[0]), plain


class Dig(_Alone):
    """Dig a trench, one bed; see `DigEnvs`."""

    many = DigEnvs


class Drive(_Alone):
    """Drive a wheel with traction, one bed; see `DriveEnvs`."""

    many = DriveEnvs


for _name in ("Dig", "Drive"):
    gymnasium.register(f"sgns/{_name}-v0", f"sgns.envs:{_name}", vector_entry_point=f"sgns.envs:{_name}Envs")
