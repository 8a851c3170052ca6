"""How far soil depends on the pace of a cut: the solver's between 4 and 15 cm/s, and that of slow rollouts.

    python experiments/stability/paces.py

Writes paces.csv beside this script: differences of the soil at one place of the tool, in shares of its movement up to
there. Needs the runs of `sgns simulate dataset=quick`; the network is that of run.py.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path

import numpy as np
from hard_cases.networks import quick_data, quick_network
from hard_cases.rollout import moved, slowed

from sgns.reduction.reduce import ReducedRun
from sgns.simulator import Simulator

HERE = Path(__file__).resolve().parent
TIMES = (1, 2, 3, 5, 10, 30)


def share(simulator: Simulator, latent: np.ndarray, end: np.ndarray) -> float:
    """RMS difference of a state (r, 3) from the last of some others (T, r, 3), in shares of their movement."""
    return float(moved(simulator, np.stack([latent[-1], end]))[1] / moved(simulator, latent)[-1])


def same_way(a: ReducedRun, b: ReducedRun) -> bool:
    """Whether two cuts differ in their speed only."""
    return all(a.scene[key] == b.scene[key] for key in ("motion", "rake", "depth"))


def of_the_solver(simulator: Simulator) -> Iterator[list[str]]:
    """Pairs of cuts along one way, where the slower one ends or the faster one stops."""
    runs = [run for split in ("train", "validation", "test") for run in quick_data().runs(split)]
    runs = sorted(runs, key=lambda run: run.scene["speed"])
    for slow, fast in combinations(runs, 2):
        if not same_way(slow, fast):
            continue
        place = min(slow.pose[:, 0].max(), fast.pose[:, 0].max())
        i, j = (int((run.pose[:, 0] >= place - 1e-6).argmax()) for run in (slow, fast))
        scene = slow.scene
        cut = f"{scene['motion']}, rake {scene['rake']:g}, depth {scene['depth']:g} m"
        difference = share(simulator, slow.latent[: i + 1], fast.latent[j])
        yield ["solver", cut, f"{scene['speed']:g} and {fast.scene['speed']:g} m/s", f"{difference:.3f}", ""]


def of_rollouts() -> Iterator[list[str]]:
    """The test runs so many times as slow, against the runs as they were: mean and worst."""
    simulators = [Simulator.load(quick_network(), rate_independent=follows) for follows in (True, False)]
    for times in TIMES:
        for run in quick_data().runs("test"):
            found = [
                share(
                    s,
                    run.latent[:, : s.num_modes],
                    s.rollout(slowed(run.pose, times), values=run.scene).latent[-1],
                )
                for s in simulators
            ]
            yield ["rollout", run.name, f"{times} times as slow", *(f"{each:.3f}" for each in found)]


def main() -> None:
    rows = [*of_the_solver(Simulator.load(quick_network())), *of_rollouts()]
    with (HERE / "paces.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["of", "cut", "pace", "difference", "difference with rate_independent=false"])
        writer.writerows(rows)
    print((HERE / "paces.csv").read_text())


if __name__ == "__main__":
    main()
