"""The trained thing a person holds: put a tool in, get soil, force and torque out.

Of a wheel, whose height follows from the soil, the pose that is put in says how it is driven, and the height comes out.

Letters: B paths, T frames, n particles, M body points, N body nodes, d history positions, r modes.
"""

from __future__ import annotations

import copy
import hashlib
import math
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mpm_warp.poses import in_world_frame
from sgns.config import UserError
from sgns.model.checkpoint import Surrogate, load_surrogate, pretrained_file
from sgns.model.dynamics import Place, Step, Stepper, together
from sgns.model.features import Pace, context_of, markers
from sgns.model.training_range import FAR, Excess, TrainingRange
from sgns.numbers import (
    check_pose,
    check_poses,
    counted,
    elapsed,
    finite_array,
    first_pose,
    is_whole,
    real_array,
)
from sgns.state import (
    Followed,
    Paths,
    Rollout,
    Rollouts,
    Snapshot,
    State,
    ends_of,
    followed,
    mean_pose,
    one_each,
    same_pose,
    told_numbers,
)

# Soil follows the clock for so long after the tool has moved at the pace of the training runs, then the tool [s].
_SETTLING = 0.5


class Simulator:
    """Steps a bed of soil in a few modes under a tool whose poses are given.

    Copies go on from where this one is, to the bit as it does, and on their own: `copy.copy`, which shares the weights,
    `copy.deepcopy`, and pickled ones, in other processes too. `reset`, `step` and `restore` are for one thread at a
    time: give each thread a copy. `rollout` and `rollouts` change nothing and may run in several threads, of one
    simulator, too. Processes made by `fork` need `torch.set_num_threads(1)` first, else torch may wait for threads that
    stayed with their parent.

    Args:
        surrogate: Network, basis and start.
        device: "cpu" or "cuda".
        num_modes: Of the soil, the first of those it was trained with; None: all.
        rate_independent: Whether the soil follows a prescribed tool, not the clock, where the tool is slower than in
            all training runs (see `sgns.model.features`).
        spread: Of an ensemble, whether all members are stepped, each on its own soil: everything is their mean then,
            and states and rollouts have a spread. Otherwise the first member alone answers.

    Attributes:
        basis: Modes of the soil.
        dynamics: What steps the modes: network or polynomials; of several members the first.
        start_positions: Of all particles at rest [m], shape (n, 3).
        body_points: Those of the training runs, in the body frame [m], shape (M, 3).
        mean_force: Of the training runs [N], shape (3,): the simplest prediction of a force.
        frame_rate: Steps per second of simulated time [Hz].
        history: d, positions the network looks back on.
        num_modes: r, modes of the soil.
        context_keys: Numbers of the scene that the network is told.
        predicts_body: Whether the tool's height is predicted, as that of a wheel, not prescribed.
        arrangement_hash: Of the particle arrangement it knows.
        card: Where it comes from: settings, runs, versions.

    Raises:
        UserError: The device cannot be used, the modes are more than there are, or a spread is asked of one network.
    """

    def __init__(
        self,
        surrogate: Surrogate,
        device: str = "cpu",
        num_modes: int | None = None,
        rate_independent: bool = True,
        spread: bool = False,
    ) -> None:
        for name, value in (("rate_independent", rate_independent), ("spread", spread)):
            if not isinstance(value, (bool, np.bool_)):
                raise UserError(f"{name} is {value!r}; it must be True or False")
        try:
            self.device = torch.device(device)
            # On others, such as "meta", tensors hold no values or no float64.
            if self.device.type not in ("cpu", "cuda"):
                raise ValueError('allowed: "cpu", "cuda"')
            self._surrogate = surrogate.to(self.device).eval()
        except (RuntimeError, AssertionError, TypeError, ValueError) as error:
            raise UserError(
                f"device={device} cannot be used: {str(error).splitlines()[0]}; use device=cpu"
            ) from error
        dynamics, self.basis = surrogate.dynamics, surrogate.basis
        if num_modes is not None:
            dynamics, self.basis = dynamics.with_modes(num_modes), self.basis.sliced(num_modes)
        if spread and dynamics.members == 1:
            raise UserError(
                f"spread is true, and this {dynamics.settings.kind} has one member; train with training.members=4, or "
                "leave spread out"
            )
        self._members = [dynamics.member(index) for index in range(dynamics.members if spread else 1)]
        self._band = dynamics.band.cpu().numpy().copy() if spread else np.ones(4)
        self.dynamics = dynamics = self._members[0]
        self.history, self.num_modes = dynamics.history, dynamics.num_modes
        self.context_keys, self.predicts_body = dynamics.context_keys, dynamics.predicts_body
        self.frame_rate, self.card = surrogate.frame_rate, surrogate.card
        self.arrangement_hash = self.basis.arrangement_hash
        # When the soil takes a step; None: always.
        self._pace: Pace | None = None
        if rate_independent and not dynamics.predicts_body:
            self._pace = Pace.of(surrogate.slowest_travel, math.ceil(_SETTLING * surrogate.frame_rate))
        # Copies: what a tensor shares with an array is freed when the tensor is sent to another process.
        self.start_positions, self.body_points, self.mean_force = (
            tensor.cpu().numpy().copy()
            for tensor in (surrogate.start_positions, surrogate.body_points, dynamics.force.mean)
        )
        self._warned = False
        self._start_latent = self.basis.transform(surrogate.start_positions.cpu())
        self.reset()

    def __repr__(self) -> str:
        size = f"{len(self.start_positions)} particles in {self.num_modes} modes, {self.frame_rate:g} Hz"
        return f"Simulator({self.dynamics.settings.kind}: {size}, at frame {self._frame})"

    def __copy__(self) -> Simulator:
        copied = object.__new__(type(self))
        copied.__dict__.update(self.__dict__)
        # All else is replaced, not written to, from step to step.
        copied._steppers = [copy.copy(stepper) for stepper in self._steppers]
        return copied

    @classmethod
    def load(
        cls,
        path: str | Path,
        device: str = "cpu",
        num_modes: int | None = None,
        rate_independent: bool = True,
        spread: bool = False,
    ) -> Simulator:
        """From a checkpoint written by `sgns train`, or UserError; the other arguments as of the class."""
        return cls(load_surrogate(path), device, num_modes, rate_independent, spread)

    @classmethod
    def pretrained(cls, name: str, **options: Any) -> Simulator:
        """One that ships with the package; options are those of `load`.

        Raises:
            UserError: None of that name ships; the line names those that do.
        """
        return cls.load(pretrained_file(name), **options)

    @property
    def pace(self) -> Pace | None:
        """When the soil takes a step under a prescribed tool; None: it follows the clock."""
        return self._pace

    @property
    def training_range(self) -> TrainingRange:
        """What the training runs covered."""
        return self._surrogate.training_range

    @property
    def scene(self) -> dict[str, Any]:
        """Scene of one of the training runs, as plain data, a copy: its bed is the bed it knows. The mesh of a tool is
        not in it, but in the run (`Run.mesh`)."""
        return copy.deepcopy(self._surrogate.card["scene"])

    def reset(
        self,
        scene: Any = None,
        history: tuple[np.ndarray, np.ndarray] | None = None,
        values: Mapping[str, Any] | None = None,
        body_points: np.ndarray | None = None,
    ) -> State:
        """Start again; returns the state at frame 0.

        Args:
            scene: An `mpm_warp.Scene`, whose first pose and body points are taken; or a pose, shape (7,), or
                poses, shape (T, 7), of which the first is taken. None: the tool is where the first `step`
                puts it.
            history: Latent positions (d, r, 3) [m] and tool poses (d, 7) to go on from, oldest first; None:
                the bed at rest at its common start.
            values: The scene as plain data, where `scene` is none; a network that was trained with different loads,
                soils or the like reads them there. None: those of `simulator.scene`.
            body_points: Of the tool in the body frame [m], shape (M, 3); None: those of the scene, or of the training
                runs.

        Raises:
            UserError: The scene has another bed, or what is given is not of the shape and kind above; then the
                simulator stays where it was.
        """
        pose = None
        if scene is not None and hasattr(scene, "body_poses"):
            if scene.arrangement_hash != self.arrangement_hash:
                raise UserError(
                    f"the scene's particles ({scene.arrangement_hash}) are not those of the checkpoint "
                    f"({self.arrangement_hash}); use the bed of simulator.scene and begin above the soil"
                )
            body_points = scene.body_points() if body_points is None else body_points
            pose, values = first_pose(scene.body_poses()), scene.to_dict()
        elif scene is not None:
            pose = first_pose(scene)
        points, context = self._checked_points(body_points), self._context_of(values)
        if history is None:
            latent = self._start_latent.expand(self.history, -1, -1)
            poses = [] if pose is None else [pose] * self.history
        else:
            latent, poses = self._checked_beginning(history)
        told = told_numbers([context], self.device)
        steppers = [member.stepper(len(points), told) for member in self._members]
        # All is in order: nothing is changed before.
        self._frame, self._points, self._context, self._steppers = 0, points, context, steppers
        place = Place(
            poses, latent.clone().to(self.device), np.zeros(3), np.zeros(3), self._slow_after(poses, points)
        )
        self._places = [place] * len(steppers)
        self._rows: list[np.ndarray | None] = [None] * len(steppers)
        self._answer = self._together(self._places)
        # The last two frames; what the network sees may be further apart.
        last = poses[-2:] or [np.full(7, np.nan)]
        self._shown: Sequence[tuple[np.ndarray, np.ndarray]] = list(
            zip(last, latent[-len(last) :].numpy().copy(), strict=True)
        )
        return self._state()

    def step(self, tool_pose: np.ndarray) -> State:
        """Move the tool to its next pose and the soil with it; returns the state then.

        Args:
            tool_pose: Centre of mass [m] and unit quaternion x, y, z, w one frame from now, shape (7,).

        Raises:
            UserError: The pose is no finite array of shape (7,), its quaternion is not of unit length, or the answer is
                not finite; then the simulator stays where it was.
        """
        pose = check_pose(tool_pose, f"tool pose of frame {self._frame + 1}")
        places, rows, shown = self._places, self._rows, self._shown[-1]
        if not places[0].poses:
            poses = [pose] * self.history
            slow = self._slow_after(poses, self._points)
            places = [place._replace(poses=poses, slow=slow) for place in places]
            shown = pose, shown[1]
        slow, steps = places[0].slow, True
        if slow is not None and self._pace is not None:
            moved, stepped = partial(self._pace.moved, self._points), places[0].poses[-1]
            slow, steps = self._pace.after(slow, moved(shown[0], pose), lambda: moved(stepped, pose))
        if steps:
            places, rows = self._step_soil(places, pose)
            pose = mean_pose([place.poses[-1] for place in places])
        if slow != places[0].slow:
            places = [place._replace(slow=slow) for place in places]
        self._places, self._rows, self._answer = places, rows, self._together(places)
        self._shown = [shown, (pose, self._answer[0])]
        self._frame += 1
        state = self._state()
        known = self._surrogate.training_range
        if not self._warned and (self._frame == 1 or known.far(shown[0], pose, self._points)):
            self._look(self._frame - 1, np.stack([shown[0], pose])[None], self._points, self._context)
        return state

    def _look(
        self,
        begin: int,
        paths: np.ndarray,
        points: np.ndarray,
        context: Mapping[str, float],
        at_once: int = 1,
    ) -> None:
        """Warns, once, of a tool that is far outside the training range on paths (B, T, 7) from frame `begin` on."""
        known, whole = self._surrogate.training_range, np.flatnonzero(np.isfinite(paths).all(axis=(1, 2)))
        if self._warned or not len(whole):
            return

        def excess(some: np.ndarray) -> Excess:
            latent = np.zeros((some[..., 0].size, self.num_modes, 3))
            found = known.excess(some.reshape(-1, 7), points, latent, context, "the tool's", len(some))
            assert found is not None
            return found

        parts = [paths[whole[first : first + at_once]] for first in range(0, len(whole), at_once)]
        largest = np.concatenate([excess(part).amount.reshape(len(part), -1).max(axis=1) for part in parts])
        if not largest.max() > FAR:
            return
        self._warned, path = True, whole[largest.argmax()]
        found = excess(paths[path][None])
        worst, many = int(found.amount.argmax()), ""
        if len(paths) > 1:
            far = f"{(largest > FAR).sum()} of {len(paths)} paths"
            many = f"far outside the training range: {far}, worst of all path {path}; there, "
        unit = "; positions look like millimetres and are taken as metres"
        warnings.warn(
            f"{many}at frame {begin + worst} {found.quantity[worst]} is {found.amount[worst]:.2g} times its training "
            f"range outside of it{unit * known.in_millimetres(paths[path])}: force and soil are a guess there "
            "(`outside` of every state and rollout says how far; this line comes once)",
            stacklevel=3,
        )

    def _step_soil(
        self, places: Sequence[Place], pose: np.ndarray
    ) -> tuple[list[Place], list[np.ndarray | None]]:
        """Let every member take a step to where the tool is put; returns where they are then, and the rows of the
        tool's last d frames. What fails changes nothing."""
        memories = [stepper.memory for stepper in self._steppers]
        try:
            members = zip(self._steppers, places, self._rows, strict=True)
            stepped = [self._stepped(*member, pose) for member in members]
            return [place for place, _ in stepped], [rows for _, rows in stepped]
        except BaseException:  # an interruption as well
            for stepper, memory in zip(self._steppers, memories, strict=True):
                stepper.memory = memory
            raise

    def _stepped(
        self, stepper: Stepper, place: Place, rows: np.ndarray | None, pose: np.ndarray
    ) -> tuple[Place, np.ndarray]:
        """Where one member is after a step, and the rows of the tool's last d frames."""
        if rows is None:
            rows = self.dynamics.rows(np.stack(place.poses), self._points)
        before, following = place.poses[-1], partial(self.dynamics.next_rows, rows)
        rows = following(before, pose, self._points)
        step = stepper.step(place.latent[None], rows)
        self._require_finite(step)
        with torch.inference_mode():
            latent = torch.cat([place.latent[1:], step.latent])
        if self.predicts_body:
            there = torch.from_numpy(rows[-2, :, :3]) + step.displacement[0].cpu()
            pose = self.dynamics.predicted_poses(pose[None], there[None].numpy(), self._points)[0]
            rows = following(before, pose, self._points)
        load = step.force[0].cpu().numpy().copy(), step.torque[0].cpu().numpy().copy()
        return Place([*place.poses[1:], pose], latent, *load, place.slow), rows

    def save(self) -> Snapshot:
        """Where this is now: a small object to keep, to pickle and to send to other processes. `restore` goes on from
        it; `rollout` and `rollouts` start from it."""
        places = [
            place._replace(latent=place.latent.cpu(), memory=stepper.memory)
            for place, stepper in zip(self._places, self._steppers, strict=True)
        ]
        told = self._points, self._context, self._made_by
        return Snapshot.of(self._frame, self._answer, self._shown, places, *told)

    def restore(self, snapshot: Snapshot) -> State:
        """Go on from where this simulator was saved, or another one of the same checkpoint and options, to the bit as
        that one did; returns the state there.

        Raises:
            UserError: It was saved by another simulator; then this one stays where it was.
        """
        self._require_own(snapshot)
        if self._context != snapshot._context or not np.array_equal(self._points, snapshot._points):
            told = told_numbers([snapshot._context], self.device)
            self._steppers = [member.stepper(len(snapshot._points), told) for member in self._members]
        for stepper, place in zip(self._steppers, snapshot._places, strict=True):
            stepper.memory = place.memory
        self._frame, self._points, self._context = snapshot.frame, snapshot._points, snapshot._context
        self._places = [place._replace(latent=place.latent.to(self.device)) for place in snapshot._places]
        self._rows = [None] * len(self._places)
        self._answer, self._shown = snapshot._answer, snapshot._shown
        return self._state()

    def _require_own(self, snapshot: Snapshot) -> None:
        """Refuse what `save` of such a simulator did not give."""
        if not isinstance(snapshot, Snapshot):
            raise UserError(
                f"the snapshot is a {type(snapshot).__name__}; it must be what `Simulator.save` gives"
            )
        if snapshot._made_by != self._made_by:
            raise UserError(
                f"the snapshot was saved by another simulator ({snapshot._made_by}) than this one ({self._made_by}); "
                "load the checkpoint that it was saved with, with the same options"
            )

    @cached_property
    def _made_by(self) -> str:
        """What tells a place of this simulator from one of others."""
        digest = hashlib.sha256()
        for value in self._surrogate.dynamics.state_dict().values():
            digest.update(value.cpu().reshape(-1).view(torch.uint8).numpy().tobytes())
        kind, many = self.dynamics.settings.kind, counted(len(self._members), "member")
        pace = "own pace" if self._pace is None else "tool's pace"
        return f"{kind} {digest.hexdigest()[:8]}, {self.num_modes} modes, {many}, {pace}"

    def rollout(
        self,
        poses: np.ndarray,
        body_points: np.ndarray | None = None,
        latent_history: np.ndarray | Tensor | None = None,
        force_history: np.ndarray | None = None,
        torque_history: np.ndarray | None = None,
        values: Mapping[str, Any] | None = None,
        start: Snapshot | None = None,
    ) -> Rollout:
        """Follow a whole tool path; the same as stepping along it. Leaves `reset` and `step` alone.

        Args:
            poses: Tool at every frame, shape (T, 7); what is predicted of it is read in the given frames only.
            body_points: In the body frame [m], shape (M, 3); None: those of the start, or of the training runs.
            latent_history: The first d frames [m], shape (d, r, 3); frames d to T - 1 are predicted. None:
                frame 0 is the start, and frames 1 to T - 1 are predicted.
            force_history: Force of the first d frames [N], shape (d, 3), copied; zero if None. Needs a latent history.
            torque_history: Torque of the first d frames [N m], likewise.
            values: The scene as plain data, as for `reset`; None: those of the start, or of `simulator.scene`.
            start: What `save` gave, or the `end` of another rollout: frame 0, in which the tool is where it was then.
                None: the bed at rest at its common start.

        Raises:
            UserError: What is given is not of the shape and kind above, or the path is shorter than the history.
        """
        poses, d = check_poses(poses), self.history
        loads = [
            None if load is None else finite_array(load, what, (d, 3))
            for what, load in (("force history", force_history), ("torque history", torque_history))
        ]
        begin = self._begin(poses[None], body_points, [values], [start])
        if latent_history is None:
            given = 1
            if any(load is not None for load in loads):
                raise UserError(
                    "a force or torque history needs the latent history of the same frames; give it, too"
                )
        else:
            given, latent = d, self._checked_history(latent_history)
            if start is not None:
                raise UserError("a path begins with a start or with a latent history; give one of them")
            if len(poses) < d:
                raise UserError(
                    f"the path has {len(poses)} frames; with a given history it needs at least {d}"
                )
            slow, rest = self._slow_after(poses[:d], begin.points), np.zeros(3)
            begin = begin._replace(
                places=[[Place(list(poses[:d]), latent, rest, rest, slow)] * len(self._members)]
            )
        began = time.perf_counter()
        found = self._follow(begin, given, loads)
        wall_time = elapsed(began, time.perf_counter())
        (context,), (end,) = begin.contexts, ends_of(found, begin, self._made_by)
        parts: list[Any] = [None if part is None else part[0] for part in found[:-1]]
        states, force, torque, poses, world, *spread = parts
        self._look(0, begin.poses, begin.points, context)
        excess = partial(self._surrogate.training_range.excess, poses, begin.points, states, context)
        of = self.basis, self.scene
        return Rollout(states, force, torque, poses, world, wall_time, end, *of, excess, *spread)

    def rollouts(
        self,
        poses: np.ndarray,
        body_points: np.ndarray | None = None,
        values: Mapping[str, Any] | Sequence[Mapping[str, Any]] | None = None,
        paths_at_once: int = 256,
        start: Snapshot | Sequence[Snapshot] | None = None,
    ) -> Rollouts:
        """Follow many tool paths side by side; one by one they give the same to rounding.

        Args:
            poses: Tool on every path at every frame, shape (B, T, 7).
            body_points: As for `rollout`, for all paths.
            values: As for `rollout`, for all paths or a list of B.
            paths_at_once: Paths stepped together: bounds the memory beside the result.
            start: As for `rollout`, for all paths or a list of B.

        Returns:
            Modes, force, torque and poses of all paths: (B, T, ...) arrays, see `Rollouts`.

        Raises:
            UserError: What is given is not of the shape and kind above.
        """
        poses = real_array(poses, "array of paths", "shape (paths, frames, 7)")
        if poses.ndim != 3 or poses.shape[2] != 7 or 0 in poses.shape:
            raise UserError(f"the array of paths has shape {poses.shape}; it needs shape (paths, frames, 7)")
        if not is_whole(paths_at_once) or paths_at_once < 1:
            raise UserError(f"paths_at_once is {paths_at_once!r}; it must be a whole number, at least 1")
        poses, count = np.stack([check_poses(path, f"path {i}") for i, path in enumerate(poses)]), len(poses)
        told, starts = one_each(values, Mapping, "values", count), one_each(start, Snapshot, "start", count)
        begin = self._begin(poses, body_points, told, starts)
        began = time.perf_counter()
        found, ends = [], []
        for first in range(0, count, paths_at_once):
            some = begin.part(slice(first, first + paths_at_once))
            one = self._follow(some)
            found.append(one._replace(worlds=None))
            ends += ends_of(one, some, self._made_by)
        whole: list[Any] = [
            None if part[0] is None else np.concatenate(part) for part in list(zip(*found, strict=True))[:-1]
        ]
        latent, force, torque, poses, _, *spread = whole
        wall_time = elapsed(began, time.perf_counter())
        self._look(0, begin.poses, begin.points, begin.contexts[0], paths_at_once)
        excess = partial(self._surrogate.training_range.excess, points=begin.points)
        of = self.basis, self._surrogate.card["scene"]
        return Rollouts(latent, force, torque, poses, wall_time, ends, *of, excess, begin.contexts, *spread)

    def _begin(
        self,
        poses: np.ndarray,
        body_points: np.ndarray | None,
        values: Sequence[Mapping[str, Any] | None],
        starts: Sequence[Snapshot | None],
    ) -> Paths:
        """What B paths of poses (B, T, 7) begin with."""
        for start in starts:
            if start is not None:
                self._require_own(start)
        own = [start._points for start in starts if start is not None]
        if body_points is None and own:
            points = own[0]
            if any(not np.array_equal(points, other) for other in own):
                raise UserError(
                    "the starts have different body points; give body_points, or roll out each tool on its own"
                )
        else:
            points = self._checked_points(body_points)
        contexts: list[dict[str, float]] = []
        places: list[Sequence[Place]] = []
        poses, zero = poses.copy(), np.zeros(3)
        for i, (path, told, start) in enumerate(zip(poses, values, starts, strict=True)):
            contexts.append(self._context_of(told) if told is not None or start is None else start._context)
            rest = [path[0].copy()] * self.history
            slow = None if self._pace is None else self._pace.settling
            if start is None:
                latent = self._start_latent.expand(self.history, -1, -1)
                places.append([Place(rest, latent, zero, zero, slow)] * len(self._members))
            elif not start._places[0].poses:  # the tool is nowhere yet
                places.append([place._replace(poses=rest, slow=slow) for place in start._places])
            else:
                there = start._shown[-1][0]
                if not self.predicts_body and not same_pose(path[0], there):
                    raise UserError(
                        f"path {i} begins at {path[0].tolist()}, and the tool of its start is at {there.tolist()}; "
                        "let it begin there: its frame 0 is the start"
                    )
                path[0] = there
                places.append(start._places)
        return Paths(poses, points, contexts, places, starts)

    @property
    def _follow(self) -> Callable[..., Followed]:
        """`followed` with what does not change."""
        return partial(followed, self._members, self._band, self._pace)

    def _require_finite(self, step: Step) -> None:
        """Refuses a step that says nothing; the simulator stays where it was."""
        # A sum in plain numbers is quickest; it may also overflow.
        if math.isfinite(sum(sum(part.flatten().tolist()) for part in step)):
            return
        names = "the soil's state", "the force", "the torque", "the tool's motion"
        bad = [name for name, part in zip(names, step, strict=True) if not bool(part.isfinite().all())]
        if not bad:
            return
        raise UserError(
            f"{bad[0]} is not finite at frame {self._frame + 1}, likely because the tool's pose of that frame lies "
            f"far from everything the network knows; frame {self._frame} is kept: step to another pose, or reset"
        )

    def _state(self) -> State:
        """The newest state."""
        # It holds nothing of the simulator that goes on changing.
        excess = partial(_excess_of, self._surrogate.training_range, self._shown, self._points, self._context)
        copies: list[Any] = [part if part is None else part.copy() for part in self._answer]
        latent, force, torque, *spread = copies
        scene, pose = self._surrogate.card["scene"], self._shown[-1][0].copy()
        return State(self._frame, latent, force, torque, pose, self.basis, scene, excess, *spread)

    def _together(self, places: Sequence[Place]) -> tuple[Any, ...]:
        """Newest latent positions, force and torque, the mean of all members, then the spread of force and modes."""
        # Copies, see `__init__`.
        latents = [place.latent[-1].cpu().numpy().copy() for place in places]
        if len(places) == 1:
            return latents[0], places[0].force, places[0].torque, None, None
        latent, latent_spread = together(np.stack(latents), self._band[3])
        force, force_spread = together(np.stack([place.force for place in places]), self._band[:3])
        torque, _ = together(np.stack([place.torque for place in places]), 1.0)
        return latent, force, torque, force_spread, latent_spread

    def _context_of(self, values: Mapping[str, Any] | None) -> dict[str, float]:
        """The numbers of a scene that the network is told, by their keys."""
        if values is not None and not isinstance(values, Mapping):
            raise UserError(
                f"values is a {type(values).__name__}; it must be a scene as plain data, such as simulator.scene"
            )
        numbers = context_of(self.card["scene"] if values is None else values, self.context_keys)
        return dict(zip(self.context_keys, numbers.tolist(), strict=True))

    def _slow_after(self, poses: Sequence[np.ndarray] | np.ndarray, points: np.ndarray) -> int | None:
        """Frames since the tool was last not slow after some poses, if that is looked at and it is somewhere."""
        if self._pace is None or not len(poses):
            return None
        path = np.stack(list(poses))
        return self._pace.slow_after(markers(path, in_world_frame(path, points)))

    def _checked_history(self, latent: np.ndarray | Tensor) -> Tensor:
        if isinstance(latent, Tensor):
            latent = latent.detach().cpu()
        shape = (self.history, self.num_modes, 3)
        return torch.as_tensor(finite_array(latent, "latent history", shape))

    def _checked_beginning(self, history: tuple[np.ndarray, np.ndarray]) -> tuple[Tensor, list[np.ndarray]]:
        """Latent positions (d, r, 3) and d poses (7,) to go on from."""
        if not isinstance(history, Sequence) or len(history) != 2:
            raise UserError("the history must be a pair: latent positions (d, r, 3) and tool poses (d, 7)")
        latent, poses = self._checked_history(history[0]), check_poses(history[1], "history of poses")
        if len(poses) != self.history:
            raise UserError(f"the history has {len(poses)} poses; this network looks back on {self.history}")
        return latent, list(poses)

    def _checked_points(self, points: np.ndarray | None) -> np.ndarray:
        """Body points (M, 3) [m], a copy; those of the training runs if None."""
        if points is None:
            return self.body_points.copy()
        # Runs without points have a network that needs none.
        found = finite_array(points, "array of body points", ("M" if len(self.body_points) else 0, 3))
        fitted = self.predicts_body and self.dynamics.settings.body_nodes == "points"
        if fitted and np.linalg.matrix_rank(found - found[0]) < 2:
            raise UserError(
                f"the {len(found)} body points lie on one line; the pose of a body that the network moves needs three "
                "that do not"
            )
        return found


def _excess_of(
    known: TrainingRange, shown: Sequence[tuple[np.ndarray, np.ndarray]], *told: Any
) -> Excess | None:
    """Of the last two frames: velocities take the one before as well."""
    poses, latent = (np.stack(part) for part in zip(*shown, strict=True))
    points, context = told
    return known.excess(poses, points, latent, context)
