"""A scene simulated into a run file."""

from __future__ import annotations

import time
from collections.abc import Generator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpm_warp import Effects, Scene, Solver, SolverStopped
from mpm_warp.batch import all_together
from mpm_warp.work import Work
from sgns.clock import elapsed
from sgns.continuation import Continuation
from sgns.runs import RunWriter

__all__ = ["Timing", "scene_stages", "simulate_scene"]


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
    ((_, timing),) = all_together([scene_stages(scene, output, **settings)], 1, settings.get("device", "cpu"))
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
    progress: Any = None,
    going_on: Continuation | None = None,
) -> Generator[Timing | Work, None, None]:
    """Compute a scene and write its run file, with the particles that `scene.bed.store_every` leaves in it.

    Args:
        reasons: effect → on, reason, number, for the run file; by default what `effects` says of itself.
        progress: called once after every frame.
        going_on: a stopped run of this scene; its frames are copied and the solver begins after them.

    Yields:
        All work that the device has to do (mpm_warp's work.py), and at the end what it cost.

    Raises:
        SolverStopped: the line says where the frames before it are kept and how to go on.
    """
    computed, state = (scene, None) if going_on is None else (going_on.changed_scene, going_on.state)
    solver = Solver(computed, effects, device, precision, start=state)
    stored = scene.stored
    with RunWriter(
        output,
        scene=scene.to_dict(),
        effects=reasons or effects.described(),
        arrangement_hash=scene.arrangement_hash,
        particle_count=len(stored),
        body_points=len(scene.body_points()),
        frame_rate=scene.frame_rate,
        seed=seed,
        producer="mpm",
        extra={
            "device": device,
            "precision": precision,
            "time_step_s": solver.time_step,
            "substeps_per_frame": solver.substeps_per_frame,
            "particles_simulated": solver.particle_count,
        }
        | ({"continued": going_on.record} if going_on is not None else {}),
        mesh=scene.mesh,
    ) as writer:
        for frame in going_on.frames() if going_on is not None else ():
            writer.append(*frame)
            if progress is not None:
                progress()
        there = writer.frame_count
        # Loading kernels is not part of the cost of a run: the clock starts with the first frame, or with the first
        # work where the first frames are there already.
        before = going_on.wall_time if going_on is not None else 0.0
        wall_time, seen, shared_by = before, None, 1
        try:
            for stage in solver.stages():
                if isinstance(stage, Work):
                    if there and stage.steps and seen is None:
                        seen = time.perf_counter()
                    yield stage
                    shared_by = stage.shared_by
                    if seen is not None:
                        now = time.perf_counter()
                        wall_time, seen = wall_time + elapsed(seen, now) / shared_by, now
                    continue
                seen = seen if seen is not None else time.perf_counter()
                writer.append(
                    stage.time,
                    stage.position[stored],
                    stage.velocity[stored],
                    stage.body_points,
                    stage.body_pose,
                    stage.force,
                    stage.torque,
                )
                if progress is not None:
                    progress()
        except SolverStopped as stopped:
            if stopped.state is None or stopped.state.frame != writer.frame_count - 1:
                raise
            kept = writer.stop(wall_time, str(stopped), stopped.state)
            raise SolverStopped(f"{stopped}. {_way_on(str(stopped), kept, output, computed)}") from stopped
        wall_time += elapsed(seen, time.perf_counter()) / shared_by if seen is not None else 0.0
        writer.finish(wall_time)
    frames = scene.frame_count - max(1, there)
    yield Timing(
        elapsed(before, wall_time),
        frames / scene.frame_rate,
        frames * solver.substeps_per_frame * solver.computed_count,
    )


def _way_on(cause: str, kept: Path, output: Path, computed: Scene) -> str:
    """Where the frames are, and how to go on if a continuation can do what the cause asks for."""
    command = f"They are kept: sgns simulate continue_from={kept} output={output}"
    if "scene.courant" in cause:
        return f"{command} scene.courant={0.5 * computed.courant:g} goes on from there with half the step"
    if "scene.bed.headroom" in cause:
        return f"{command} scene.bed.headroom={2.0 * computed.bed.headroom:g} goes on from there"
    return f"They are kept in {kept}"
