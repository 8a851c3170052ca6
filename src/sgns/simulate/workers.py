"""The runs of a campaign, made by one process per core, or many at once on a GPU."""

from __future__ import annotations

import logging
import math
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Generator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from mpm_warp import Effects, Frame, Scene, SceneError, Solver, SolverStopped, frames_together
from mpm_warp.launch import Job, run_concurrently
from mpm_warp.limits import usable_cores
from sgns.command_settings import Limits
from sgns.config import Interrupted, UserError, flattened, heeded_signals
from sgns.data.files import file_lock, remove_abandoned
from sgns.data.run import Run
from sgns.numbers import counted, duration_words, elapsed
from sgns.simulate.campaign import (
    Campaign,
    RunCost,
    cost_line,
    finishing_time,
    require_limits,
    require_space,
    run_cost,
    size_words,
)
from sgns.simulate.run import Restart, scene_stages, unfinished
from sgns.simulate.scene import effects_line, recorded

log = logging.getLogger(__name__)

_MEASURED = 0.3  # seconds of simulating, at least, that the first estimate rests on
_MEMORY = 600.0  # seconds after which what was seen of the speed counts 1/e
_FAREWELL = 30.0  # seconds that a worker has to keep what it has of its runs
_LOG_EVERY = 60.0  # seconds between lines about the progress where there is no terminal for a bar


def simulate_campaign(
    campaign: Campaign,
    *,
    device: str,
    workers: int | None = None,
    batch: int = 1,
    shard: int = 0,
    shards: int = 1,
    limits: Limits | None = None,
) -> None:
    """Make every run of a campaign that is not there yet, one process per core, the longest first.

    Several calls, on several machines too, may work on the same folder: no run is made twice at the same time.

    Args:
        campaign: what to make, and where.
        device: cpu or cuda.
        workers: processes at once; by default one for each core of a CPU, and one on a GPU.
        batch: runs that a process has under way at once; more than one pays on a GPU only.
        shard: which share of the runs to make, 0 to `shards` - 1.
        shards: into how many shares of like work the runs are divided.
        limits: what is refused before it begins; by default as on the command line.

    Raises:
        UserError: before anything is made, when the disk is too full; after all other runs are done, when some could
            not be made.
    """
    if not 0 <= shard < shards:
        raise UserError(
            f"shard is {shard!r}; with shards={shards} it must be a whole number from 0 to {shards - 1}"
        )
    physics = campaign.physics  # before anything is written: what was asked for may be impossible
    campaign.record()
    costs = {name: run_cost(scene, physics[name][0]) for name, scene in campaign.scenes.items()}
    by_length = sorted(costs, key=lambda name: costs[name].particle_steps, reverse=True)
    share = by_length[shard::shards]
    missing = [name for name in share if not is_done(campaign.file(name), campaign.scenes[name])]
    for name in set(share) - set(missing):  # nobody will write these again
        remove_abandoned(campaign.file(name))
    part = f", {len(share)} of them in shard {shard} of {shards}" if shards > 1 else ""
    total = f"{len(campaign.scenes)} runs{part}"
    log.info("dataset in %s: %s, %d to do", campaign.path, total, len(missing))
    if not missing:
        return
    log.info("%s", effects_line([physics[name][1] for name in missing]))
    size = sum(costs[name].size for name in missing)
    waiting = {name: costs[name] for name in missing}
    log.info("%s", cost_line(list(waiting.values())))
    require_limits(waiting, limits or Limits())
    require_space(campaign.path, size)
    compile_kernels(campaign, missing, device)
    workers = min(workers or (1 if device != "cpu" else usable_cores()), len(missing))
    batch = min(batch, math.ceil(len(missing) / workers))
    pool = Workers(campaign, waiting, device, workers, batch)
    failed = pool.make_all(f"about {size_words(size)} of disk")
    if failed:
        name, message = next(iter(failed.items()))
        raise UserError(
            f"{len(failed)} of {len(missing)} runs could not be made (the others are); the first is {name}: {message}"
        )
    log.info("%s made in %s; what each is: runs.csv", counted(len(missing), "run"), campaign.path)


def compile_kernels(campaign: Campaign, names: list[str], device: str) -> None:
    """Compile the kernels that the scenes need, once; the processes find them in Warp's cache.

    Kernels can differ only where scenes differ in their effects or in something else than the size of a number.
    """

    def switch(value: Any) -> Any:
        if isinstance(value, (int, float)):
            return bool(value)
        return value if isinstance(value, str) else type(value)

    with_other_kernels: dict[tuple[frozenset[Any], Effects], Scene] = {}
    for name in names:
        scene, effects = campaign.scenes[name], campaign.physics[name][0]
        settings = flattened(scene.to_dict() | {"name": ""})
        switches = frozenset((key, switch(value)) for key, value in settings.items())
        with_other_kernels.setdefault((switches, effects), scene)
    for (_, effects), scene in with_other_kernels.items():
        next(Solver(scene, effects, device, campaign.precision).frames())


@dataclass(frozen=True)
class _Job:
    """A run, as it is sent to a worker process."""

    name: str
    number: int
    """Among the runs to make."""
    scene: dict[str, Any]
    """With the meshes, for `Scene.from_dict`."""
    meshes: tuple[tuple[np.ndarray, np.ndarray] | None, ...]
    file: Path
    physics: dict[str, Any]
    """As `scene_stages` takes it: effects, reasons, seed, device and precision."""

    def read_scene(self) -> Scene:
        return Scene.from_dict(self.scene, *self.meshes)


class Workers:
    """Worker processes, what they have done, and how long the rest will take."""

    def __init__(
        self, campaign: Campaign, costs: dict[str, RunCost], device: str, workers: int, batch: int = 1
    ) -> None:
        self.campaign, self.costs, self.workers, self.batch = campaign, costs, workers, batch
        self.at_once = workers * batch
        self._jobs = []
        for number, name in enumerate(costs):
            scene, (effects, decisions) = campaign.scenes[name], campaign.physics[name]
            physics = {"effects": effects, "reasons": recorded(decisions), "seed": campaign.seed}
            physics |= {"device": device, "precision": campaign.precision}
            file = campaign.file(name)
            self._jobs.append(_Job(name, number, scene.to_dict(), scene.meshes, file, physics))
        if multiprocessing.get_start_method(allow_none=True) == "loky":
            # In a worker of joblib's, whose way to start processes a child of ours would not know.
            multiprocessing.set_start_method("spawn", force=True)
        context = multiprocessing.get_context("spawn")
        # Of every run: frames done, those of them that an attempt before had made, and whether it has ended. Each entry
        # has one writer, so there is no lock.
        self._frames_done, self._frames_found = (context.RawArray("q", len(costs)) for _ in range(2))
        self._ended = context.RawArray("b", len(costs))
        shared = (self._frames_done, self._frames_found, self._ended, context.Barrier(workers))
        self._pool = ProcessPoolExecutor(workers, context, _start_worker, shared)
        self._futures: dict[str, Future[dict[str, tuple[str, str]]]] = {}
        # What the estimates rest on: particle-steps made, and the seconds that they took, of each run for itself.
        self._steps_seen, self._seconds_seen = 0.0, 0.0

    def make_all(self, disk: str) -> dict[str, str]:
        """Make the runs; returns the message of each that could not be made."""
        with self._pool:
            try:
                self._measure()
                log.info("measured here: about %s with %d at once, %s", self.time_left(), self.at_once, disk)
                # Every run is for itself, but a worker that makes several at once gets its share of them together.
                shares = self.workers if self.batch > 1 else len(self._jobs)
                for share in (self._jobs[number::shares] for number in range(shares)):
                    future = self._pool.submit(_make_share, share, self.batch)
                    self._futures.update((job.name, future) for job in share)
                self._follow()
                outcomes = {name: future.result()[name] for name, future in self._futures.items()}
            except BrokenProcessPool:
                raise UserError(
                    f"a process that simulated died, perhaps for lack of memory; the complete runs are kept in "
                    f"{self.campaign.path}; the same command goes on"
                ) from None
            except BaseException:
                workers = multiprocessing.active_children()
                self._pool.shutdown(wait=False, cancel_futures=True)
                for process in workers:
                    process.terminate()
                for process in workers:  # what they keep is there when the command has ended
                    process.join(_FAREWELL)
                raise
        if elsewhere := sum(outcome == "elsewhere" for outcome, _ in outcomes.values()):
            log.info("runs left to another process that is making them or has made them: %d", elsewhere)
        return {name: message for name, (outcome, message) in outcomes.items() if outcome == "failed"}

    def _measure(self) -> None:
        """Let all workers step runs from all over the list for a moment, at the same time."""
        sample = [self._jobs[i * len(self._jobs) // self.at_once] for i in range(self.at_once)]
        shares = [sample[worker :: self.workers] for worker in range(self.workers)]
        trials = [self._pool.submit(time_jobs, share) for share in shares]
        for share, trial in zip(shares, trials, strict=True):
            frames, seconds = trial.result()
            for job, count in zip(share, frames, strict=True):
                self._steps_seen += count * self.costs[job.name].steps_per_frame
                self._seconds_seen += seconds

    def _follow(self) -> None:
        """Wait for all runs, keeping the bar and the estimate up to date."""
        total, runs = sum(cost.particle_steps for cost in self.costs.values()), len(self._jobs)
        made, last, last_line = 0, time.monotonic(), time.monotonic()
        layout = "{desc}: {percentage:3.0f}%|{bar}| {elapsed}{postfix}"
        with tqdm(total=total, desc=f"{self.at_once} at once", bar_format=layout, disable=None) as bar:
            while rest := self._rest():
                time.sleep(0.2)
                now, steps = time.monotonic(), self.steps_made()
                self._see(steps - made, elapsed(last, now), busy=min(self.at_once, len(rest)))
                made, last = steps, now
                done = f"{runs - len(rest)} of {runs} runs"
                bar.set_postfix_str(f"{done}, {self.time_left()} left", refresh=False)
                bar.update(total - sum(rest.values()) - bar.n)
                if bar.disable and now - last_line > _LOG_EVERY:
                    log.info("%s, %s left", done, self.time_left())
                    last_line = now
            bar.set_postfix_str(f"{runs} of {runs} runs", refresh=False)
            bar.update(total - bar.n)

    def _see(self, steps: float, seconds: float, busy: int) -> None:
        """Add the particle-steps of `busy` runs in the last seconds; a machine's speed may change."""
        kept = math.exp(-seconds / _MEMORY)
        self._steps_seen = kept * self._steps_seen + steps
        self._seconds_seen = kept * self._seconds_seen + seconds * busy

    def steps_made(self) -> int:
        """Particle-steps in all frames made here so far; a run's first frame takes none."""
        counts = zip(self._frames_done, self._frames_found, self.costs.values(), strict=True)
        return sum(max(0, frames - max(1, found)) * cost.steps_per_frame for frames, found, cost in counts)

    def _rest(self) -> dict[str, int]:
        """Particle-steps that are left of every run that is not finished."""
        runs = zip(self.costs.items(), self._frames_done, self._ended, strict=True)
        return {
            name: cost.particle_steps - max(0, frames - 1) * cost.steps_per_frame
            for (name, cost), frames, ended in runs
            if name not in self._futures or not (ended or self._futures[name].done())
        }

    def time_left(self) -> str:
        """Time to the end of the last run at the speed seen so far, in words."""
        if not self._steps_seen:
            return "an unknown time"
        rest = self._rest()
        begun = {name for name, frames in zip(self.costs, self._frames_done, strict=True) if frames}
        running = [steps for name, steps in rest.items() if name in begun][: self.at_once]
        waiting = [steps for name, steps in rest.items() if name not in begun]
        rate = self._steps_seen / self._seconds_seen
        return duration_words(finishing_time(waiting, running, self.at_once) / rate)


# --- in the worker processes ------------------------------------------------------------------------------

_frames_done: Any = None  # shared with the first process and set once, like the other three
_frames_found: Any = None
_ended: Any = None
_barrier: Any = None


def _start_worker(frames_done: Any, frames_found: Any, ended: Any, barrier: Any) -> None:
    global _frames_done, _frames_found, _ended, _barrier
    _frames_done, _frames_found, _ended, _barrier = frames_done, frames_found, ended, barrier
    # Ctrl-C reaches all processes of the terminal; the first one ends the others.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    first = multiprocessing.parent_process()
    assert first is not None

    def leave_with_parent() -> None:
        first.join()  # else a worker would go on alone after its parent was killed
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(_FAREWELL)
        os._exit(1)

    threading.Thread(target=leave_with_parent, daemon=True).start()


def time_jobs(jobs: list[_Job]) -> tuple[list[int], float]:
    """Frames made of each run and the seconds they took all together, while the other workers do the same."""
    scenes, effects = [job.read_scene() for job in jobs], [job.physics["effects"] for job in jobs]
    device, precision = jobs[0].physics["device"], jobs[0].physics["precision"]
    frames = frames_together(scenes, effects, device, precision, at_once=len(jobs))
    for _ in jobs:
        next(frames)  # the state at the start
    with suppress(threading.BrokenBarrierError):
        _barrier.wait(timeout=120.0)
    start, counts = time.perf_counter(), [0] * len(jobs)
    for number, frame in frames:
        counts[number] += isinstance(frame, Frame)  # if it is an error, whoever makes the run says so
        if elapsed(start, time.perf_counter()) > _MEASURED:
            break
    return counts, elapsed(start, time.perf_counter())


def _make_share(jobs: list[_Job], batch: int) -> dict[str, tuple[str, str]]:
    """Make the runs, `batch` at once; gives what `_make` says of each."""
    outcomes = {}
    try:
        with heeded_signals():
            for number, outcome in run_concurrently(map(_make, jobs), batch, jobs[0].physics["device"]):
                outcomes[jobs[number].name] = outcome
                _ended[jobs[number].number] = True
    except Interrupted:
        os._exit(1)  # the pool would take it for the end of this share only
    return outcomes


def _make(job: _Job) -> Generator[tuple[str, str] | Job, None, None]:
    """Make one run unless another process does, passing on the work for the device; gives made, elsewhere or failed,
    and what went wrong in words."""

    def count_frame() -> None:
        _frames_done[job.number] += 1

    outcome = "made", ""
    try:
        scene = job.read_scene()
        with file_lock(job.file) as ours:
            if not ours or is_done(job.file, scene):
                outcome = "elsewhere", ""
            else:
                restart = _begun(job, scene)
                if restart is not None:
                    _frames_found[job.number] = restart.state.frame + 1
                stages = scene_stages(scene, job.file, **job.physics, progress=count_frame, restart=restart)
                with closing(stages):  # what it keeps is written while the file is locked
                    for stage in stages:
                        if isinstance(stage, Job):
                            yield stage
    except (UserError, SceneError, SolverStopped) as error:
        outcome = "failed", str(error)
    yield outcome


def _begun(job: _Job, scene: Scene) -> Restart | None:
    """What an interrupted attempt left; what is of other settings or damaged is made again."""
    same = {name: job.physics[name] for name in ("effects", "seed", "precision")}
    try:
        return unfinished(job.file, scene, **same)
    except UserError as error:
        log.info("%s", error)
        return None


def is_done(file: Path, scene: Scene) -> bool:
    """Whether the run is there and is of this scene; a file that cannot be read is made again."""
    if not file.exists():
        return False
    try:
        with Run(file) as run:
            return run.scene == scene.to_dict()
    except UserError as error:
        log.info("%s; it is made again", error)
        return False
