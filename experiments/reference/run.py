"""What is true: one cut and one wheel at many settings of the solver, as convergence tables and figures.

    python experiments/reference/run.py [--workers 2]

Every finished run is kept as a line of cut.csv or wheel.csv and is not made again. The figures are drawn from the
tables (`--draw` does nothing else).
"""

from __future__ import annotations

import argparse
import logging
import multiprocessing
import re
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

sys.path.insert(1, str(Path(__file__).resolve().parents[1]))

import matplotlib.pyplot as plt
import numpy as np
from common import composed, read_rows, write_rows

from mpm_warp import Effects, Solver
from sgns.simulate.scene import scene_from_config

HERE = Path(__file__).parent
DX = {"20": 0.02, "13.3": 0.8 / 60, "10": 0.01, "6.7": 0.8 / 120}

CUT = ["scene=excavation", "scene.depth=0.08", "scene.duration=2.0"]
WHEEL = ["scene=wheel", "scene.duration=3.0"]
BASE = {
    "cut": "dx 13.3, 4 per cell, margin -0.375",  # what the changes are made to
    "wheel": "dx 13.3, 4 per cell, margin -0.25",
}
QUANTITIES = {
    "cut": {
        "draft": "draft, mean of 2 s [N]",
        "draft_second_half": "draft, second half [N]",
        "vertical": "vertical force [N]",
    },
    "wheel": {"sinkage_mm": "sinkage [mm]", "drawbar_pull": "drawbar pull [N]", "torque": "torque [N m]"},
}


def settings(kind: str) -> dict[str, list[str]]:
    """Name → overrides of every run, the cheapest questions first."""

    def at(dx: str, ppc: int, margin: str) -> list[str]:
        return [
            f"scene.bed.spacing={DX[dx]:.10f}",
            f"scene.bed.particles_per_cell={ppc}",
            f"scene.contact_margin={margin}",
        ]

    changes = {
        "jittered, seed 0": ["scene.bed.arrangement=jittered", "++scene.bed.mirrored=true"],
        "jittered, seed 1": ["scene.bed.arrangement=jittered", "++scene.bed.mirrored=true", "seed=1"],
        "courant 0.3": ["scene.courant=0.3"],
        "damping 0": ["scene.elastic_damping=0"],
        "damping 0.2": ["scene.elastic_damping=0.2"],
        "volume not averaged": ["scene.volume_averaging=0"],
        "remap 1 ms": ["scene.remap_time=0.001"],
        "memory 0": ["scene.velocity_memory=1e-9"],
        "every step": [
            "scene.remap_time=0",
            "scene.velocity_memory=1e-9",
            "scene.elastic_damping=0",
            "scene.volume_averaging=0",
        ],
        "constant friction": ["effects.rate_dependence=false"],
        "friction map sin": ["material.friction_angle=37.2348", "material.friction_map=sin"],
        "E 5 MPa": ["material.youngs_modulus=5e6"],
        "E 15 MPa": ["material.youngs_modulus=15e6"],
    }
    base, default = BASE[kind], BASE[kind].split()[-1]
    if kind == "cut":
        changes["square end with margin -0.25"] = ["scene.blade.edge=square", "scene.contact_margin=-0.25"]
        rows = [(dx, ppc, default) for ppc in (1, 4) for dx in ("20", "13.3", "10")]
        rows += [(dx, 4, margin) for margin in ("-0.75", "-0.5", "-0.25", "0") for dx in ("20", "13.3")]
        last = [("13.3", 8, default), ("6.7", 4, default)]
    else:
        margins = ("-0.75", "-0.25", "-0.5", "0")
        rows = [(dx, ppc, margin) for margin in margins for ppc in (1, 4) for dx in DX]
        last = [("13.3", 8, default)]
    found = {f"dx {dx}, {ppc} per cell, margin {margin}": at(dx, ppc, margin) for dx, ppc, margin in rows}
    found |= {f"{base}, {change}": [*at("13.3", 4, default), *more] for change, more in changes.items()}
    for dx, ppc, margin in last:
        found[f"dx {dx}, {ppc} per cell, margin {margin}"] = at(dx, ppc, margin)
    return found


def measure(kind: str, name: str, overrides: list[str]) -> dict[str, float | str]:
    """One run: its forces [N], sinkage and cost."""
    config = composed("simulate", *(CUT if kind == "cut" else WHEEL), *overrides)
    scene = scene_from_config(config)
    effects = Effects(rate_dependence=bool(config.effects.rate_dependence is not False), symmetry=True)
    solver = Solver(scene, effects)
    frames, start = [], None
    for frame in solver.frames():
        start = start if start is not None else time.process_time()
        frames.append((frame.force, frame.torque, frame.body_pose))
    cost = (time.process_time() - start) / scene.duration
    force = np.array([f[0] for f in frames])[1:]
    half = len(force) // 2
    row = {
        "setting": name,
        "particles": solver.particle_count,
        "steps_per_s": round(solver.substeps_per_frame * scene.frame_rate),
        "cpu_s_per_simulated_s": round(cost, 2),
    }
    if kind == "cut":
        row |= {
            "draft": -force[:, 0].mean(),
            "draft_second_half": -force[half:, 0].mean(),
            "vertical": force[:, 2].mean(),
            "vertical_second_half": force[half:, 2].mean(),
            "swing": np.diff(force[half:, 0]).std(),
        }
    else:
        driving = np.arange(1, len(force) + 1) / scene.frame_rate > scene.settle + 1.0
        sinkage = scene.sinkage(np.array([f[2] for f in frames])[1:])
        row |= {
            "drawbar_pull": force[driving, 0].mean(),
            "vertical": force[driving, 2].mean(),
            "torque": np.array([f[1] for f in frames])[1:][driving, 1].mean(),
            "settled_sinkage_mm": 1e3 * sinkage[round(scene.settle * scene.frame_rate) - 1],
            "sinkage_mm": 1e3 * sinkage[driving].mean(),
        }
    return {k: round(float(v), 3) if isinstance(v, np.floating) else v for k, v in row.items()}


def draw(kind: str, rows: dict[str, dict]) -> None:
    """Left: each quantity over the grid spacing. Right: what one change does at one setting."""
    figure, axes = plt.subplots(3, 2, figsize=(13, 7.8), layout="constrained", width_ratios=(1, 1.4))
    grid = {
        name: m for name in rows if (m := re.fullmatch(r"dx ([\d.]+), (\d) per cell, (margin \S+)", name))
    }
    base = BASE[kind]
    changed = [name for name in rows if name.startswith(base)]
    for (left, right), (key, label) in zip(axes, QUANTITIES[kind].items(), strict=True):
        for ppc, margin in sorted({(m[2], m[3]) for m in grid.values()}):
            points = sorted(
                (float(m[1]), float(rows[n][key])) for n, m in grid.items() if (m[2], m[3]) == (ppc, margin)
            )
            if len(points) > 1:
                style = {"1": "o--", "4": "o-", "8": "o:"}[ppc]
                colour = {"-0.75": "C0", "-0.5": "C1", "-0.375": "C4", "-0.25": "C2", "0": "C3"}[
                    margin.split()[1]
                ]
                left.plot(
                    *zip(*points, strict=True), style, ms=4, color=colour, label=f"{ppc} per cell, {margin}"
                )
        left.set_xlim(0.0, None)
        left.set_ylim(min(0.0, left.get_ylim()[0]), None)
        left.set_ylabel(label)
        left.grid(alpha=0.3)
        values = [float(rows[n][key]) for n in changed]
        right.bar(range(len(changed)), values, color=["k"] + ["C0"] * (len(changed) - 1))
        right.axhline(values[0], color="k", lw=0.8)
        right.set_xticks(range(len(changed)), [n.removeprefix(base).strip(", ") or base for n in changed])
        plt.setp(right.get_xticklabels(), rotation=60, fontsize=7, ha="right")
        if right is not axes[-1, 1]:
            right.set_xticklabels([])
        right.grid(alpha=0.3, axis="y")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper left", ncols=4, fontsize=8)
    axes[-1, 0].set_xlabel("grid spacing [mm]")
    figure.savefig(HERE / f"{kind}.png", dpi=90)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--draw", action="store_true", help="only draw the figures from the tables")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    tables = {kind: {row["setting"]: row for row in read_rows(HERE / f"{kind}.csv")} for kind in QUANTITIES}
    if not options.draw:
        compute(tables, options.workers)
    for kind, rows in tables.items():
        draw(kind, rows)


def compute(tables: dict[str, dict[str, dict]], workers: int) -> None:
    """Make every run that is not in the tables yet."""
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        jobs = {
            pool.submit(measure, kind, name, overrides): (kind, name)
            for kind, rows in tables.items()
            for name, overrides in settings(kind).items()
            if name not in rows
        }
        for job in as_completed(jobs):
            kind, name = jobs[job]
            try:
                tables[kind][name] = job.result()
            except Exception as error:  # one setting that fails must not end the study
                logging.warning("%s, %s: %s", kind, name, error)
                continue
            rows = [tables[kind][name] for name in settings(kind) if name in tables[kind]]
            write_rows(HERE / f"{kind}.csv", rows, digits=6)
            logging.info("%s %s", kind, tables[kind][name])


if __name__ == "__main__":
    main()
