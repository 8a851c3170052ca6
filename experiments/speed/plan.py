"""How long does a planner wait for one step, and for many paths from where the tool is?

    python experiments/speed/plan.py

The network that ships, on one thread. Steps and whole paths take turns; their processor time is compared. Waiting times
are wall clock, with whatever else the machine does. Writes plan.csv and plan.png beside this script.
"""

from __future__ import annotations

import runpy
import sys
import time
from pathlib import Path

sys.path.insert(1, str(Path(__file__).resolve().parents[1]))

import matplotlib.pyplot as plt
import numpy as np
import torch
from common import write_rows

from mpm_warp import Scene
from sgns import Simulator
from sgns.numbers import counted

HERE = Path(__file__).parent
ROUNDS, COUNTS = 15, (1, 10, 100, 1000)


def in_turn(simulator: Simulator, path: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Waiting time of every step [s]; processor time of a frame stepped and rolled out, medians [s]."""
    waits, stepped, rolled = [], [], []
    for _ in range(ROUNDS):
        simulator.reset(path)
        begin = time.process_time()
        for pose in path[1:]:
            began = time.perf_counter()
            simulator.step(pose)
            waits.append(time.perf_counter() - began)
        stepped.append((time.process_time() - begin) / (len(path) - 1))
        begin = time.process_time()
        simulator.rollout(path)
        rolled.append((time.process_time() - begin) / (len(path) - 1))
    return np.array(waits), float(np.median(stepped)), float(np.median(rolled))


def main() -> None:
    torch.set_num_threads(1)
    simulator = Simulator.pretrained("excavation")
    path = Scene.from_dict(simulator.scene).body_poses()
    waits, stepped, rolled = in_turn(simulator, path)
    rows: list[dict[str, object]] = [
        {"what": f"wait for a step, {q} % are shorter", "ms": 1e3 * np.quantile(waits, q / 100)}
        for q in (50, 95, 99, 99.9)
    ]
    rows += [
        {"what": "processor time of a step", "ms": 1e3 * stepped},
        {"what": "processor time of a frame of a rollout", "ms": 1e3 * rolled},
        {"what": "step / frame of a rollout", "ms": stepped / rolled},
    ]
    simulator.reset(path)
    for pose in path[1:61]:
        simulator.step(pose)
    here = simulator.save()
    for count in COUNTS:
        paths = np.tile(path[60:121], (count, 1, 1))
        simulator.rollouts(paths[:, :2], start=here)
        begin = time.process_time()
        simulator.rollouts(paths, start=here)
        rows.append(
            {"what": f"{counted(count, 'path')} of 60 frames", "ms": 1e3 * (time.process_time() - begin)}
        )
    write_rows(HERE / "plan.csv", rows, 3)
    for row in rows:
        print(*row.values())

    plan = runpy.run_path(str(HERE.parents[1] / "examples" / "plan_from_here.py"))
    figure, (left, right) = plt.subplots(1, 2, figsize=(8.4, 2.9), layout="constrained")
    x, z = 100 * plan["paths"][:, :, 0].T, 100 * plan["paths"][:, :, 2].T
    shown = plt.Normalize(0.0, np.quantile(plan["work"], 0.95))
    for i in np.argsort(plan["known"]):
        colour = plt.cm.viridis(shown(plan["work"][i])) if plan["known"][i] else "0.85"
        left.plot(x[:, i], z[:, i], color=colour, linewidth=0.7)
    best = plan["best"]
    left.plot(x[:, best], z[:, best], color="tab:red", linewidth=2.0, label="most soil per joule")
    left.set(
        xlabel="x of the blade's centre [cm]", ylabel="z [cm]", title="200 ways to go on; grey: not known"
    )
    left.legend(loc="lower left", fontsize=8)
    figure.colorbar(plt.cm.ScalarMappable(shown, "viridis"), ax=left, label="work [J]")
    right.hist(1e3 * waits, np.linspace(0.0, 1e3 * np.quantile(waits, 0.995), 60), color="tab:blue")
    for q, style in ((50, "-"), (95, "--"), (99, ":")):
        at = 1e3 * np.quantile(waits, q / 100)
        right.axvline(at, color="k", linestyle=style, linewidth=1.0, label=f"{q} %: {at:.2f} ms")
    right.set(xlabel="wait for a step [ms]", yticks=[], title=f"{len(waits)} steps on one thread")
    right.legend(fontsize=8)
    figure.savefig(HERE / "plan.png", dpi=100)


if __name__ == "__main__":
    main()
