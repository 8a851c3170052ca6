"""The presets on the runs that the paper's authors published, every run predicted by networks that have not seen it.

    python experiments/published_data/run.py <folder with excavation/ and wheel/> --seconds 120

Four folds; in each every preset is trained on the other runs for the same wall time on one thread, its learning rate
falling over as many steps as fit into that time. Writes table.csv (a row per run and preset, and one for all) and
figure.png beside this script; a training that is complete in `--output` is not repeated.
"""

from __future__ import annotations

import argparse
import json
import logging
import multiprocessing
import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.insert(1, str(Path(__file__).resolve().parents[1]))

import matplotlib.pyplot as plt
import numpy as np
import torch
from common import training_settings, write_rows

from sgns.evaluate.command import scored
from sgns.evaluate.results import aggregate
from sgns.reduction.published import published_dataset
from sgns.reduction.reduce import ReducedDataset, ReducedRun
from sgns.rollout import single_thread
from sgns.simulator import Simulator
from sgns.train.command import train

HERE = Path(__file__).parent
FOLDS = 4
KINDS = ("excavation", "wheel")
PRESETS = ("paper", "released", "default")
WARM_UP = 60  # steps that tell how long one takes


def trained(
    config: dict[str, Any], data: ReducedDataset, label: dict[str, str], seconds: float, output: Path
) -> float:
    """Train for about so many seconds; returns the seconds it took."""
    # The last checkpoint is judged, so that nothing is to be chosen: validation is kept short.
    runs = {split: data.runs(split) for split in ("train", "test")}
    data = replace(data, _runs=runs | {"validation": [shortened(runs["train"][0], 20)]})

    def run(steps: int, where: Path) -> float:
        torch.manual_seed(0)
        training = config["training"] | {"max_steps": steps, "validate_every": steps, "resume": False}
        training["warmup_steps"] = min(training["warmup_steps"], steps // 10)
        modes, model = config["reduction"]["num_modes"], config["model"]
        train(data, num_modes=modes, model=model, training=training, output=where, provenance=label)
        return seconds_of(where)

    trial = output.with_name(f"{output.name}_trial")
    run(2, trial)
    short = run(2, trial)
    rate = WARM_UP / max(run(WARM_UP + 2, trial) - short, 1e-3)
    return run(max(50, int(seconds * rate)), output)


def seconds_of(training: Path) -> float:
    """That a complete training took."""
    return float(json.loads((training / "training.json").read_text())["seconds"])


def shortened(run: ReducedRun, frames: int) -> ReducedRun:
    """The first frames of a run."""
    series = ("latent", "time", "pose", "body_points", "force", "torque")
    return replace(run, **{name: getattr(run, name)[:frames] for name in series})


def fold_rows(task: tuple[str, str, int, Path, float, Path, list[str]]) -> list[dict[str, Any]]:
    """One preset on one fold of one kind."""
    preset, kind, fold, folder, seconds, output, overrides = task
    torch.set_num_threads(1)
    where = output / f"{kind}_{preset}_{fold}"
    published = ["dataset=published", f"dataset.path={folder / kind}"]
    published += [f"dataset.folds={FOLDS}", f"dataset.fold={fold}", "training.threads=1"]
    config = training_settings(f"preset={preset}", *published, *overrides)
    data = published_dataset(config["dataset"], config["reduction"]["num_modes"])
    if not (where / "training.json").exists():
        trained(config, data, {"preset": preset, "dataset": f"published {kind}"}, seconds, where)
    simulator = Simulator.load(where / "last.ckpt")
    rows = []
    with single_thread():
        for run in data.runs("test"):
            began = time.perf_counter()
            scores = scored(simulator, run, simulator.mean_force)
            took = time.perf_counter() - began
            training = simulator.card["settings"]["training"]
            rows.append({"kind": kind, "preset": preset, "scores": scores, "rollout_s": took})
            rows[-1] |= {"training_s": seconds_of(where), "steps": training["max_steps"]}
            rows[-1]["samples"] = training["max_steps"] * training["batch_size"]
    return rows


def table_row(kind: str, preset: str, scores: Any, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """The paper's columns, and beside them skill, baselines and unsigned errors."""
    force = scores.force
    row = {"kind": kind, "preset": preset, "run": scores.name}
    for name, key in (("mse", "network"), ("frozen", "frozen"), ("constant_velocity", "constant_velocity")):
        row[f"{name}_1e-4_m2"] = 1e4 * float(scores.mse[key])
    row |= {
        "skill_frozen": float(scores.skill()),
        "skill_constant_velocity": float(scores.skill("constant_velocity")),
        "forward_mpe_percent": float(force.mpe[0]),
        "vertical_mpe_percent": float(force.mpe[2]),
        "forward_abs_mpe_percent": float(force.absolute_mpe[0]),
        "vertical_abs_mpe_percent": float(force.absolute_mpe[2]),
        "forward_mae_N": float(force.mae[0]),
        "vertical_mae_N": float(force.mae[2]),
        "force_nrmse": float(force.overall_nrmse),
        "mean_force_nrmse": float(scores.mean_force.overall_nrmse),
    }
    row |= {key: float(np.mean([one[key] for one in rows])) for key in ("training_s", "steps", "samples")}
    return row | {"rollout_s": float(np.median([one["rollout_s"] for one in rows]))}


def draw(rows: list[dict[str, Any]]) -> None:
    """Skill and force error of every run."""
    panels = (("skill_frozen", "skill against frozen (cut at -1)"), ("force_nrmse", "force NRMSE (cut at 2)"))
    figure, axes = plt.subplots(2, 2, figsize=(10, 6.4), layout="constrained")
    for line, kind in zip(axes, KINDS, strict=True):
        for axis, (key, label) in zip(line, panels, strict=True):
            for shift, preset in enumerate(PRESETS):
                found = [
                    r for r in rows if (r["kind"], r["preset"]) == (kind, preset) and r["run"] != "all runs"
                ]
                at = np.arange(len(found)) + 0.26 * (shift - 1)
                axis.bar(at, np.clip([r[key] for r in found], -1.0, 2.0), 0.24, label=preset)
            if key == "force_nrmse":
                mean = np.clip([r["mean_force_nrmse"] for r in found], -1.0, 2.0)
                axis.plot(range(len(found)), mean, "k_", ms=14, label="mean force")
            axis.set_xticks(range(len(found)), [r["run"].split("_")[-1] for r in found], fontsize=8)
            axis.set_title(f"{kind}: {label}", fontsize=10)
            axis.axhline(0.0, color="0.3", lw=0.8)
            axis.grid(alpha=0.3, axis="y")
    axes[0, 1].legend(fontsize=8)
    figure.savefig(HERE / "figure.png", dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("published", type=Path, help="folder with the authors' excavation/ and wheel/")
    parser.add_argument("--seconds", type=float, default=120.0, help="training time of each network")
    parser.add_argument("--workers", type=int, default=max(1, (os.cpu_count() or 2) - 1))
    parser.add_argument("--output", type=Path, default=Path("outputs/published_data"))
    parser.add_argument("overrides", nargs="*", help="changes of the settings, for example model.history=2")
    options = parser.parse_intermixed_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    tasks = [
        (preset, kind, fold, options.published, options.seconds, options.output, options.overrides)
        for kind in KINDS
        for preset in PRESETS
        for fold in range(FOLDS)
    ]
    with multiprocessing.get_context("spawn").Pool(options.workers) as pool:
        found = [row for rows in pool.map(fold_rows, tasks, chunksize=1) for row in rows]
    rows = []
    for kind in KINDS:
        for preset in PRESETS:
            own = [row for row in found if (row["kind"], row["preset"]) == (kind, preset)]
            own.sort(key=lambda row: row["scores"].name)
            rows += [table_row(kind, preset, row["scores"], [row]) for row in own]
            rows.append(table_row(kind, preset, aggregate([row["scores"] for row in own]), own))
            logging.info("%s", rows[-1])
    write_rows(HERE / "table.csv", rows, digits=6)
    draw(rows)


if __name__ == "__main__":
    main()
