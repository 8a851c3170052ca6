"""Solver and surrogate at the paper's scale, timed in turn on the same core in one process.

    python experiments/speed/run.py

Times the paper's excavation scene (29 700 particles, E = 1 MPa) with the solver, and the same tool path with a network
of default size and 8 modes whose basis was fitted on a short run of that bed. The network is trained for a few steps
only: its speed does not depend on how good it is. Writes table.csv and bars.png beside this script.
"""

from __future__ import annotations

import logging
import os
import statistics
import sys
import tempfile
from pathlib import Path

sys.path.insert(1, str(Path(__file__).resolve().parents[1]))

import matplotlib.pyplot as plt
import torch
from common import composed, training_settings, write_rows
from omegaconf import OmegaConf

from sgns.data.dataset import Dataset
from sgns.evaluate.costs import cpu_model
from sgns.reduction.reduce import reduce_dataset
from sgns.rollout import rollout_scene
from sgns.simulate.campaign import plan
from sgns.simulate.command import simulate_campaign, simulate_scene
from sgns.simulate.scene import asked_effects, decided, scene_from_config
from sgns.simulator import Simulator
from sgns.train.command import train

HERE = Path(__file__).parent
REPEATS = 3  # of the solver's run


def make_simulator(config, folder: Path) -> Simulator:
    """A network of default size on the paper's bed."""
    short = OmegaConf.to_container(config.scene, resolve=True)
    short |= {"material": OmegaConf.to_container(config.material), "duration": 0.25}
    settings = {"name": "speed", "path": folder / "data", "draw": {"depth": [0.03, 0.05, 0.08]}}
    campaign = plan(settings, short, asked_effects(config), "float32", seed=0)
    simulate_campaign(campaign, device="cpu", workers=1)
    learning = training_settings("training.max_steps=20")
    reduced = reduce_dataset(Dataset.open(campaign.path), learning["reduction"], progress=False)
    settings = {key: learning[key] for key in ("model", "training")}
    train(reduced, num_modes=8, **settings, output=folder / "training")
    return Simulator.load(folder / "training" / "best.ckpt")


def main() -> None:
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    torch.set_num_threads(1)
    cut = ("scene.depth=0.08", "scene.speed=0.10", "scene.rake=10")
    config = composed("simulate", "scene=paper_excavation", *cut)
    scene = scene_from_config(config)
    effects, _ = decided(scene, asked_effects(config))
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        simulator = make_simulator(config, folder)
        rollout_scene(simulator, scene, folder / "warm.h5")
        solver, inference, complete, rates = [], [], [], []
        for _ in range(REPEATS):
            timing = simulate_scene(scene, folder / "truth.h5", effects=effects)
            solver.append(timing.per_simulated_second)
            rates.append(timing.rate)
            # Three rollouts for each solver run: they are short, and their median is what counts.
            for _ in range(3):
                rollout = rollout_scene(simulator, scene, folder / "rollout.h5")
                inference.append(rollout.inference_rate)
                complete.append(rollout.complete_rate)
    reference = statistics.median(solver)
    rows = []
    for what, included, values in (
        ("solver", "all substeps, frames written", solver),
        ("surrogate with soil", "steps with force, every frame decoded and written", complete),
        ("surrogate", "steps with force and torque", inference),
    ):
        median = statistics.median(values)
        rows.append(
            {
                "what": what,
                "included": included,
                "s_per_simulated_s": median,
                "min": min(values),
                "max": max(values),
                "repeats": len(values),
                "times_faster_than_solver": reference / median,
                "machine": f"one core of {cpu_model()}",
            }
        )
    write_rows(HERE / "table.csv", rows)
    figure, axis = plt.subplots(figsize=(7, 2.2), layout="constrained")
    names, times = [r["what"] for r in rows], [r["s_per_simulated_s"] for r in rows]
    bars = axis.barh(names, times, color=["0.3", "C0", "C0"])
    axis.bar_label(bars, [f" {t:.3g} s" for t in times])
    axis.axvline(1.0, color="C3", ls="--", lw=1)
    axis.text(1.05, 2.35, "real time", color="C3", fontsize=8, va="top")
    axis.set(xscale="log", xlabel="wall seconds per simulated second, one core", xlim=(None, 4 * max(times)))
    axis.invert_yaxis()
    figure.savefig(HERE / "bars.png", dpi=130)
    for row in rows:
        print(
            row["what"], f"{row['s_per_simulated_s']:.4g}", f"{row['times_faster_than_solver']:.4g}", sep="  "
        )
    print(f"solver: {statistics.median(rates) / 1e6:.2f} M particle-steps/s")


if __name__ == "__main__":
    main()
