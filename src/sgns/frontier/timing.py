"""Wall times that can be compared: one core, warm, medians, beside a workload that is always the same.

The reference workload is the default scene of `sgns simulate` (the paper's bin at 20 mm, 4 particles per cell, half of
it computed) while the plate cuts. Its time is taken just before and just after what is measured, on the same core, so
that ratios to it hold on a machine whose speed changes.
"""

from __future__ import annotations

import os
import shlex
import statistics
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_module
from hydra.core.global_hydra import GlobalHydra

from mpm_warp import Frame, Scene, Solver, effects_for
from sgns import __version__
from sgns.clock import elapsed
from sgns.evaluation.provenance import command_line, cpu_model
from sgns.frontier.point import SHARED
from sgns.scenes import scene_from_config

__all__ = ["Workload", "composed_scene", "cost_fields", "made_here", "one_core"]

FRAMES = 8  # of one measurement of the workload
STRETCHES = 2  # of which the median is taken, before and after each


@contextmanager
def one_core(last: bool = False) -> Iterator[None]:
    """This process on the first (or last) core it may use, and torch on one thread; as before afterwards."""
    threads = torch.get_num_threads()
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_setaffinity") else None
    try:
        torch.set_num_threads(1)
        if cores:
            os.sched_setaffinity(0, {max(cores) if last else min(cores)})
        yield
    finally:
        torch.set_num_threads(threads)
        if cores:
            os.sched_setaffinity(0, cores)


def composed_scene(overrides: Sequence[str]) -> tuple[Scene, Any]:
    """The scene and all settings of `sgns simulate` with these overrides."""
    if GlobalHydra.instance().is_initialized():
        cfg = compose("simulate", list(overrides))
    else:
        with initialize_config_module("sgns.conf", version_base="1.3"):
            cfg = compose("simulate", list(overrides))
    return scene_from_config(cfg), cfg


class Workload:
    """The reference workload, warm."""

    def __init__(self) -> None:
        self._scene, _ = composed_scene(["scene=excavation"])
        self._frames: Iterator[Frame] = iter(())

    def measure(self) -> list[float]:
        """Wall seconds per simulated second of each of a few stretches; processor seconds where the core was shared."""
        found = []
        for _ in range(STRETCHES):
            if next(self._frames, None) is None:
                self._frames = Solver(self._scene, effects_for(self._scene)[0]).frames()
                for _ in range(2):  # the first frame loads kernels, the second is the first that computes
                    next(self._frames)
            began, processor = time.perf_counter(), time.process_time()
            done = sum(1 for _ in zip(range(FRAMES), self._frames, strict=False))
            if done == FRAMES:
                wall, processor = elapsed(began, time.perf_counter()), elapsed(processor, time.process_time())
                seconds = processor if wall > SHARED * processor else wall
                found.append(seconds * self._scene.frame_rate / FRAMES)
        return found or self.measure()


def cost_fields(
    rates: Sequence[float], workload: Sequence[float], processor_rate: float = float("nan")
) -> dict[str, Any]:
    """The columns of `Point` that say what it costs, for the CPU.

    Args:
        rates: wall seconds per simulated second, of each repeat.
        workload: those of the reference workload before and after.
        processor_rate: processor seconds per simulated second.
    """
    median, reference = statistics.median(rates), statistics.median(workload)
    cost = processor_rate if median > SHARED * processor_rate else median
    return {
        "wall_s_per_simulated_s": median,
        "wall_s_per_simulated_s_low": min(rates),
        "wall_s_per_simulated_s_high": max(rates),
        "processor_s_per_simulated_s": processor_rate,
        "repeats": float(len(rates)),
        "workload_wall_s_per_simulated_s": reference,
        "ratio": cost / reference,
        "processor": cpu_model(),
        "threads": 1.0,
        "device": "cpu",
    }


def made_here() -> dict[str, str]:
    """The columns of `Point` that say how and where it is measured; the command without its output folder."""
    words = shlex.split(command_line())
    return {
        "command": shlex.join(word for word in words if not word.startswith("output=")),
        "machine": cpu_model(),
        "version": __version__,
        "commit": commit(),
    }


@cache
def commit() -> str:
    """Short name of the commit this package runs from; empty if it is no checkout."""
    try:
        asked = subprocess.run(
            ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"],
            capture_output=True,
            text=True,
            check=False,
            timeout=10,
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return asked.stdout.strip() if asked.returncode == 0 else ""
