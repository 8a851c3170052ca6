"""Our incremental PCA beside scikit-learn's: time, memory and subspace at 27 000 particles and 256 modes, on one core.

    python experiments/reduction/speed.py data/quick

Frames of a campaign are read batch by batch, widened to 27 000 particles with particles of another of its runs.
Every row of speed.csv is a process of its own, one after the other on the same core; reading is not timed. Angles
are with the exact subspace of the same frames, from one eigendecomposition in float64.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}

import numpy as np
import torch

from sgns.data.dataset import Dataset
from sgns.data.run import Run
from sgns.evaluate.costs import cpu_model
from sgns.reduction.pca import IncrementalPCA

HERE = Path(__file__).parent
PARTICLES, MODES, BATCH = 27_000, 256, 96
COMPARED = (8, 64, 200, 256)
METHODS = ("sgns", "scikit-learn float64", "scikit-learn float32")


def batches(folder: str, run_count: int) -> Iterator[np.ndarray]:
    """Positions [m], (96, 27 000, 3) float32, of `run_count` runs; after the last the first again."""
    paths = [Path(path) for path in Dataset.open(folder).runs("train")]
    waiting = np.empty((0, PARTICLES, 3), np.float32)
    for i in range(run_count):
        # Steps of 7 so that even a few runs differ in rake, depth and speed.
        with Run(paths[7 * i % len(paths)]) as run, Run(paths[(7 * i + 3) % len(paths)]) as other:
            extra = PARTICLES - run.particle_count
            frames = slice(0, min(run.frame_count, other.frame_count))
            wide = np.concatenate([run.positions(frames), other.positions(frames)[:, :extra]], axis=1)
        waiting = np.concatenate([waiting, wide])
        while len(waiting) >= BATCH:
            yield waiting[:BATCH]
            waiting = waiting[BATCH:]


def rows_of(batch: np.ndarray, dtype: type) -> np.ndarray:
    """Rows (frame, axis), columns particles."""
    return batch.transpose(0, 2, 1).reshape(-1, batch.shape[1]).astype(dtype)


def estimator(method: str) -> tuple[Callable[[np.ndarray], object], Callable[[], np.ndarray]]:
    """What takes a batch, and what gives the modes (n, 256) at the end."""
    if method == "sgns":
        ours = IncrementalPCA(MODES)
        return ours.partial_fit, lambda: ours.basis("particle").modes.numpy()
    from sklearn.decomposition import IncrementalPCA as Theirs

    dtype = np.float32 if method.endswith("32") else np.float64
    theirs = Theirs(MODES, copy=False)
    return lambda batch: theirs.partial_fit(rows_of(batch, dtype)), lambda: theirs.components_.T


def measure(method: str, folder: str, run_count: int, out: str) -> None:
    """One process: fit, and print times [s] and memory [MB] as JSON."""
    torch.set_num_threads(1)
    take, modes = estimator(method)
    wall = cpu = 0.0
    count = 0
    for batch in batches(folder, run_count):
        count += 1
        began, began_cpu = time.perf_counter(), time.process_time()
        take(batch)
        wall += time.perf_counter() - began
        cpu += time.process_time() - began_cpu
    began, began_cpu = time.perf_counter(), time.process_time()
    found = modes()
    wall += time.perf_counter() - began
    cpu += time.process_time() - began_cpu
    np.save(out, found)
    # Not getrusage: its peak counts the memory of the process that started this one.
    status = Path("/proc/self/status").read_text()
    peak = int(status.split("VmHWM:")[1].split()[0]) / 1024
    print(json.dumps({"frames": count * BATCH, "wall_s": wall, "cpu_s": cpu, "peak_rss_mb": peak}))


def exact(folder: str, run_count: int) -> np.ndarray:
    """The leading modes (n, 256) of the same rows, centred per particle."""
    x = np.concatenate([rows_of(batch, np.float64) for batch in batches(folder, run_count)])
    x -= x.mean(0)
    _, vectors = np.linalg.eigh(x @ x.T)
    return np.linalg.qr(x.T @ vectors[:, : -MODES - 1 : -1])[0]


def angle(true: np.ndarray, found: np.ndarray) -> float:
    """Sine of the largest angle between subspaces of orthonormal columns."""
    found = found.astype(np.float64)
    return float(np.linalg.norm(found - true @ (true.T @ found), 2))


def measured(method: str, folder: str, run_count: int, out: Path) -> dict[str, float]:
    """`measure` in a process of its own."""
    command = [
        sys.executable,
        __file__,
        folder,
        "--method",
        method,
        "--runs",
        str(run_count),
        "--out",
        str(out),
    ]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return json.loads(said.splitlines()[-1])


def write(rows: list[dict[str, object]]) -> None:
    """speed.csv, complete after every row."""
    with (HERE / "speed.csv").open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, rows[0])
        writer.writeheader()
        writer.writerows(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", nargs="?", default="data/quick", help="folder of a complete campaign")
    parser.add_argument("--runs", type=int, default=4, help="runs for the comparison with the exact subspace")
    # scikit-learn takes several minutes for the first of these; only ours goes on.
    parser.add_argument("--long", type=int, nargs="*", default=[16, 64], help="runs for time and memory")
    parser.add_argument("--method", choices=METHODS, help=argparse.SUPPRESS)
    parser.add_argument("--out", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.method:
        measure(options.method, options.dataset, options.runs, options.out)
        return
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        true = exact(options.dataset, options.runs)
        plan = [(m, options.runs) for m in METHODS]
        plan += [(m, n) for n in options.long[:1] for m in METHODS[:2]]  # side by side, as the first three
        plan += [("sgns", n) for n in options.long[1:]]
        for method, runs in plan:
            out = Path(temporary) / "modes.npy"
            load = os.getloadavg()[0]
            found = measured(method, options.dataset, runs, out)
            row = {"method": method, "runs": runs, "frames": found["frames"]}
            row |= {key: f"{found[key]:.2f}" for key in ("wall_s", "cpu_s")}
            row["cpu_s_per_96_frames"] = f"{found['cpu_s'] * BATCH / found['frames']:.3f}"
            row["peak_rss_mb"] = f"{found['peak_rss_mb']:.0f}"
            for r in COMPARED:
                row[f"angle_{r}"] = (
                    f"{angle(true[:, :r], np.load(out)[:, :r]):.1e}" if runs == options.runs else ""
                )
            row |= {"load": f"{load:.1f}", "machine": f"one core of {cpu_model()}"}
            rows.append(row)
            print(row, flush=True)
            write(rows)


if __name__ == "__main__":
    main()
