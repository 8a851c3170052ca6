"""The runs of a campaign, made by one process per core."""

from __future__ import annotations

import logging
import math
import multiprocessing
import os
import signal
import threading
import time
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from pathlib import Path
from typing import Any

from tqdm import tqdm

from mpm_warp import Effects, Scene, SceneError, Solver, SolverStopped
from sgns.campaign import Campaign
from sgns.claim import claimed
from sgns.cost import RunCost, duration_words, finishing_time, require_space, run_cost, size_words
from sgns.errors import UserError
from sgns.runs import Run
from sgns.scene_effects import decision_summary, recorded
from sgns.scene_run import simulate_scene
from sgns.settings import flattened

__all__ = ["simulate_campaign"]

log = logging.getLogger(__name__)

_MEASURED = 0.3  # seconds of stepping, at least, that the first estimate rests on
_MEMORY = 600.0  # seconds after which what was seen of the speed counts 1/e
_LOG_EVERY = 60.0  # seconds between lines about the progress where there is no terminal for a bar


def simulate_campaign(
    campaign: Campaign, *, device: str, workers: int | None = None, shard: int = 0, shards: int = 1
) -> None:
    """Make every run of a campaign that is not there yet, one process per core, the longest first.

    Several calls, on several machines too, may work on the same folder: no run is made twice at the same time.

    Args:
        campaign: what to make, and where.
        device: cpu or cuda.
        workers: runs at once; by default one for each core of a CPU, and one on a GPU.
        shard: which share of the runs to make, 0 to `shards` - 1.
        shards: into how many shares of like work the runs are divided.

    Raises:
        UserError: before anything is made, when the disk is too full; after all other runs are done, when some could
            not be made.
    """
    if type(shards) is not int or shards < 1:
        raise UserError(f"shards is {shards!r}; it must be a whole number, 1 or more")
    if type(shard) is not int or not 0 <= shard < shards:
        raise UserError(
            f"shard is {shard!r}; with shards={shards} it must be a whole number from 0 to {shards - 1}"
        )
    physics = campaign.physics  # before anything is written: what was asked for may be impossible
    campaign.record()
    costs = {name: run_cost(scene) for name, scene in campaign.scenes.items()}
    by_length = sorted(costs, key=lambda name: costs[name].work, reverse=True)
    share = by_length[shard::shards]
    missing = [name for name in share if not _done(campaign.file(name), campaign.scenes[name])]
    part = f", {len(share)} of them in shard {shard} of {shards}" if shards > 1 else ""
    total = f"{len(campaign.scenes)} runs{part}"
    log.info("dataset %s in %s: %s, %d to do", campaign.name, campaign.path, total, len(missing))
    if not missing:
        return
    for line in decision_summary(physics[name][1] for name in missing):
        log.info("%s", line)
    size = sum(costs[name].size for name in missing)
    require_space(campaign.path, size)
    _compile(campaign, missing, device)
    workers = min(workers or (1 if device != "cpu" else len(os.sched_getaffinity(0))), len(missing))
    production = _Production(campaign, {name: costs[name] for name in missing}, device, workers)
    failed = production.make_all(f"about {size_words(size)} of disk")
    if failed:
        name, message = next(iter(failed.items()))
        raise UserError(
            f"{len(failed)} of {len(missing)} runs could not be made (the others are); the first is {name}: {message}"
        )


def _compile(campaign: Campaign, names: list[str], device: str) -> None:
    """Compile the kernels of every kind of scene, once; the processes find them in Warp's cache.

    Kernels can differ only where scenes differ in their effects or in something else than the size of a number.
    """
    kinds = {}
    for name in names:
        scene = campaign.scenes[name]
        chosen = {
            key: value
            if isinstance(value, str)
            else bool(value)
            if isinstance(value, (int, float))
            else type(value)
            for key, value in flattened(scene.to_dict()).items()
            if key != "name"
        }
        kinds.setdefault((frozenset(chosen.items()), campaign.physics[name][0]), scene)
    for (_, physics), scene in kinds.items():
        Solver(scene, physics, device, campaign.precision)


class _Production:
    """Worker processes, what they have done, and how long the rest will take."""

    def __init__(self, campaign: Campaign, costs: dict[str, RunCost], device: str, workers: int) -> None:
        self.campaign, self.costs, self.workers = campaign, costs, workers
        self._settings = (campaign.seed, device, campaign.precision)
        context = multiprocessing.get_context("spawn")
        # Frames done of every run; each entry has one writer, so there is no lock.
        self._frames_done = context.RawArray("q", len(costs))
        self._pool = ProcessPoolExecutor(
            workers, context, _start_worker, (self._frames_done, context.Barrier(workers))
        )
        self._jobs: dict[str, Future[tuple[str, str]]] = {}
        # What the estimates rest on: particle-steps made, and the seconds of a worker that they took.
        self._work_seen, self._seconds_seen = 0.0, 0.0

    def make_all(self, disk: str) -> dict[str, str]:
        """Make the runs; returns the message of each that could not be made."""
        with self._pool:
            try:
                self._measure()
                log.info("about %s with %d at once, %s", self._left(), self.workers, disk)
                for index, name in enumerate(self.costs):
                    scene, file = self.campaign.scenes[name].to_dict(), self.campaign.file(name)
                    effects, decisions = self.campaign.physics[name]
                    job = (index, scene, file, effects, recorded(decisions), *self._settings)
                    self._jobs[name] = self._pool.submit(_make, *job)
                self._follow()
                outcomes = {name: job.result() for name, job in self._jobs.items()}
            except BrokenProcessPool:
                raise UserError(
                    f"a process that simulated died, perhaps for lack of memory; the complete runs are kept in "
                    f"{self.campaign.path}; the same command goes on"
                ) from None
            except BaseException:
                self._pool.shutdown(wait=False, cancel_futures=True)
                for process in multiprocessing.active_children():
                    process.terminate()
                raise
        elsewhere = sum(kind == "elsewhere" for kind, _ in outcomes.values())
        if elsewhere:
            log.info("runs left to another process that is making them or has made them: %d", elsewhere)
        return {name: message for name, (kind, message) in outcomes.items() if kind == "failed"}

    def _measure(self) -> None:
        """Let all workers step runs from all over the list for a moment, at the same time."""
        names = list(self.costs)
        sample = [names[i * len(names) // self.workers] for i in range(self.workers)]
        _, device, precision = self._settings
        trials = [
            self._pool.submit(
                _try, self.campaign.scenes[name].to_dict(), self.campaign.physics[name][0], device, precision
            )
            for name in sample
        ]
        for name, trial in zip(sample, trials, strict=True):
            frames, seconds = trial.result()
            self._work_seen += frames * self.costs[name].work_per_frame
            self._seconds_seen += seconds

    def _follow(self) -> None:
        """Wait for all runs, keeping the bar and the estimate up to date."""
        total = sum(cost.work for cost in self.costs.values())
        made, last, last_line = 0, time.monotonic(), time.monotonic()
        layout = "{desc}: {percentage:3.0f}%|{bar}| {elapsed}{postfix}"
        with tqdm(total=total, desc=f"{self.workers} at once", bar_format=layout, disable=None) as bar:
            while rest := self._rest():
                time.sleep(0.2)
                now, work = time.monotonic(), self._work_made()
                self._see(work - made, now - last, busy=min(self.workers, len(rest)))
                made, last = work, now
                done = f"{len(self._jobs) - len(rest)} of {len(self._jobs)} runs"
                bar.set_postfix_str(f"{done}, {self._left()} left", refresh=False)
                bar.update(total - sum(rest.values()) - bar.n)
                if bar.disable and now - last_line > _LOG_EVERY:
                    log.info("%s, %s left", done, self._left())
                    last_line = now
            bar.set_postfix_str(f"{len(self._jobs)} of {len(self._jobs)} runs", refresh=False)
            bar.update(total - bar.n)

    def _see(self, work: float, elapsed: float, busy: int) -> None:
        """Add the particle-steps of `busy` workers in the last `elapsed` seconds; a machine's speed may change."""
        kept = math.exp(-elapsed / _MEMORY)
        self._work_seen = kept * self._work_seen + work
        self._seconds_seen = kept * self._seconds_seen + elapsed * busy

    def _work_made(self) -> int:
        """Particle-steps in all frames so far; a run's first frame takes none."""
        counts = zip(self._frames_done, self.costs.values(), strict=True)
        return sum(max(0, frames - 1) * cost.work_per_frame for frames, cost in counts)

    def _rest(self) -> dict[str, int]:
        """Particle-steps that are left of every run that is not finished."""
        return {
            name: cost.work - max(0, frames - 1) * cost.work_per_frame
            for frames, (name, cost) in zip(self._frames_done, self.costs.items(), strict=True)
            if name not in self._jobs or not self._jobs[name].done()
        }

    def _left(self) -> str:
        """Time to the end of the last run at the speed seen so far, in words."""
        if not self._work_seen:
            return "an unknown time"
        rest = self._rest()
        begun = {name for name, frames in zip(self.costs, self._frames_done, strict=True) if frames}
        running = [work for name, work in rest.items() if name in begun][: self.workers]
        waiting = [work for name, work in rest.items() if name not in begun]
        rate = self._work_seen / self._seconds_seen
        return duration_words(finishing_time(waiting, running, self.workers) / rate)


# --- in the worker processes ------------------------------------------------------------------------------

_frames_done: Any = None  # shared with the first process and set once, like the barrier
_barrier: Any = None


def _start_worker(frames_done: Any, barrier: Any) -> None:
    global _frames_done, _barrier
    _frames_done, _barrier = frames_done, barrier
    # Ctrl-C reaches all processes of the terminal; the first one ends the others.
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def leave_with_parent() -> None:
        # Without this a worker would go on alone after its parent was killed.
        multiprocessing.parent_process().join()
        os._exit(1)

    threading.Thread(target=leave_with_parent, daemon=True).start()


def _try(scene: dict[str, Any], effects: Effects, device: str, precision: str) -> tuple[int, float]:
    """Frames made and the seconds they took, while the other workers do the same."""
    frames = Solver(Scene.from_dict(scene), effects, device, precision).frames()
    next(frames)
    with suppress(threading.BrokenBarrierError):
        _barrier.wait(timeout=120.0)
    start, count = time.perf_counter(), 0
    with suppress(SolverStopped):  # whoever makes the run says so
        for _ in frames:
            count += 1
            if time.perf_counter() - start > _MEASURED:
                break
    return count, time.perf_counter() - start


def _make(
    index: int,
    scene: dict[str, Any],
    output: Path,
    effects: Effects,
    reasons: dict[str, dict[str, Any]],
    seed: int,
    device: str,
    precision: str,
) -> tuple[str, str]:
    """Make one run unless another process does; gives made, elsewhere or failed, and what went wrong in words."""

    def count_frame() -> None:
        _frames_done[index] += 1

    try:
        with claimed(output) as ours:
            if not ours or _done(output, Scene.from_dict(scene)):
                return "elsewhere", ""
            simulate_scene(
                Scene.from_dict(scene),
                output,
                effects=effects,
                reasons=reasons,
                seed=seed,
                device=device,
                precision=precision,
                progress=count_frame,
            )
    except (UserError, SceneError, SolverStopped) as error:
        return "failed", str(error)
    return "made", ""


def _done(file: Path, scene: Scene) -> bool:
    """Whether the run is there and is of this scene; a file that cannot be read is made again."""
    if not file.exists():
        return False
    try:
        with Run(file) as run:
            return run.scene == scene.to_dict()
    except UserError as error:
        log.info("%s; it is made again", error)
        return False
