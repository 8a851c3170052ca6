"""What the guard costs: checks at a frame and the copy of the last good state, over the time of a frame.

python experiments/stability/cost.py
"""

from __future__ import annotations

import time

from mpm_warp import Bed, Excavation, Solver

REPEATS = 50


def main() -> None:
    solver = Solver(Excavation(bed=Bed(spacing=0.04 / 3.0), duration=0.1))
    frames = solver.frames()
    next(frames)
    start, count = time.perf_counter(), 0
    for _ in frames:
        count += 1
    frame = (time.perf_counter() - start) / count
    start = time.perf_counter()
    for _ in range(REPEATS):
        solver._check(count)
        solver._memory.keep(count)
    guard = (time.perf_counter() - start) / REPEATS
    print(
        f"{solver.particle_count} particles: a frame {1e3 * frame:.0f} ms, the guard {1e3 * guard:.2f} ms of it, "
        f"{100 * guard / frame:.2f} %"
    )


if __name__ == "__main__":
    main()
