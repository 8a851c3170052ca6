"""How good do surrogates become with more runs and more training?

    python experiments/paper_scale/run.py paper_excavation --runs 25 50 100 200 --seeds 0 1 2
    python experiments/paper_scale/run.py paper_excavation model.hidden_width=192 --steps 30000 --seeds 0 1 2

Trains on so many runs of a packed dataset (`reduced/<name>`), the first ones of one order drawn at random, and predicts
all of its test runs from rest. The basis is always that of all training runs. Positions count all particles; the
surface, in two measures, is compared with that of the soil decoded from all modes that are packed. A training that is
complete in `--output` is not repeated. Puts a row for each training into table.csv, in place of an equal one.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.insert(1, str(Path(__file__).resolve().parents[1]))

import numpy as np
import torch
from common import read_rows, training_settings, write_rows

from mpm_warp.poses import in_body_frame
from sgns.data.surface import SurfaceGrid, height_map, particle_spacing, surface_grid
from sgns.evaluate.command import scored
from sgns.evaluate.metrics import height_error
from sgns.evaluate.results import Scores, aggregate
from sgns.reduction.packed import packed_dataset
from sgns.reduction.reduce import ReducedDataset, ReducedRun, fitted_closure
from sgns.simulator import Simulator
from sgns.train.command import train

HERE = Path(__file__).parent
TABLE = HERE / "table.csv"
EVERY = 12  # of the frames every twelfth counts for the surface
KEYS = ("dataset", "model", "runs", "steps", "seed", "modes", "closure", "change")


def of_runs(data: ReducedDataset, count: int, settings: dict[str, Any]) -> ReducedDataset:
    """The same with so many training runs; a closure is fitted to these."""
    known = data.runs("train")
    if not 0 < count <= len(known):
        raise SystemExit(f"--runs {count}: there are {len(known)} training runs")
    order = np.random.default_rng(0).permutation(len(known))
    runs: dict[str, list[ReducedRun]] = {split: data.runs(split) for split in ("validation", "test")}
    runs["train"] = [known[i] for i in sorted(order[:count])]
    closure = (
        fitted_closure(data.basis, data.num_modes, settings, runs) if settings["closure"] != "none" else None
    )
    return replace(data, _runs=runs, closure=closure)


def filled(positions: np.ndarray, grid: SurfaceGrid, volume: float) -> np.ndarray:
    """How high the soil of a column would fill it [m], shape (nx, ny).

    Every particle (n, 3) [m] stands for so much volume [m^3], shared among the four nearest columns. The highest
    particle of a column (`height_map`) is another measure: it jumps when one particle changes columns.
    """
    shape = np.array(grid.shape)
    low = np.array([grid.x_edges[0], grid.y_edges[0]])
    edge = np.array([np.ptp(grid.x_edges), np.ptp(grid.y_edges)]) / shape
    place = np.clip((positions[:, :2] - low) / edge, 0.0, shape) - 0.5
    first = np.floor(place)
    share = place - first
    heights = np.zeros(grid.shape)
    for corner in np.ndindex(2, 2):
        column, row = np.clip(first + np.array(corner), 0, shape - 1).astype(int).T
        np.add.at(heights, (column, row), np.where(corner, share, 1.0 - share).prod(axis=1))
    return heights * volume / edge.prod()


def surfaces(simulator: Simulator, data: ReducedDataset, run: ReducedRun, latent: np.ndarray) -> np.ndarray:
    """Mean squares [m^2], (t, 4): of the surface by the highest particles, of a prediction and of soil that stays; then
    of both by how high columns are filled."""
    grid = surface_grid(data.start_positions)
    volume = particle_spacing(data.start_positions) ** 3
    measures = (lambda soil: height_map(soil, grid), lambda soil: filled(soil, grid, volume))
    found = []
    for frame in range(EVERY, len(latent), EVERY):
        true, guess = (
            basis.inverse(torch.from_numpy(modes[frame])).numpy()
            for basis, modes in ((data.basis, run.latent), (simulator.basis, latent))
        )
        found.append(
            [
                height_error(measure(soil), measure(true))
                for measure in measures
                for soil in (guess, data.start_positions)
            ]
        )
    return np.array(found)


def judged(simulator: Simulator, data: ReducedDataset) -> dict[str, Any]:
    """Errors on the test runs, from rest; time of a step and of decoding one frame on one thread."""
    scores: list[Scores] = []
    squares, step, decode = [], [], []
    for run in data.runs("test"):
        scores.append(scored(simulator, run, simulator.mean_force))
        rollout = simulator.rollout(
            run.pose, in_body_frame(run.pose[0], run.body_points[0]), values=run.scene
        )
        squares.append(surfaces(simulator, data, run, rollout.latent))
        step.append(rollout.wall_time_s / (len(run.pose) - 1))
        began = time.perf_counter()
        rollout.soil(-1)
        decode.append(time.perf_counter() - began)
    total = aggregate(scores)
    surface, still, fill, still_fill = (1e3 * np.sqrt(np.concatenate(squares).mean(axis=0))).tolist()
    force, absolute = total.force, total.force.absolute_mpe
    body = {} if math.isnan(total.sinkage_mae) else {"sinkage_mae_mm": 1e3 * total.sinkage_mae}
    return {
        "test_runs": len(scores),
        "position_rmse_mm": total.rmse_mm("total"),
        "of_it_reduction_mm": total.rmse_mm("reduction"),
        "frozen_rmse_mm": total.rmse_mm("frozen"),
        "skill_frozen": total.skill(),
        "skill_constant_velocity": total.skill("constant_velocity"),
        "surface_rmse_mm": surface,
        "still_surface_rmse_mm": still,
        "filled_rmse_mm": fill,
        "still_filled_rmse_mm": still_fill,
        **body,
        "force_nrmse": force.overall_nrmse,
        "mean_force_nrmse": total.mean_force.overall_nrmse,
        "draft_abs_mpe_percent": float(absolute[0]),
        "vertical_abs_mpe_percent": float(absolute[2]),
        "draft_mpe_percent": float(force.mpe[0]),
        "step_ms": 1e3 * float(np.median(step)),
        "decode_ms": 1e3 * float(np.median(decode)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", help="name of a folder in reduced/")
    parser.add_argument("--runs", type=int, nargs="+", default=[], help="training runs; default: all")
    parser.add_argument("--steps", type=int, default=6000, help="of the optimiser; polynomials have none")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--model", choices=["network", "polynomial"], default="network")
    parser.add_argument("--preset", default="default")
    parser.add_argument("--output", type=Path, default=Path("outputs/paper_scale"))
    parser.add_argument("--folder", type=Path, help="of the packed dataset; default: reduced/<name>")
    parser.add_argument("--table", type=Path, default=TABLE)
    parser.add_argument("change", nargs="*", help="settings of sgns train")
    given = parser.parse_intermixed_args()
    torch.set_num_threads(1)
    overrides = [f"preset={given.preset}", "dataset=quick_reduced", *given.change]
    if given.model == "polynomial":
        overrides += ["model=polynomial", "training=polynomial"]
    else:
        overrides += [f"training.max_steps={given.steps}"]
    config = training_settings(*overrides, "training.threads=1")
    reduction = config["reduction"]
    data = packed_dataset(
        given.folder or HERE.parents[1] / "reduced" / given.dataset, reduction | {"closure": "none"}
    )
    for count in given.runs or [len(data.runs("train"))]:
        some = of_runs(data, count, reduction)
        for seed in given.seeds:
            row: dict[str, Any] = {
                "dataset": given.dataset,
                "model": given.model if given.preset == "default" else f"preset={given.preset}",
                "runs": count,
                "steps": given.steps if given.model == "network" else 0,
                "seed": seed,
                "modes": reduction["num_modes"],
                "closure": reduction["closure"],
                "change": " ".join(one for one in given.change if not one.startswith("reduction.")),
            }
            name = "_".join(str(row[key]) for key in KEYS).replace(" ", "_").replace("/", "-")
            where = given.output / name
            began = time.process_time()
            train(
                some,
                num_modes=some.num_modes,
                model=config["model"],
                training=config["training"],
                output=where,
                seed=seed,
                provenance={"preset": given.preset, "dataset": given.dataset},
            )
            spent = time.process_time() - began
            summary = where / "core_seconds.json"
            if not summary.exists():
                summary.write_text(json.dumps(spent))
            row["training_core_s"] = float(json.loads(summary.read_text()))
            row |= judged(Simulator.load(where / "best.ckpt"), some)
            print({key: f"{v:.4g}" if isinstance(v, float) else v for key, v in row.items()}, flush=True)
            kept = [one for one in read_rows(given.table) if any(one[key] != str(row[key]) for key in KEYS)]
            write_rows(given.table, [*kept, row])


if __name__ == "__main__":
    main()
