"""`sgns rollout`: a trained network along a tool path, written as a run file like the solver's."""

from __future__ import annotations

import json
import logging
import shlex
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch

from sgns.config import UserError, differences
from sgns.data.dataset import IMPORTED
from sgns.data.files import only_here
from sgns.data.run import frame_chunks
from sgns.data.writer import RunWriter, require_new_run
from sgns.model.checkpoint import read_checkpoint
from sgns.numbers import elapsed

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from mpm_warp import Scene
    from sgns.simulator import Simulator
    from sgns.state import Rollout


log = logging.getLogger(__name__)


class RolloutTiming(NamedTuple):
    """Time simulated [s], and wall seconds per simulated second."""

    simulated: float
    inference_rate: float  # of steps with force and torque, no particles decoded
    complete_rate: float  # of steps, and of decoding every frame and writing the run file


@contextmanager
def single_thread() -> Iterator[None]:
    """torch on one thread, as before afterwards: a step is too short for more than one."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def write_rollout(
    path: str | Path,
    simulator: Simulator,
    scene: dict[str, Any],
    rollout: Rollout,
    *,
    effects: dict[str, dict[str, Any]] | None = None,
    seed: int = 0,
    checkpoint: str | Path = "",
    given_frames: int = 1,
    mesh: tuple[np.ndarray, np.ndarray] | None = None,
) -> Path:
    """Decodes a rollout and writes it as a run file (producer `rollout`), complete or not at all; returns its path.

    Velocities are backward differences of the positions times the frame rate, zero at frame 0 (at rest).

    Args:
        path: run file to write.
        simulator: the one that made the rollout.
        scene: the scene as plain data.
        rollout: of T frames.
        effects: resolved effects to record; none by default, a network has no such choice.
        seed: recorded seed.
        checkpoint: file that the simulator was loaded from; recorded with its settings.
        given_frames: how many frames at the start are no predictions; recorded as `history`.
        mesh: of the scene's tool, if it is one.

    Raises:
        UserError: the rollout is not finite, when the frames before that are in `<name>.stopped.h5` instead; or the
            file cannot be written.
    """
    path, whole = Path(path), finite_frames(rollout)
    reason = ""
    if whole < len(rollout.latent):
        reason = (
            f"the rollout for {path.name} is not finite from frame {whole} on: the network is not stable on this "
            "path; train longer, or use a better checkpoint"
        )
        if whole == 0:
            raise UserError(reason)
    began = time.perf_counter()
    rate = float(simulator.frame_rate)
    latent = torch.as_tensor(rollout.latent[:whole])
    particle_count, excess = len(simulator.start_positions), rollout.excess
    with RunWriter(
        path,
        scene=scene,
        effects=effects or {},
        arrangement_hash=simulator.arrangement_hash,
        particle_count=particle_count,
        body_points=rollout.body_points.shape[1],
        frame_rate=rate,
        seed=seed,
        producer="rollout",
        extra={
            "checkpoint": str(checkpoint),
            "checkpoint_version": simulator.card.get("package_version"),
            "checkpoint_settings": simulator.card.get("settings", {}),
            "history": given_frames,
            "outside_training": None if excess is None else excess.largest,
            "outside_training_words": None if excess is None else excess.words(),
        },
        meshes=(mesh,),
        spread=rollout.force_spread is not None,
    ) as writer:
        previous = None
        for frames in frame_chunks(particle_count, len(latent)):
            for frame, position in enumerate(simulator.basis.inverse(latent[frames]).numpy(), frames.start):
                writer.append(
                    frame / rate,
                    position,
                    np.zeros_like(position) if previous is None else (position - previous) * rate,
                    rollout.body_points[frame],
                    rollout.poses[frame],
                    rollout.force[frame],
                    rollout.torque[frame],
                    () if rollout.force_spread is None else (rollout.force_spread[frame],),
                )
                previous = position
        wall_time = float(rollout.wall_time_s) + elapsed(began, time.perf_counter())
        if reason:
            raise UserError(f"{reason}; the frames before are in {writer.stop(wall_time, reason)}")
        writer.finish(wall_time)
    return path


def finite_frames(rollout: Rollout) -> int:
    """Frames before the first in which a rollout is not finite."""
    parts = rollout.latent.reshape(len(rollout.latent), -1), rollout.force, rollout.torque, rollout.poses
    finite = np.isfinite(np.hstack(parts)).all(axis=1)
    return len(finite) if finite.all() else int(np.argmin(finite))


def require_known_bed(simulator: Simulator, scene: Scene, checkpoint: str | Path) -> None:
    """Refuses a scene whose particles are not the ones the checkpoint's basis was fitted on."""
    if scene.arrangement_hash != simulator.arrangement_hash:
        if len(scene.displaced):
            raise UserError(
                f"the tool is in the soil at the start, where {len(scene.displaced)} particles are left out; "
                f"{checkpoint} knows other particles: let the path begin above the soil"
            )
        raise UserError(
            f"this scene's bed is not the one that {checkpoint} knows: "
            f"{bed_differences(simulator.scene, scene.to_dict())}; set the scene's bed to the "
            "checkpoint's, or train on a dataset of this bed"
        )
    asked, known = float(scene.frame_rate), float(simulator.frame_rate)
    if abs(asked - known) > 1e-6 * known:
        raise UserError(
            f"scene.frame_rate is {asked:g} Hz, {checkpoint} steps at {known:g} Hz; set "
            f"scene.frame_rate={known:g}"
        )


def require_same_freedom(simulator: Simulator, scene: Scene, checkpoint: str | Path) -> None:
    """Refuses a wheel for a network of prescribed bodies, the other way round, and further bodies."""
    if scene.others:
        raise UserError(
            f"scene.others has {len(scene.others)} further bodies, and {checkpoint} knows one body: leave them out"
        )
    if (scene.axle is not None) == simulator.predicts_body:
        return
    learned, asked = (
        ("wheels", "is prescribed") if simulator.predicts_body else ("prescribed bodies", "is free")
    )
    raise UserError(
        f"scene.kind is {scene.kind}, whose height {asked}; {checkpoint} was trained on {learned}: use a checkpoint "
        "that was trained on such scenes"
    )


def bed_differences(known: Mapping[str, Any], asked: Mapping[str, Any]) -> str:
    """Names the values of two scenes' beds that differ, the checkpoint's first."""
    found = differences(known.get("bed", {}), asked.get("bed", {}))
    named = [f"{key} {a} (here {b})" for key, (a, b) in found.items()]
    if not named:
        return "the particles' arrangement differs"
    more = f" and {len(named) - 4} more" if len(named) > 4 else ""
    return "it knows " + ", ".join(named[:4]) + more


def scene_groups(checkpoint: str | Path) -> dict[str, dict[str, Any]]:
    """Groups of settings, `scene` and `material`, of the scene that a checkpoint was trained on.

    What a person has to give is missing (???): the path of a body, and the mesh file of a tool, since no file may name
    another one to be read. For the same reason there are no further bodies, which no network knows, and no heights from
    a file.

    Raises:
        UserError: The checkpoint cannot be read.
    """
    scene = read_checkpoint(checkpoint)["hyper_parameters"].get("scene")
    if isinstance(scene, dict) and scene.get("kind") == IMPORTED:
        raise UserError(
            f"{checkpoint} was trained on imported runs, which no scene describes; give their poses in Python: "
            "Simulator.load(...).rollout(poses)"
        )
    if not isinstance(scene, dict) or not isinstance(scene.get("material"), dict):
        raise UserError(f"{checkpoint} does not say what its scene is; train again")
    if "${" in json.dumps(scene):
        raise UserError(f"{checkpoint} has a scene with values that stand for others; give scene=...")
    tool = scene.get("tool")
    if isinstance(tool, dict) and tool.get("shape") == "mesh":
        scene = scene | {"tool": tool | {"file": "???", "digest": ""}}
    if scene.get("path") is not None:
        scene = scene | {"path": "???"}
    if scene.get("others"):
        scene = scene | {"others": []}
    if isinstance(bed := scene.get("bed"), dict) and isinstance(bed.get("surface"), str):
        scene = scene | {"bed": bed | {"surface": "???"}}
    return {"material": scene["material"], "scene": {k: v for k, v in scene.items() if k != "material"}}


# What changes soil and force beside the path: named when it differs and the network is not told.
_FIXED = "blade tool material gravity friction load diameter width friction_angle grousers damping".split()
# Where a tool's mesh was read from; `digest` says which mesh it is.
_ORIGIN_OF_MESH = {"tool.file", "tool.scale", "tool.unit", "tool.centre"}
# What follows from a number that a network may be told.
_FOLLOWING = {"friction_angle": ("static_friction", "limit_friction")}


def unlearned(known: Mapping[str, Any], asked: Mapping[str, Any], told: Sequence[str] = ()) -> list[str]:
    """What a scene asked for changes in the known one, a training run's, that neither the path nor the keys that the
    network is told can tell it: `key value (trained with value)` for every such key of `_FIXED`."""
    covered = {name for key in told for name in (key.split(".")[-1], *_FOLLOWING.get(key, ()))}
    changed = differences(known, asked)
    # Another unit with another scale may be the same size.
    same_size = _ORIGIN_OF_MESH - ({"tool.scale"} if "tool.unit" not in changed else set())
    return [
        "another mesh than in training" if key == "tool.digest" else f"{key} {b} (trained with {a})"
        for key, (a, b) in changed.items()
        if key.split(".")[0] in _FIXED
        and key not in same_size
        and key.split(".")[-1] not in covered
        and None not in (a, b)
    ]


def rollout_scene(
    simulator: Simulator, scene: Scene, path: str | Path, *, seed: int = 0, checkpoint: str | Path = ""
) -> RolloutTiming:
    """Rolls a scene out from the common start at rest into a run file; warns where path or soil leave what the training
    runs covered."""
    with single_thread(), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of the range, which is told below
        rollout = simulator.rollout(scene.body_poses(), scene.body_points(), values=scene.to_dict())
    if rollout.excess is not None and (words := rollout.excess.words()):
        log.warning("%s: forces and soil are a guess there", words)
    began = time.perf_counter()
    write_rollout(
        path, simulator, scene.to_dict(), rollout, seed=seed, checkpoint=checkpoint, mesh=scene.mesh
    )
    writing = elapsed(began, time.perf_counter())
    simulated, stepping = (len(rollout.latent) - 1) / simulator.frame_rate, rollout.wall_time_s
    return RolloutTiming(simulated, stepping / simulated, (stepping + writing) / simulated)


def main(cfg: DictConfig) -> float:
    """The `sgns rollout` command; returns wall seconds per simulated second (steps with force)."""
    from mpm_warp import Preview
    from sgns.simulate.campaign import require_space, run_cost
    from sgns.simulate.scene import require_meant, scene_from_config
    from sgns.simulator import Simulator

    output = Path(cfg.output)
    # First: without a checkpoint the scene is not the one that the settings were written for.
    simulator = Simulator.load(
        cfg.checkpoint, cfg.device, cfg.num_modes, rate_independent=cfg.rate_independent, spread=cfg.spread
    )
    scene = scene_from_config(cfg)
    require_same_freedom(simulator, scene, cfg.checkpoint)
    require_known_bed(simulator, scene, cfg.checkpoint)
    preview = Preview.of(scene)
    require_meant(preview, "sgns.Simulator.rollout takes it in Python")
    for warning in preview.warnings:
        if warning not in scene.warnings():  # those are of the solver
            log.warning("%s", warning)
    ignored = unlearned(simulator.scene, scene.to_dict(), simulator.context_keys)
    require_new_run(output, cfg.overwrite)
    if ignored:
        log.warning("the network follows the tool's path only; it does not know of %s", ", ".join(ignored))
    with only_here(output):
        require_space(output.parent, run_cost(scene).size)
        timing = rollout_scene(simulator, scene, output, seed=cfg.seed, checkpoint=cfg.checkpoint)
    log.info("rolled out %d frames (%.3g s) into %s", scene.frame_count, timing.simulated, output)
    rates = timing.inference_rate, timing.complete_rate
    log.info("computing time of one simulated second: %.3g s; %.3g s with all particles written", *rates)
    log.info("to look at it: sgns plot %s", shlex.quote(str(output)))
    return timing.inference_rate
