"""What a page shows: soil under a tool that a person drives, or recorded runs. Both tell of themselves in plain values
and arrays, then frame by frame as bytes that the page's scripts read.

Letters: T frames, n particles, r modes, c closure modes, t triangles.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import torch

from mpm_warp import Scene, SceneError
from mpm_warp.motions import sinkage
from mpm_warp.poses import in_body_frame, in_world_frame, rotate
from sgns.config import UserError
from sgns.data.run import Run
from sgns.data.surface import particle_spacing
from sgns.evaluate.body_shape import bodies, body_triangles, is_mesh
from sgns.evaluate.metrics import named_forces, named_torques
from sgns.evaluate.views import LEAST_SPEED, nice
from sgns.model.checkpoint import Surrogate
from sgns.model.features import context_of, is_wheel
from sgns.model.training_range import NOTEWORTHY, Excess
from sgns.plot import MADE_BY, require_finite
from sgns.rollout import require_known_bed, require_same_freedom, write_rollout
from sgns.simulate.campaign import require_space
from sgns.simulator import Simulator
from sgns.state import Rollout, State
from sgns.view.controls import ToolControls, WheelControls

FIELDS = (
    *("frame", "time", "outside", "step_ms", "real_time", "recorded", "depth", "sinkage"),
    *("x", "y", "z", "qx", "qy", "qz", "qw", "fx", "fy", "fz"),
    *("force0", "force1", "force2", "torque0", "torque1", "torque2", "spread0", "spread1", "spread2"),
)
"""Numbers of a frame while driving, before its modes; forces and torques in the order of their names."""
SAMPLED = 8
"""Frames of a run that the scales of its colours are from."""
LEVELS = 65535
"""Between the ends of a range, of a number that is sent in 16 bits."""


class Kept(NamedTuple):
    """What is kept of a frame."""

    latent: np.ndarray
    pose: np.ndarray
    force: np.ndarray
    torque: np.ndarray
    spread: np.ndarray | None
    outside: float
    quantity: str

    @classmethod
    def of(cls, state: State, outside: float = 0.0, quantity: str = "") -> Kept:
        """A state, how far it is outside the training range, and in what."""
        parts = state.latent, state.pose, state.force, state.torque, state.force_spread
        return cls(*parts, outside, quantity)


class Drive:
    """A simulator with a tool that follows a person's controls.

    Args:
        surrogate: Network, basis and start.
        run: Whose tool and scene are taken; None: those of a training run, unless the tool is a mesh.
        device: "cpu" or "cuda".
        checkpoint: Its name, for errors and records.

    Attributes:
        controls: What the person asks for.
        kept: The newest frames, while recording all since then.
        recording: Whether.
        paused: Whether the clock stands.

    Raises:
        UserError: There is nothing to drive, or the run's bed is another one.
    """

    def __init__(
        self,
        surrogate: Surrogate,
        run: Run | None = None,
        device: str = "cpu",
        checkpoint: str | Path = "",
    ) -> None:
        self.simulator = Simulator(surrogate, device, spread=surrogate.dynamics.members > 1)
        self.known, self.checkpoint = self.simulator.training_range, checkpoint
        self.scene = driven_scene(self.simulator, run, checkpoint)
        self.rate = float(self.simulator.frame_rate)
        kind = WheelControls if self.simulator.predicts_body else ToolControls
        self.controls: WheelControls | ToolControls = kind(self.scene, self.known, self.rate)
        self.values: dict[str, Any] = self.scene.to_dict()
        # Runs without points have a network that needs none.
        own = self.scene.body_points()
        self.points = own if len(self.simulator.body_points) else own[:0]
        self.kept: list[Kept] = []
        self._before: list[Kept] = []  # what is kept, while a record is shorter than the history
        self.paused, self._mark = False, (0, 0.0)
        self.reset()

    # --- what the page shows ------------------------------------------------------------------------------

    def about(self) -> dict[str, Any]:
        """All that the page has to know before the first frame."""
        simulator, bed, fastest = self.simulator, self.scene.bed, self.controls.sliders["speed"]
        assert fastest.trained is not None
        return words(self.values) | {
            "mode": "drive",
            "title": f"{self.scene.kind}, network, {len(simulator.start_positions)} particles",
            "rate": self.rate,
            "bed": list(bed.size),
            "spacing": particle_spacing(simulator.start_positions),
            "modes": self._modes().shape[1],
            "fields": FIELDS,
            "sliders": [asdict(one) for one in self.controls.sliders.values()],
            "arrow": 0.2 * bed.size[0] / max(float(np.linalg.norm(simulator.mean_force)), 1e-9),
            "scales": {"speed": nice(max(fastest.trained[1], 0.01)), "displacement": nice(0.5 * bed.size[2])},
        }

    def arrays(self) -> list[np.ndarray]:
        """The soil's mean (n, 3) and modes (n, r + c), coordinates at rest (r + c, 3), and the tool's triangles
        (t, 3, 3) in the body frame."""
        first = self.controls.first
        points = in_world_frame(first[None], self.scene.body_points())
        body = SimpleNamespace(scene=self.values, pose=first[None], mesh=self.scene.mesh, body_points=points)
        mean, rest = self.simulator.basis.mean, self.simulator.basis.transform(self.simulator.start_positions)
        return [
            mean.numpy().astype("<f4"),
            self._modes().astype("<f2"),
            self._coordinates(rest.numpy()).astype("<f4"),
            drawn_corners(body, first).astype("<f4"),
        ]

    def frame(self) -> bytes:
        """The newest frame, float32: the numbers of `FIELDS`, then the coordinates (r + c, 3)."""
        new = self.kept[-1]
        wheel, body = self.simulator.predicts_body, self.scene.body
        assert body is not None
        tip = new.pose[:3] + rotate(new.pose[3:], body.tip)
        # Of a turned wheel forces are not along the axes that the spread is of.
        unknown = new.spread is None or self.values.get("slip_angle")
        numbers = [
            *(self.count, self.count / self.rate, new.outside, 1e3 * self.step_time, self.real_time),
            *(len(self.kept) if self.recording else 0, -tip[2]),
            float(sinkage(self.values, new.pose[None])[0]) if wheel else 0.0,
            *(*new.pose, *new.force),
            *(*named_forces(self.values, new.force)[1], *named_torques(self.values, new.torque)[1]),
            *([math.nan] * 3 if unknown else new.spread),  # type: ignore[misc]  # None is unknown
        ]
        coordinates = self._coordinates(new.latent).ravel()
        return np.concatenate([numbers, coordinates]).astype("<f4").tobytes()

    @property
    def outside(self) -> str:
        """What of the newest frame is outside the training range; empty where all is inside."""
        return "" if self.kept[-1].outside <= NOTEWORTHY else self.kept[-1].quantity

    def _modes(self) -> np.ndarray:
        basis = self.simulator.basis
        more = [] if basis.closure is None else [basis.closure.modes.numpy()]
        return np.concatenate([basis.modes.numpy(), *more], axis=1)

    def _coordinates(self, latent: np.ndarray) -> np.ndarray:
        """Along the modes that are stepped and those that follow from them [m], shape (r + c, 3)."""
        closure = self.simulator.basis.closure
        more = [] if closure is None else [closure.coordinates(torch.from_numpy(latent)).numpy()]
        return np.concatenate([latent, *more])

    # --- a step -------------------------------------------------------------------------------------------

    def reset(self) -> None:
        """The bed at rest, the tool where a run begins; what was recorded is dropped."""
        self.controls.reset()
        self.kept.clear()
        self._tell()
        self._before = []
        begin = self.simulator.reset(self.controls.pose(), values=self.values, body_points=self.points)
        self.kept.append(Kept.of(begin))
        self.recording, self.count = False, 0
        self.step_time = self.computed = self.real_time = 0.0
        self.pause(self.paused)

    def step(self) -> None:
        """Move the tool by one frame, and the soil with it.

        Raises:
            UserError: The answer is not finite; the soil stays as it was.
        """
        begun = time.perf_counter()
        self._tell()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of the range, which the page shows
            state = self.simulator.step(self.controls.moved())
        old = self.kept[-1]
        there, soil = (np.stack(pair) for pair in ((old.pose, state.pose), (old.latent, state.latent)))
        excess = self.known.excess(there, self.points, soil, self._context)
        assert excess is not None  # the tool is somewhere
        self.kept.append(Kept.of(state, float(excess.amount[-1]), excess.quantity[-1]))
        if not self.recording:
            del self.kept[: -self.simulator.history]
        self.count += 1
        took = time.perf_counter() - begun
        self.computed += took
        self.step_time += 0.1 * (took - self.step_time) if self.step_time else took
        frame, since = self._mark
        if begun - since > 0.5:
            self.real_time = (self.count - frame) / self.rate / (begun - since)
            self._mark = self.count, begun

    def pause(self, paused: bool) -> None:
        """Stop the clock, or let it go on."""
        self.paused, self._mark = paused, (self.count, time.perf_counter())

    def _tell(self) -> None:
        """Let the network know of the numbers that a person has changed since; the soil goes on from where it is."""
        told, keys = self.controls.told, self.simulator.context_keys
        changed = any(self.values[key] != value for key, value in told.items() if key in keys)
        self.values |= told
        self._context = dict(zip(keys, context_of(self.values, keys).tolist(), strict=True))
        if changed and self.kept:
            d = self.simulator.history
            before = [*self._before, *self.kept]
            before = [*[before[0]] * d, *before][-d:]
            latents, poses = (np.stack(parts) for parts in list(zip(*before, strict=True))[:2])
            self.simulator.reset(history=(latents, poses), values=self.values, body_points=self.points)

    # --- a record -----------------------------------------------------------------------------------------

    def record(self) -> None:
        """Begin to keep frames, from the newest on."""
        self._before = [*self._before, *self.kept[:-1]][-self.simulator.history :]
        self.kept, self.recording, self.computed = self.kept[-1:], True, 0.0

    def recorded(self, output: Path) -> list[Kept]:
        """End to record; the frames.

        Raises:
            UserError: There are too few, or they do not fit where `output` goes; then it goes on.
        """
        frames = self.kept[:]
        if len(frames) < 2:
            raise UserError("nothing was recorded yet: let the clock run first")
        require_space(output.absolute().parent, len(frames) * len(self.simulator.start_positions) * 24)
        self.recording, self._end = False, self.simulator.save()
        return frames

    def write(self, frames: Sequence[Kept], path: Path) -> str:
        """Write recorded frames as a run file; says what it is.

        Raises:
            UserError: It cannot be written.
        """
        latent, pose, force, torque, spread, amount, quantity = zip(*frames, strict=True)
        poses, excess = np.stack(pose), Excess(np.array(amount), list(quantity))
        # The first frame holds no force: a force is the mean since the frame before.
        forces, torques = (np.stack([np.zeros(3), *many[1:]]) for many in (force, torque))
        rollout = Rollout(
            np.stack(latent),
            forces,
            torques,
            poses,
            in_world_frame(poses, self.points),
            self.computed,
            self._end,
            self.simulator.basis,
            self.values,
            lambda: excess,
            None if spread[-1] is None else np.stack([np.zeros(3), *spread[1:]]),
        )
        scene = self.values | {"duration": (len(poses) - 1) / self.rate}
        if not self.simulator.predicts_body:  # a wheel has no path of its own
            assert self.scene.body is not None
            path_of = poses[:, :3] + rotate(poses[:, 3:], self.scene.body.path_point)
            rows = np.column_stack([np.arange(len(poses)) / self.rate, path_of, poses[:, 3:]])
            scene |= {"motion": "path", "path": rows.tolist()}
        write_rollout(path, self.simulator, scene, rollout, checkpoint=self.checkpoint, mesh=self.scene.mesh)
        return f"{path}: {len(poses)} frames, {scene['duration']:.3g} s"


def driven_scene(simulator: Simulator, run: Run | None, checkpoint: str | Path) -> Scene:
    """The scene whose tool is driven: that of the run, or of the training runs.

    Raises:
        UserError: It has no tool, or the tool is a mesh that nobody has given, or the network does not know it.
    """
    plain, where = (simulator.scene, checkpoint) if run is None else (run.scene, run.path)
    tool = plain.get("tool")
    if run is None and isinstance(tool, Mapping) and tool.get("shape") == "mesh":
        raise UserError(
            f"the tool of {checkpoint} is a mesh, which a checkpoint does not hold: give a run with it, as in "
            f"sgns view checkpoint={checkpoint} run=run.h5"
        )
    try:
        scene = Scene.from_dict(plain, *([] if run is None else run.meshes))
        if scene.body is None:
            raise UserError(f"the scene of {where} has no tool to drive")
        require_same_freedom(simulator, replace(scene, others=()), checkpoint)
        require_known_bed(simulator, scene, checkpoint)
    except SceneError as error:
        raise UserError(f"the scene of {where} cannot be driven: {error}") from error
    return scene


class Replay:
    """One run, or a true and a predicted one.

    Raises:
        UserError: They do not belong together.
    """

    def __init__(self, *runs: Run) -> None:
        self.runs, first = runs, runs[0]
        for other in runs[1:]:
            pairs = {
                "particles": (first.arrangement_hash, other.arrangement_hash),
                "frame rate": (first.frame_rate, other.frame_rate),
            }
            for what, (a, b) in pairs.items():
                if a != b:
                    raise UserError(
                        f"{first.path} and {other.path} differ in their {what} ({a}, {b}); give two runs of one bed"
                    )
        self.frame_count = min(run.frame_count for run in runs)
        sampled = np.linspace(0, self.frame_count - 1, SAMPLED).astype(int)
        self.sampled: list[int] = np.unique(sampled).tolist()
        for run in runs:
            require_finite(run, self.sampled)

    def about(self) -> dict[str, Any]:
        """All that the page has to know before the first frame."""
        first, start = self.runs[0], self.runs[0].positions(0)[0]
        low, high = start.min(axis=0), start.max(axis=0)
        forces = [np.linalg.norm(body.force, axis=-1).max() for run in self.runs for body in bodies(run)]
        return words(first.scene) | {
            "mode": "replay",
            "title": f"{first.scene.get('kind', 'scene')}, {first.particle_count} particles, {first.time[-1]:.3g} s",
            "runs": [run.path.name for run in self.runs],
            "who": [MADE_BY[run.producer][0] for run in self.runs],
            "turned": bool(np.abs(first.force[:, 1]).max() > 0.05 * float(np.max(forces))),
            "rate": first.frame_rate,
            "frames": self.frame_count,
            "particles": first.particle_count,
            "bed": [
                float(size) for size in (first.scene.get("bed") or {}).get("size") or [*high[:2], -low[2]]
            ],
            "spacing": particle_spacing(start),
            "bodies": [len(bodies(run)) for run in self.runs],
            "arrow": 0.2 * float(high[0] - low[0]) / max(float(np.max(forces)), 1e-9),
            "scales": self._scales(),
        }

    def arrays(self) -> list[np.ndarray]:
        """Of each run numbers of all frames, see `_numbers`; then of each of its bodies the poses (T, 7) and triangles
        (t, 3, 3) in the body frame."""
        found = []
        for run in self.runs:
            found.append(self._numbers(run))
            for body in bodies(run):
                found += [body.pose[: self.frame_count], drawn_corners(body, body.pose[0])]
        return [array.astype("<f4") for array in found]

    def frame(self, index: Any) -> bytes:
        """Soil at a frame: its number, then of each run two corners of a box [m] and the largest speed [m/s], float32;
        then of each run x, y, z and speed of the particles as shares of these, (n, 4) in 16 bits.

        Raises:
            UserError: There is no such frame, or it is not finite.
        """
        if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < self.frame_count:
            raise UserError(f"frame is {index!r:.40}; allowed: 0 to {self.frame_count - 1}")
        scales, parts = [np.array([index], "<f4")], []
        for run in self.runs:
            place, speed = run.positions(index)[0], np.linalg.norm(run.velocities(index)[0], axis=1)
            values = np.column_stack([place, speed])
            low, high = np.append(place.min(axis=0), 0.0), values.max(axis=0)
            if not np.isfinite(values).all():
                raise UserError(
                    f"{run.path}: frame {index} is not finite; `sgns check {run.path}` lists everything"
                )
            wide = np.maximum(high - low, 1e-9)
            scales.append(np.concatenate([low[:3], low[:3] + wide[:3], wide[3:]]).astype("<f4"))
            parts.append(np.rint(LEVELS * (values - low) / wide).astype("<u2"))
        return b"".join(part.tobytes() for part in (*scales, *parts))

    def _numbers(self, run: Run) -> np.ndarray:
        """Of every frame: time, force (3), named force (3), named torque (3), spread (3), sinkage, shape (T, 14)."""
        t, wheel = slice(self.frame_count), is_wheel(run.scene)
        unknown = run.force_spread is None or run.scene.get("slip_angle")
        spread = np.full((run.frame_count, 3), math.nan) if unknown else run.force_spread
        assert spread is not None
        depth = sinkage(run.scene, run.pose) if wheel else np.zeros(run.frame_count)
        named = named_forces(run.scene, run.force)[1], named_torques(run.scene, run.torque)[1]
        return np.column_stack([run.time, run.force, *named, spread, depth])[t]

    def _scales(self) -> dict[str, float]:
        """Ends of the colours' scales: speed [m/s], way from the start [m], and of two runs their distance [m]."""
        start = self.runs[0].positions(0)[0]
        found: dict[str, float] = {"speed": LEAST_SPEED, "displacement": 1e-3}
        for index in self.sampled:
            places = [run.positions(index)[0] for run in self.runs]
            sizes = {"speed": self.runs[0].velocities(index)[0], "displacement": places[0] - start}
            if len(places) > 1:
                sizes["error"] = places[1] - places[0]
            for name, vectors in sizes.items():
                size = float(np.percentile(np.linalg.norm(vectors, axis=1), 99.5))
                found[name] = max(found.get(name, 1e-4), size)
        return {name: nice(size) for name, size in found.items()}


# --- Of both ----------------------------------------------------------------------------------------------


def words(scene: Mapping[str, Any]) -> dict[str, Any]:
    """Names of forces and torques, and whether the tool is a wheel."""
    forces, torques = named_forces(scene, np.zeros(3))[0], named_torques(scene, np.zeros(3))[0]
    one_line = [[name.replace("\n", " ") for name in names] for names in (forces, torques)]
    return {"forces": one_line[0], "torques": one_line[1], "wheel": is_wheel(scene)}


def drawn_corners(body: Any, pose: np.ndarray) -> np.ndarray:
    """Corners of a body's triangles [m], shape (3 t, 3), body frame, all in the same sense seen from outside; `body` as
    for `body_triangles`, which is at this pose in its first frame."""
    triangles = body_triangles(body, 0)
    if len(triangles) and not is_mesh(body):  # those of a mesh are in order
        normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        inward = ((triangles.mean(axis=1) - triangles.mean(axis=(0, 1))) * normal).sum(axis=1) < 0.0
        triangles[inward] = triangles[inward, ::-1]
    return in_body_frame(pose, triangles.reshape(-1, 3)) if len(triangles) else np.empty((0, 3))
