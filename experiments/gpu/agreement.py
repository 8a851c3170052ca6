"""On a machine with a GPU: do CPU and GPU agree on every scene, and how fast is the GPU?

    python experiments/gpu/agreement.py

First every case of scenes.py on the CPU, on the GPU, and on the GPU again: agreement.csv. Then seconds per simulated
second of three scenes, 1 and 32 of each at once, beside one CPU core: speed.csv. Each table is written as far as it
goes whenever a row is added. Where there is no CUDA device the script says so and ends with status 2.

    python experiments/gpu/agreement.py --device cpu

goes through the same steps with the CPU in the GPU's place, few frames and no tables: it shows that the script works.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

sys.path.insert(1, str(Path(__file__).resolve().parents[1]))

import warp as wp
from common import scene_of, write_rows
from scenes import FARTHEST, FORCE, Case, cases, outcome

from mpm_warp import Frame, SceneError, Solver, SolverStopped, frames_together
from mpm_warp.launch import find_device
from sgns.evaluate.costs import cpu_model

HERE = Path(__file__).resolve().parent
SCENES = ("quick_excavation", "paper_excavation", "paper_wheel")
AT_ONCE = (1, 32)
Effort = tuple[int, int, int]  # frames before a timing, frames in it, and how many timings


def compared(case: Case, device: str) -> dict[str, Any]:
    """A case on the CPU and twice on the device."""
    on_cpu, one, two = (outcome(case, name) for name in ("cpu", device, device))
    row: dict[str, Any] = {"case": case.name, "scenes": len(case.scenes), "particles": case.particles}
    row["device"] = wp.get_device(device).name
    for ending, other in (("", on_cpu), ("_again", two)):
        row["farthest" + ending], row["rms" + ending] = one.moved_apart(other)
        row["force" + ending] = one.pushed_apart(other)
    row["agrees"] = row["farthest"] < FARTHEST and row["force"] < FORCE
    return row


def stretches(frames: Iterator[Any], at_once: int, effort: Effort) -> list[float]:
    """Seconds that a frame takes, for `at_once` scenes together, once warm."""
    warm, count, timings = effort
    list(islice(frames, warm * at_once))
    found = []
    for _ in range(timings):
        begin = time.perf_counter()
        for _, frame in islice(frames, count * at_once):
            if not isinstance(frame, Frame):
                raise frame
        found.append((time.perf_counter() - begin) / count)
    return found


def timed(name: str, device: str, at_once: int, effort: Effort) -> dict[str, Any]:
    """How fast a device computes `at_once` scenes of one kind; each frame is brought to the host."""
    scene, effects = scene_of(f"scene={name}")
    frames = frames_together([scene] * at_once, effects, device, at_once=at_once)
    seconds = [s * scene.frame_rate for s in stretches(frames, at_once, effort)]
    frames.close()
    solver = Solver(scene, effects)
    steps = solver.computed_count * solver.substeps_per_frame * scene.frame_rate * at_once
    middle = statistics.median(seconds)
    return {
        "scene": name,
        "device": wp.get_device(device).name if device != "cpu" else f"{cpu_model()}, one core",
        "at_once": at_once,
        "computed_particles": solver.computed_count,
        "steps_per_simulated_s": solver.substeps_per_frame * scene.frame_rate,
        "s_per_simulated_s": middle,
        "least": min(seconds),
        "most": max(seconds),
        "s_per_scene_and_simulated_s": middle / at_once,
        "particle_steps_per_s": steps / middle,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cuda", help="in place of which device; cpu writes no tables")
    parser.add_argument("--part", choices=("agreement", "speed"), help="only this one")
    parser.add_argument("--only", default="", help="cases and scenes with this in their name")
    options = parser.parse_args()
    find_device("cpu")
    if options.device != "cpu" and not wp.is_cuda_available():
        print("nothing was measured: there is no CUDA device here")
        return 2
    for_show = options.device == "cpu"
    begin, apart = time.perf_counter(), []

    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for case in cases(Path(folder)) if options.part != "speed" else ():
            if options.only not in case.name:
                continue
            try:
                row = compared(case, options.device)
            except (SceneError, SolverStopped, RuntimeError) as error:  # the other cases are of use, too
                apart.append(case.name)
                print(f"{case.name}: {error}", flush=True)
                continue
            rows.append(row)
            if not row["agrees"]:
                apart.append(case.name)
            print(f"{time.perf_counter() - begin:4.0f} s  {row}", flush=True)
            if not for_show:
                write_rows(HERE / "agreement.csv", rows)

    rows = []
    for name in SCENES if options.part != "agreement" else ():
        for device, at_once in (("cpu", 1), *((options.device, number) for number in AT_ONCE)):
            if options.only not in name:
                continue
            effort = (1, 1, 2) if for_show else (2, 2, 3) if device == "cpu" else (5, 4, 5)
            rows.append(timed(name, device, 2 if for_show and at_once > 1 else at_once, effort))
            print(f"{time.perf_counter() - begin:4.0f} s  {rows[-1]}", flush=True)
            if not for_show:
                write_rows(HERE / "speed.csv", rows)
    print(f"{len(apart)} cases disagree {apart or ''}")
    return 1 if apart else 0


if __name__ == "__main__":
    sys.exit(main())
