"""`sgns rollout`: a trained network along a tool path, written as a run file like the solver's."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from sgns.errors import UserError
from sgns.runs import RunWriter

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["RolloutTiming", "main", "require_known_bed", "rollout_scene", "write_rollout"]

log = logging.getLogger(__name__)

# Decoded positions held at one time [bytes, float64].
CHUNK_BYTES = 32e6


@dataclass(frozen=True)
class RolloutTiming:
    """Wall time of a rollout.

    Attributes:
        simulated: time simulated [s].
        stepping: wall time of the network's steps with force and torque [s].
        writing: wall time of decoding every frame and writing the run file [s].
    """

    simulated: float
    stepping: float
    writing: float

    @property
    def stepping_rate(self) -> float:
        """Wall seconds per simulated second: steps with force, no particles decoded."""
        return self.stepping / self.simulated

    @property
    def complete_rate(self) -> float:
        """Wall seconds per simulated second: steps, decoding and writing every frame."""
        return (self.stepping + self.writing) / self.simulated


def write_rollout(
    path: str | Path,
    simulator: Any,
    scene: Any,
    rollout: Any,
    *,
    effects: Mapping[str, Mapping[str, Any]] | None = None,
    seed: int = 0,
    start: np.ndarray | None = None,
    extra: dict[str, Any] | None = None,
) -> Path:
    """Decodes a rollout and writes it as a run file (producer `rollout`).

    Velocities are backward differences of the positions times the frame rate, zero at frame 0 (at rest).

    Args:
        path: run file to write; complete or absent, never half-written.
        simulator: the `Simulator` that made the rollout.
        scene: an `mpm_warp.Scene` or the dict of one.
        rollout: `Rollout` of T frames.
        effects: resolved effects to record; none by default, a network has no such choice.
        seed: recorded seed.
        start: true positions of frame 0 [m], shape (n, 3), written in place of its reconstruction.
        extra: further attributes of the run file.

    Returns:
        The path written.
    """
    path = Path(path)
    require_finite(path, rollout)
    began = time.perf_counter()
    n = len(simulator.start_positions)
    latent = torch.as_tensor(rollout.latent)
    frames = len(latent)
    rate = float(simulator.frame_rate)
    chunk = max(1, int(CHUNK_BYTES / (24.0 * n)))
    writer = RunWriter(
        path,
        scene=dict(scene) if isinstance(scene, Mapping) else scene.to_dict(),
        effects={name: dict(effect) for name, effect in (effects or {}).items()},
        arrangement_hash=simulator.arrangement_hash,
        particle_count=n,
        body_points=rollout.body_points.shape[1],
        frame_rate=rate,
        seed=seed,
        producer="rollout",
        extra=extra,
    )
    poses, points, force, torque = (
        np.asarray(value) for value in (rollout.poses, rollout.body_points, rollout.force, rollout.torque)
    )
    with writer:
        previous = None
        for first in range(0, frames, chunk):
            decoded = simulator.basis.inverse(latent[first : first + chunk]).numpy()
            for offset, position in enumerate(decoded):
                frame = first + offset
                if frame == 0 and start is not None:
                    position = np.asarray(start, dtype=np.float64)
                velocity = np.zeros_like(position) if previous is None else (position - previous) * rate
                previous = position
                writer.append(
                    frame / rate, position, velocity, points[frame], poses[frame], force[frame], torque[frame]
                )
        writer.finish(float(rollout.wall_time_s) + time.perf_counter() - began)
    return path


def require_finite(path: Path, rollout: Any) -> None:
    """Refuses a rollout whose network ran away from the numbers it knows."""
    latent = np.asarray(rollout.latent, dtype=np.float64).reshape(len(rollout.latent), -1)
    finite = np.isfinite(np.hstack([latent, np.asarray(rollout.force), np.asarray(rollout.torque)])).all(
        axis=1
    )
    if not finite.all():
        raise UserError(
            f"the rollout for {path.name} is not finite from frame {int(np.argmin(finite))} on: the "
            "network is not stable on this path; train longer, or use a checkpoint with a higher "
            "validation skill"
        )


def require_known_bed(simulator: Any, scene: Any, checkpoint: str | Path) -> None:
    """Refuses a scene whose particles are not the ones the checkpoint's basis was fitted on."""
    if scene.arrangement_hash != simulator.arrangement_hash:
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


def bed_differences(known: Mapping[str, Any], asked: Mapping[str, Any]) -> str:
    """Names the values of two scenes' beds that differ, the checkpoint's first."""
    a, b = flat(known.get("bed", known)), flat(asked.get("bed", asked))
    named = [
        f"{key} {a.get(key, 'absent')} (here {b.get(key, 'absent')})"
        for key in a | b
        if a.get(key) != b.get(key)
    ]
    if not named:
        return "the particles' arrangement differs"
    more = f" and {len(named) - 4} more" if len(named) > 4 else ""
    return "it knows " + ", ".join(named[:4]) + more


def unlearned(known: Mapping[str, Any], asked: Mapping[str, Any]) -> list[str]:
    """What a scene changes that the training runs' scene fixes and no tool path can tell the network.

    Returns:
        `key value (trained with value)` for every such key of blade, material and gravity.
    """
    a, b = flat(known), flat(asked)
    fixed = [key for key in b if key.split(".")[0] in ("blade", "material", "gravity") and key in a]
    return [f"{key} {b[key]} (trained with {a[key]})" for key in fixed if a[key] != b[key]]


def flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """A nested dict as one level, keys joined by dots."""
    out: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping):
            out |= flat(value, f"{prefix}{key}.")
        else:
            out[f"{prefix}{key}"] = value
    return out


def rollout_scene(simulator: Any, scene: Any, path: str | Path, *, seed: int = 0) -> RolloutTiming:
    """Rolls a scene that was never simulated out, from the common start at rest, into a run file."""
    rollout = simulator.rollout(scene.body_poses(), scene.body_points())
    began = time.perf_counter()
    write_rollout(path, simulator, scene, rollout, seed=seed)
    writing = time.perf_counter() - began
    steps = len(rollout.latent) - 1
    return RolloutTiming(steps / float(simulator.frame_rate), float(rollout.wall_time_s), writing)


def main(cfg: DictConfig) -> float:
    """The `sgns rollout` command; returns wall seconds per simulated second (steps with force)."""
    from sgns.scenes import scene_from_config
    from sgns.simulator import Simulator

    simulator = Simulator.load(cfg.checkpoint, device=cfg.get("device", "cpu"))
    scene = scene_from_config(cfg)
    require_known_bed(simulator, scene, cfg.checkpoint)
    ignored = unlearned(simulator.scene, scene.to_dict())
    if ignored:
        log.warning("the network follows the tool's path only; it does not know of %s", ", ".join(ignored))
    output = Path(cfg.output)
    timing = rollout_scene(simulator, scene, output, seed=int(cfg.get("seed") or 0))
    log.info("rolled out %d frames (%.3g s) into %s", scene.frame_count, timing.simulated, output)
    log.info("wall seconds per simulated second: %.3g stepping with force", timing.stepping_rate)
    log.info(
        "wall seconds per simulated second: %.3g with decoding and writing every frame", timing.complete_rate
    )
    return timing.stepping_rate
