"""One scene with one thread and with several, in turn.

    python experiments/speed/threads.py

Times the frames of the preset `excavation` on two grids, from the second frame on: loading kernels is not included.
Wants a machine that does nothing else. Writes threads.csv beside this script.
"""

from __future__ import annotations

import itertools
import statistics
import sys
import time
from pathlib import Path

sys.path.insert(1, str(Path(__file__).resolve().parents[1]))

from common import scene_of, write_rows

from mpm_warp import Effects, Solver
from mpm_warp.limits import usable_cores

REPEATS, FRAMES = 5, 4
SPACINGS = (0.02, 0.01333333)  # [m]


def measured(spacing: float, threads: int) -> tuple[int, float]:
    """Particles, and a step's time [s]."""
    scene, _ = scene_of("scene=excavation", f"scene.bed.spacing={spacing}")
    solver = Solver(scene, Effects(), threads=threads)
    frames = itertools.islice(solver.frames(), 2, 2 + FRAMES)
    next(frames)
    begin = time.perf_counter()
    count = sum(1 for _ in frames)
    return solver.computed_count, (time.perf_counter() - begin) / count / solver.substeps_per_frame


def main() -> None:
    counts = [1, *(n for n in (2, 4, 8) if n <= usable_cores())]
    rows = []
    for spacing in SPACINGS:
        times: dict[int, list[float]] = {threads: [] for threads in counts}
        for _, threads in itertools.product(range(REPEATS), counts):
            particles, step = measured(spacing, threads)
            times[threads].append(step)
        for threads in counts:
            ratio = statistics.median(a / b for a, b in zip(times[1], times[threads], strict=True))
            step = statistics.median(times[threads])
            rate = particles / step / 1e6
            row = {"particles": particles, "threads": threads, "step_ms": 1e3 * step, "million_per_s": rate}
            rows.append(row | {"times_faster": ratio})
            print(rows[-1], flush=True)
    write_rows(Path(__file__).parent / "threads.csv", rows, 3)


if __name__ == "__main__":
    main()
