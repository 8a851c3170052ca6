"""mpm_warp beside Taichi's MLS-MPM and Newton's implicit MPM, and how cost grows with the number of particles.

    python experiments/throughput/run.py --taichi-python other/bin/python --newton-python other/bin/python

Every solver runs in a process of its own, bound to one core, warm, in turn; a row is the median over all repeats. A
package that the named Python does not have gives a row "not measured". Writes table.csv and
growth.png beside this script. The clock is the processor time of each process: wall time, if its core is idle.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

sys.path.insert(1, str(Path(__file__).resolve().parents[1]))

import matplotlib.pyplot as plt
import ours
from common import write_rows

from sgns.evaluate.costs import cpu_model

HERE = Path(__file__).parent
PAPER = 30_000  # asked for; the lattice of the paper's bin at 13.3 mm has 29 700
SIZES = (1_000, 10_000, 100_000, 1_000_000)
NEWTON_SIZES = (1_000, 10_000)
MISSING = "not measured"
COLUMNS = "solver what particles M_steps_per_s min max s_per_simulated_s repeats version machine".split()


def child(python: str, script: str, *options: object) -> dict | None:
    """The JSON a solver prints, or nothing where its package is missing."""
    command = [python, str(HERE / script), *(str(o) for o in options)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        if "ModuleNotFoundError" in last or "ImportError" in last:
            return None
        raise SystemExit(f"{script} failed: {last}")
    return json.loads(done.stdout.strip().splitlines()[-1])


def summary(solver: str, what: str, asked: int, results: list[dict | None]) -> dict[str, object]:
    """One row of the table from all repeats of a measurement."""
    row = dict.fromkeys(COLUMNS, MISSING) | {"solver": solver, "what": what, "particles": asked}
    if None in results:
        return row
    row |= dict.fromkeys(("M_steps_per_s", "min", "max"), "")  # implicit steps are not comparable
    row |= {"particles": results[0]["particles"], "version": results[0]["version"], "repeats": len(results)}
    row["machine"] = f"one core of {cpu_model()}"
    rates = [rate for result in results for rate in result.get("rates", [])]
    costs = [cost for result in results for cost in result.get("s_per_simulated_s", [])]
    if rates:
        median = statistics.median(rates)
        row["M_steps_per_s"], row["min"], row["max"] = (
            f"{r / 1e6:.3g}" for r in (median, min(rates), max(rates))
        )
        row["s_per_simulated_s"] = f"{row['particles'] / (ours.time_step(asked) * median):.3g}"
    if costs:
        row["s_per_simulated_s"] = f"{statistics.median(costs):.3g}"
    return row


def draw(rows: list[dict[str, object]]) -> None:
    """Growth of the rate and of the time per simulated second with the number of particles."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    for solver in dict.fromkeys(row["solver"] for row in rows):
        for axis, key in zip(axes, ("M_steps_per_s", "s_per_simulated_s"), strict=True):
            points = [
                (int(row["particles"]), float(row[key]))
                for row in rows
                if row["solver"] == solver and row[key] not in (MISSING, "")
            ]
            if points:
                axis.plot(*zip(*points, strict=True), "o-", label=solver)
    axes[0].set(xscale="log", xlabel="particles", ylabel="million particle-steps per second", ylim=(0, None))
    axes[1].set(xscale="log", yscale="log", xlabel="particles", ylabel="seconds per simulated second")
    axes[1].legend()
    figure.savefig(HERE / "growth.png", dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--taichi-python", default=sys.executable, help="Python with taichi and numpy")
    parser.add_argument("--newton-python", default=sys.executable, help="Python with newton and numpy")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=5.0, help="of timing per repeat, except for Newton")
    options = parser.parse_args()
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    budget = "--seconds", options.seconds
    with tempfile.TemporaryDirectory() as temporary:
        files = {size: Path(temporary) / f"{size}.npz" for size in (PAPER, *SIZES)}
        for size, file in files.items():
            ours.write_case(file, size)

        def mpm_warp(particles: int, *more: str) -> dict | None:
            return child(sys.executable, "ours.py", "--particles", particles, *budget, *more)

        def taichi(particles: int, *more: str) -> dict | None:
            return child(options.taichi_python, "taichi_mpm.py", files[particles], *budget, *more)

        def newton(particles: int, *more: object) -> dict | None:
            return child(options.newton_python, "newton_mpm.py", files[particles], *more)

        bed, limited = "bed at rest, constant friction", "blade, at most {} iterations a step (its {})"
        compared = [
            ("mpm_warp", "blade, mu(I), contact, frames copied", partial(mpm_warp, PAPER, "--blade")),
            ("mpm_warp", f"{bed}, frames copied", partial(mpm_warp, PAPER)),
            ("Taichi MLS-MPM", f"{bed}, plain sums", partial(taichi, PAPER)),
            ("Taichi MLS-MPM", f"{bed}, atomic sums", partial(taichi, PAPER, "--atomic")),
            ("Taichi MLS-MPM", f"{bed}, SVD, plain sums", partial(taichi, PAPER, "--law", "svd")),
            ("Newton implicit MPM", limited.format(250, "default"), partial(newton, PAPER)),
            (
                "Newton implicit MPM",
                limited.format(50, "examples"),
                partial(newton, PAPER, "--iterations", 50),
            ),
        ]
        found: list[list[dict | None]] = [[] for _ in compared]
        for _ in range(options.repeats):
            for results, (_, _, measure) in zip(found, compared, strict=True):
                results.append(measure())
        rows = [summary(*entry[:2], PAPER, results) for entry, results in zip(compared, found, strict=True)]
        grown = []
        for size in SIZES:
            grown.append(summary("mpm_warp", f"growth: {bed}, frames copied", size, [mpm_warp(size)]))
            grown.append(summary("Taichi MLS-MPM", f"growth: {bed}, plain sums", size, [taichi(size)]))
            if size in NEWTON_SIZES:
                what = "growth: blade, at most 50 iterations a step"
                grown.append(summary("Newton implicit MPM", what, size, [newton(size, "--iterations", 50)]))
    draw(grown)
    write_rows(HERE / "table.csv", rows + grown)
    for row in rows + grown:
        print(*(row[key] for key in (*COLUMNS[:4], "s_per_simulated_s")), sep="  ")


if __name__ == "__main__":
    main()
