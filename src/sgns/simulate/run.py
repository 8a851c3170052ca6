"""A scene simulated into a run file, from its start or from where its solver stopped."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from mpm_warp import Effects, Scene, SceneError, Soil, Solver, SolverStopped, State
from mpm_warp.launch import Job, run_concurrently
from sgns.config import Interrupted, UserError, differences, heed, held_back
from sgns.data.run import Run
from sgns.data.writer import RunWriter, stopped_path
from sgns.numbers import elapsed
from sgns.simulate.scene import replaced, soil_of

# --- Going on with a run whose solver stopped -----------------------------------------------------------

CHANGES = (
    "courant",
    "remap_time",
    "remap_distance",
    "velocity_memory",
    "elastic_damping",
    "volume_averaging",
    "bed.headroom",
)
"""Keys of the scene that may change half-way: how it is computed, not what it is."""
_FILE = "scene.tool.file"
_LATER = ("cohesion",)
"""Effects that earlier run files do not name: their soil had none."""
_OTHERS = (
    "continue_from",
    "start_from",
    "output",
    "device",
    "solver.precision",
    "solver.threads",
    "limits.time",
    "limits.disk",
    "hydra",
)


@dataclass(frozen=True)
class Restart:
    """A stopped run and what it goes on with."""

    path: Path
    scene: Scene
    """What was asked for at first; the run file says this."""
    changes: dict[str, Any]
    """Keys of `CHANGES` with new values, those of earlier restarts included."""
    effects: Effects
    reasons: dict[str, dict[str, Any]]
    """Of the effects, as in the file."""
    precision: str
    seed: int
    state: State
    wall_time: float
    """What its frames took [s]."""
    earlier: list[dict[str, Any]]
    """What the file says of earlier restarts."""
    start_from: dict[str, Any]
    """What it says of the soil that it started from; empty: the scene's own."""

    @property
    def changed_scene(self) -> Scene:
        """What is computed from here on."""
        found = Scene.from_dict(replaced(self.scene.to_dict(), self.changes), *self.scene.meshes)
        return found if self.scene.soil is None else found.starting_from(self.scene.soil)

    def on(self, soil: Soil | None) -> Restart:
        """The same with the soil that the run started from.

        Raises:
            UserError: that was another one.
        """
        if self.start_from and soil is None:
            raise UserError(
                f"{self.path} started from the soil of {self.start_from.get('run')}; give that, too: start_from=..."
            )
        if (soil.digest if soil is not None else None) != self.start_from.get("soil"):
            raise UserError(
                f"{self.path} did not start from the soil of start_from; leave it out, or give that run's"
            )
        return self if soil is None else replace(self, scene=self.scene.starting_from(soil))

    @property
    def record(self) -> list[dict[str, Any]]:
        """For the run file: at which frames the solver went on, and with what changed."""
        return [*self.earlier, {"frame": self.state.frame, "changed": dict(self.changes)}]

    def frames(self) -> Iterator[tuple[Any, ...]]:
        """The frames that are there, as `RunWriter.append` takes them."""
        with Run(self.path) as run:
            small = (run.body_points, run.pose, run.force, run.torque)
            others = (run.other_pose, run.other_force, run.other_torque) if self.scene.others else ()
            for index, time in enumerate(run.time):
                soil = run.positions(index)[0], run.velocities(index)[0]
                further = tuple(series[index] for series in others)
                yield time, *soil, *(series[index] for series in small), further


def restart_from(cfg: DictConfig, overrides: Sequence[str]) -> Restart:
    """What `cfg.continue_from` holds, with the changes among the command's `overrides`.

    Raises:
        UserError: the file is no stopped run, or something else is to be changed than how it is computed.
    """
    path = Path(str(cfg.continue_from))
    asked = _changes(cfg, overrides)
    restart = _read_stopped(path).on(soil_of(str(cfg.start_from)) if cfg.get("start_from") else None)
    if any(o.lstrip("+").startswith(f"{_FILE}=") for o in overrides):
        raise UserError(f"{path} brings its own tool; leave out {_FILE}")
    changes = restart.changes | asked
    if restart.effects.nonlocality and "bed.headroom" in changes:
        raise UserError(
            "with effects.nonlocality the grid keeps what flows, so scene.bed.headroom cannot change half-way; "
            "simulate the scene anew"
        )
    new_precision = any(o.startswith("solver.precision=") for o in overrides)
    precision = cfg.solver.precision if new_precision else restart.precision
    return replace(restart, changes=changes, precision=precision)


def unfinished(output: Path, scene: Scene, effects: Effects, seed: int, precision: str) -> Restart | None:
    """What an interrupted attempt at the same run left beside `output`, to go on from; None if there is nothing.

    Raises:
        UserError: it is of other settings, named by key, or damaged.
    """
    path = stopped_path(output)
    if not path.exists():
        return None
    anew = "overwrite=true begins anew, or choose another output"
    try:
        there = _read_stopped(path)
    except UserError as error:
        raise UserError(f"{error}; {anew}") from error
    asked = _as_keys(scene, effects, seed, precision) | {"start_from": _origin(scene).get("soil")}
    found = _as_keys(there.changed_scene, there.effects, there.seed, there.precision)
    found |= {"start_from": there.start_from.get("soil")}
    if different := differences(found, asked):
        named = [
            f"{key} is {_shown(old)} there and {_shown(new)} here" for key, (old, new) in different.items()
        ]
        more = f" and {len(named) - 3} more" if len(named) > 3 else ""
        raise UserError(
            f"{path} is an unfinished run of other settings: {', '.join(named[:3])}{more}; {anew}"
        )
    return there.on(scene.soil)


def _origin(scene: Scene) -> dict[str, Any]:
    """What a run file says of the soil that a scene starts from."""
    return {} if scene.soil is None else {"run": scene.soil.source, "soil": scene.soil.digest}


def _as_keys(scene: Scene, effects: Effects, seed: int, precision: str) -> dict[str, Any]:
    """As on the command line."""
    data = scene.to_dict()
    groups = {
        "material": data.pop("material"),
        "effects": asdict(effects),
        "solver": {"precision": precision},
    }
    return {"scene": data, **groups, "seed": seed}


def _shown(value: Any) -> str:
    """A value in a line about many."""
    text = repr(value)
    return text if len(text) < 60 else f"{text[:50]}..."


def _read_stopped(path: Path) -> Restart:
    """A stopped run as it is."""
    with Run(path) as run:
        if run.stopped is None:
            raise UserError(f"continue_from: {path} is a whole run; there is nothing to go on with")
        state = run.state
        try:
            scene = Scene.from_dict(run.scene, *run.meshes)
        except SceneError as error:
            raise UserError(f"{path}: {error}; repeat the run") from error
    if state.frame != run.frame_count - 1:
        raise UserError(
            f"{path} holds {run.frame_count} frames but the state of frame {state.frame}; repeat the run"
        )
    reasons, extra = run.effects, run.extra
    earlier = _earlier(extra, path)
    return Restart(
        path=path,
        scene=scene,
        changes={key: value for one in earlier for key, value in one["changed"].items()},
        effects=_effects(reasons, path),
        reasons=reasons,
        precision=str(extra.get("precision", "float32")),
        seed=run.seed,
        state=state,
        wall_time=run.wall_time_s,
        earlier=earlier,
        start_from=extra["start_from"] if isinstance(extra.get("start_from"), dict) else {},
    )


def _effects(reasons: Mapping[str, Any], path: Path) -> Effects:
    try:  # some of what is recorded follows from the scene and is no choice
        names = [one.name for one in fields(Effects) if one.name in reasons or one.name not in _LATER]
        return Effects(**{name: bool(reasons[name]["on"]) for name in names})
    except (TypeError, KeyError) as error:
        raise UserError(f"{path}: its effects are damaged ({error}); repeat the run") from None


def _earlier(extra: Mapping[str, Any], path: Path) -> list[dict[str, Any]]:
    found = extra.get("continued", [])
    try:
        known = all(set(one["changed"]) <= set(CHANGES) for one in found)
    except (TypeError, KeyError):
        known = False
    if not known:
        raise UserError(f"{path}: what it says of earlier continuations is damaged; repeat the run")
    return found


def _changes(cfg: DictConfig, overrides: Sequence[str]) -> dict[str, Any]:
    changes = {}
    for override in overrides:
        key = override.split("=")[0].lstrip("+~")
        if re.split(r"[@./]", key)[0] == "hydra" or key in (*_OTHERS, _FILE):
            continue
        if key.removeprefix("scene.") not in CHANGES or not key.startswith("scene."):
            raise UserError(
                f"continue_from brings its own scene, soil and effects; leave out {key}; allowed besides output, "
                f"device and solver.precision: {', '.join(f'scene.{name}' for name in CHANGES)}"
            )
        changes[key.removeprefix("scene.")] = OmegaConf.select(cfg, key)
    return changes


# --- A scene simulated into a run file ------------------------------------------------------------------


@dataclass(frozen=True)
class Timing:
    """What a run cost; compilation and set-up are not in it, recording the frames is."""

    wall_time: float
    """[s]; of scenes that are computed side by side, each has its share; the shares add up to the time that passed."""
    simulated: float
    """[s]"""
    particle_steps: int

    @property
    def per_simulated_second(self) -> float:
        """Wall seconds per simulated second."""
        return self.wall_time / self.simulated

    @property
    def rate(self) -> float:
        """Particle-steps per second."""
        return self.particle_steps / self.wall_time


def simulate_scene(scene: Scene, output: Path, **settings: Any) -> Timing:
    """Compute a scene and write its run file; arguments as in `scene_stages`."""
    ((_, timing),) = run_concurrently(
        [scene_stages(scene, output, **settings)], 1, settings.get("device", "cpu")
    )
    return timing


def scene_stages(
    scene: Scene,
    output: Path,
    *,
    effects: Effects,
    reasons: Mapping[str, Mapping[str, Any]] | None = None,
    seed: int = 0,
    device: str = "cpu",
    precision: str = "float32",
    threads: int = 1,
    progress: Callable[[], object] = lambda: None,
    restart: Restart | None = None,
) -> Generator[Timing | Job, None, None]:
    """Compute a scene and write its run file, with the particles that `scene.bed.store_every` leaves in it.

    Args:
        reasons: effect → on, reason, number, for the run file; by default what `effects` says of itself.
        progress: called once after every frame.
        restart: a stopped run of this scene; its frames are copied and the solver begins after them.

    Yields:
        All work that the device has to do (mpm_warp.launch.Job), and at the end what it cost.

    Raises:
        SolverStopped: the line says where the frames before it are kept and how to go on.
        Interrupted: a signal was heeded (`sgns.config`), or the generator is closed early; the line says where the
            frames are kept.
    """
    computed, state, before = scene, None, 0.0
    if restart is not None:
        computed, state, before = restart.changed_scene, restart.state, restart.wall_time
    solver = Solver(computed, effects, device, precision, threads, state)
    stored = scene.stored
    made_with = {
        "device": device,
        "precision": precision,
        "threads": threads,
        "time_step_s": solver.time_step,
        "substeps_per_frame": solver.substeps_per_frame,
        "particles_simulated": solver.particle_count,
    }
    with (
        RunWriter(
            output,
            scene=scene.to_dict(),
            effects=reasons or effects.described(),
            arrangement_hash=scene.arrangement_hash,
            particle_count=len(stored),
            body_points=len(scene.body_points()),
            frame_rate=scene.frame_rate,
            seed=seed,
            producer="mpm",
            extra=made_with
            | ({"continued": restart.record} if restart is not None else {})
            | ({"start_from": _origin(scene)} if scene.soil is not None else {}),
            meshes=scene.meshes,
        ) as writer,
        ExitStack() as to_the_end,
    ):
        for frame in restart.frames() if restart is not None else ():
            writer.append(*frame)
            progress()
        there = writer.frame_count
        # Loading kernels is not part of the cost of a run: the clock starts with the first frame, or with the first
        # work where the first frames are there already.
        clock, holding = _Clock(before), False
        try:
            for stage in solver.stages():
                if isinstance(stage, Job):
                    if stage.steps and not holding:
                        to_the_end.enter_context(held_back())  # from here on there are frames to keep
                        holding = True
                    heed()
                    if there and stage.steps:
                        clock.start()
                    yield stage
                    clock.read(stage.shared_by)
                    continue
                clock.start()
                soil = stage.position[stored], stage.velocity[stored]
                body = stage.body_points, stage.body_pose, stage.force, stage.torque
                others = stage.other_poses, stage.other_forces, stage.other_torques
                writer.append(stage.time, *soil, *body, others if scene.others else ())
                progress()
        except (Interrupted, GeneratorExit) as ending:  # both where a frame is whole
            if writer.frame_count <= max(there, 1):
                raise
            cause = ending.cause if isinstance(ending, Interrupted) else "its process ended"
            kept = writer.stop(clock.seconds, cause, solver.state())
            if isinstance(ending, GeneratorExit):
                raise
            words = f"{writer.frame_count} of {scene.frame_count} frames are kept in {kept}"
            raise Interrupted(ending.number, words) from None
        except SolverStopped as stopped:
            if stopped.state is None or stopped.state.frame != writer.frame_count - 1:
                raise
            kept = writer.stop(clock.seconds, str(stopped), stopped.state)
            raise SolverStopped(f"{stopped}. {_way_on(str(stopped), kept, output, computed)}") from stopped
        clock.read(clock.shared_by)
        writer.finish(clock.seconds, solver.state())
    frames = scene.frame_count - max(1, there)
    steps = frames * solver.substeps_per_frame * solver.computed_count
    yield Timing(elapsed(before, clock.seconds), frames / scene.frame_rate, steps)


class _Clock:
    """The time that a run takes; of the time in which others are computed with it, its share."""

    def __init__(self, seconds: float) -> None:
        self.seconds, self.shared_by = seconds, 1
        self._seen: float | None = None

    def start(self) -> None:
        if self._seen is None:
            self._seen = time.perf_counter()

    def read(self, shared_by: int) -> None:
        self.shared_by = shared_by
        if self._seen is not None:
            now = time.perf_counter()
            self.seconds, self._seen = self.seconds + elapsed(self._seen, now) / shared_by, now


def _way_on(cause: str, kept: Path, output: Path, computed: Scene) -> str:
    """Where the frames are, and how to go on if a restart can do what the cause asks for."""
    soil = f" start_from={computed.soil.source}" if computed.soil is not None else ""
    command = f"They are kept: sgns simulate continue_from={kept}{soil} output={output}"
    if "scene.courant" in cause:
        return f"{command} scene.courant={0.5 * computed.courant:g} goes on from there with half the step"
    if "scene.bed.headroom" in cause:
        return f"{command} scene.bed.headroom={2.0 * computed.bed.headroom:g} goes on from there"
    return f"They are kept in {kept}"
