"""What runs cost in work, time and disk, before and while they are made."""

from __future__ import annotations

import heapq
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mpm_warp import Scene, substeps_per_frame
from sgns.errors import UserError

__all__ = ["RunCost", "duration_words", "finishing_time", "require_space", "run_cost", "size_words"]

# A recorded particle is a position and a velocity in float32, a body point a position in float64. The others are those
# of files: pose, force, torque, time and HDF5's own for each frame; scene and structure.
_BYTES_PER_PARTICLE = 24
_BYTES_PER_FRAME = 240
_BYTES_PER_BODY_POINT = 24
_BYTES_PER_FILE = 30_000


@dataclass(frozen=True)
class RunCost:
    """What a run takes, whatever the machine."""

    particles: int
    """That the solver computes."""
    substeps: int
    """Between two frames."""
    frames: int
    """T."""
    size: int
    """Of the run file [bytes], to a few per cent."""

    @property
    def work_per_frame(self) -> int:
        """Particle-steps between two frames."""
        return self.particles * self.substeps

    @property
    def work(self) -> int:
        """Particle-steps of the run."""
        return self.work_per_frame * (self.frames - 1)


def run_cost(scene: Scene) -> RunCost:
    """The cost of a scene's run.

    Raises:
        SceneError: it is too large to be computed.
    """
    substeps = substeps_per_frame(scene)  # before its particles are made
    particles, stored = len(scene.filled[0]), len(scene.stored)
    per_frame = (
        stored * _BYTES_PER_PARTICLE + len(scene.body_points()) * _BYTES_PER_BODY_POINT + _BYTES_PER_FRAME
    )
    return RunCost(
        particles=particles,
        substeps=substeps,
        frames=scene.frame_count,
        size=scene.frame_count * per_frame + _BYTES_PER_FILE,
    )


def finishing_time(waiting: Sequence[float], running: Sequence[float], workers: int) -> float:
    """When the last job ends if every worker that becomes free takes the next one, in the unit of the jobs' lengths.

    Args:
        waiting: lengths of the jobs not begun, in their order.
        running: what is left of the jobs under way, at most one for each worker.
        workers: how many jobs go on at once.
    """
    free_at = [*running, *[0.0] * (workers - len(running))]
    heapq.heapify(free_at)
    for length in waiting:
        heapq.heapreplace(free_at, free_at[0] + length)
    return max(free_at)


def require_space(folder: Path, size: int) -> None:
    """Refuses to begin what the disk cannot take.

    Args:
        folder: where files will be written; it need not exist yet.
        size: of the files [bytes].

    Raises:
        UserError: less than that is free.
    """
    there = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    free = shutil.disk_usage(there).free
    if size > free:
        raise UserError(
            f"{folder} needs {size_words(size)} of disk and {size_words(free)} are free; free some space, choose "
            "another folder, or record fewer particles: scene.bed.store_every=5"
        )


def duration_words(seconds: float) -> str:
    """A duration to two places at most: 40 s, 12 min, 3 h 20 min, 2 d 5 h."""
    minutes, hours = round(seconds / 60), round(seconds / 3600)
    if seconds < 99.5:
        return f"{max(1, round(seconds))} s"
    if minutes < 100:
        return f"{minutes} min"
    if hours < 48:
        return f"{minutes // 60} h {minutes % 60} min"
    return f"{hours // 24} d {hours % 24} h"


def size_words(size: float) -> str:
    """A number of bytes in decimal units, to two digits or more: 56 MB, 1.4 GB."""
    units = ["kB", "MB", "GB", "TB"]
    size /= 1000
    while size >= 999.5 and len(units) > 1:
        size /= 1000
        units.pop(0)
    return f"{size:.1f} {units[0]}" if size < 9.95 else f"{size:.0f} {units[0]}"
