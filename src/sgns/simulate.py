"""`sgns simulate`: one scene, or every scene of a dataset, with the material point method."""

from __future__ import annotations

import logging
import multiprocessing
import os
import threading
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hydra import compose
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from mpm_warp import Effects, Scene, SceneError, Solver, SolverStopped
from sgns.campaign import Campaign, plan
from sgns.errors import UserError
from sgns.runs import Run, RunWriter
from sgns.scenes import effects_from_config, scene_from_config

__all__ = ["Timing", "main", "simulate_campaign", "simulate_scene"]

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Timing:
    """What a run cost; compilation and set-up are not in it, recording the frames is."""

    wall_time: float
    """[s]"""
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


def simulate_scene(
    scene: Scene,
    output: Path,
    *,
    effects: Effects,
    seed: int = 0,
    device: str = "cpu",
    precision: str = "float32",
    progress: Any = None,
) -> Timing:
    """Compute a scene and write its run file.

    Args:
        progress: called once after every frame.
    """
    solver = Solver(scene, effects, device, precision)
    with RunWriter(
        output,
        scene=scene.to_dict(),
        effects=effects.described(),
        arrangement_hash=scene.arrangement_hash,
        particle_count=solver.particle_count,
        body_points=len(scene.body_points()),
        frame_rate=scene.frame_rate,
        seed=seed,
        producer="mpm",
        extra={
            "device": device,
            "precision": precision,
            "time_step_s": solver.time_step,
            "substeps_per_frame": solver.substeps_per_frame,
        },
    ) as writer:
        start = None
        for frame in solver.frames():
            # The clock starts with the first step: loading kernels is not part of the cost of a run.
            start = start if start is not None else time.perf_counter()
            writer.append(
                frame.time,
                frame.position,
                frame.velocity,
                frame.body_points,
                frame.body_pose,
                frame.force,
                frame.torque,
            )
            if progress is not None:
                progress()
        wall_time = time.perf_counter() - start
        writer.finish(wall_time)
    frames = scene.frame_count - 1
    return Timing(
        wall_time, frames / scene.frame_rate, frames * solver.substeps_per_frame * solver.particle_count
    )


def simulate_campaign(campaign: Campaign, *, device: str, workers: int | None = None) -> None:
    """Make every run of a campaign that is not there yet, one process per core.

    Raises:
        UserError: after all other runs are done, when some could not be made.
    """
    campaign.record()
    missing = {
        name: scene for name, scene in campaign.scenes.items() if not _done(campaign.file(name), scene)
    }
    total = len(campaign.scenes)
    log.info("dataset %s in %s: %d runs, %d to do", campaign.name, campaign.path, total, len(missing))
    if not missing:
        return
    first = next(iter(missing.values()))
    particles = len(first.initial_positions())
    frames = sum(scene.frame_count for scene in missing.values())
    log.info(
        "%d particles, %d frames, about %.1f GB of disk", particles, frames, frames * particles * 24 / 1e9
    )
    effects = Effects(**campaign.effects)
    # Compiles the kernels once; the processes find them in the cache.
    Solver(first, effects, device, campaign.precision)
    workers = workers or (1 if device != "cpu" else len(os.sched_getaffinity(0)))
    context = multiprocessing.get_context("spawn")
    done = context.Value("q", 0)
    failed: dict[str, str] = {}
    with (
        ProcessPoolExecutor(
            min(workers, len(missing)), mp_context=context, initializer=_start_worker, initargs=(done,)
        ) as pool,
        tqdm(total=frames, unit="frame", desc=f"{min(workers, len(missing))} at once", disable=None) as bar,
    ):
        jobs = {
            pool.submit(
                _worker,
                scene.to_dict(),
                campaign.file(name),
                asdict(effects),
                campaign.seed,
                device,
                campaign.precision,
            ): name
            for name, scene in missing.items()
        }
        try:
            waiting = set(jobs)
            while waiting:
                waiting = {job for job in waiting if not job.done()}
                bar.update(done.value - bar.n)
                time.sleep(0.2)
            for job in as_completed(jobs):
                if message := job.result():
                    failed[jobs[job]] = message
        except BrokenProcessPool:
            raise UserError(
                f"a process that simulated died, perhaps for lack of memory; the complete runs are kept in "
                f"{campaign.path}; the same command goes on"
            ) from None
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise
    if failed:
        name, message = next(iter(failed.items()))
        raise UserError(
            f"{len(failed)} of {total} runs could not be made (the others are); the first is {name}: {message}"
        )


_frames_done: Any = None  # shared counter, set once in each worker process


def _start_worker(counter: Any) -> None:
    global _frames_done
    _frames_done = counter

    def leave_with_parent() -> None:
        # Without this a worker would go on alone after its parent was killed.
        multiprocessing.parent_process().join()
        os._exit(1)

    threading.Thread(target=leave_with_parent, daemon=True).start()


def _count_frame() -> None:
    with _frames_done.get_lock():
        _frames_done.value += 1


def _worker(
    scene: dict[str, Any], output: Path, effects: dict[str, bool], seed: int, device: str, precision: str
) -> str | None:
    """Make one run in a worker process; what went wrong comes back as words."""
    try:
        simulate_scene(
            Scene.from_dict(scene),
            output,
            effects=Effects(**effects),
            seed=seed,
            device=device,
            precision=precision,
            progress=_count_frame,
        )
    except (UserError, SceneError, SolverStopped) as error:
        return str(error)
    return None


def _done(file: Path, scene: Scene) -> bool:
    """Whether the run is there and is of this scene; a file that cannot be read is made again."""
    if not file.exists():
        return False
    try:
        with Run(file) as run:
            return run.scene == scene.to_dict()
    except UserError as error:
        log.warning("%s; it is made again", error)
        return False


def _base_scene(settings: dict[str, Any]) -> dict[str, Any]:
    """The scene a campaign names, with the command's own overrides of scene.* and material.*."""
    overrides = HydraConfig.get().overrides.task
    if any(o.startswith("scene=") for o in overrides):
        raise UserError(f"dataset={settings['name']} brings its own scene; leave out scene=")
    kept = [o for o in overrides if not o.lstrip("+~").startswith("dataset")]
    cfg = compose("simulate", [f"scene={settings['scene']}", *kept])
    return scene_from_config(cfg).to_dict()


def main(cfg: DictConfig) -> float | None:
    """Simulate `cfg.scene` into `cfg.output`, or the campaign `cfg.dataset`.

    Returns:
        Wall seconds per simulated second of a single scene.
    """
    effects = effects_from_config(cfg)
    if cfg.get("dataset") is not None:  # `dataset: null` in a defaults list leaves no key
        settings = OmegaConf.to_container(cfg.dataset, resolve=True)
        campaign = plan(settings, _base_scene(settings), asdict(effects), cfg.solver.precision, cfg.seed)
        simulate_campaign(campaign, device=cfg.device)
        return None
    scene = scene_from_config(cfg)
    for warning in scene.warnings():
        log.warning("%s", warning)
    output = Path(cfg.output)
    with tqdm(total=scene.frame_count, unit="frame", desc=scene.name, disable=None) as bar:
        timing = simulate_scene(
            scene,
            output,
            effects=effects,
            seed=cfg.seed,
            device=cfg.device,
            precision=cfg.solver.precision,
            progress=bar.update,
        )
    with Run(output) as run:
        log.info("%s: %d particles, %d frames", output, run.particle_count, run.frame_count)
        if words := scene.summary(run.force, run.torque, run.pose):
            log.info("%s", words)
    log.info(
        "%.1f s for %.2f simulated s: %.2f s per simulated second, %.2f M particle-steps/s on %s",
        timing.wall_time,
        timing.simulated,
        timing.per_simulated_second,
        timing.rate / 1e6,
        cfg.device,
    )
    return timing.per_simulated_second
