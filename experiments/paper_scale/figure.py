"""<dataset>.png from table.csv: errors over the number of training runs, and over the time of training.

python experiments/paper_scale/figure.py paper_excavation
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
from common import read_rows  # noqa: E402

Row = dict[str, str]
SHOWN = {
    "position_rmse_mm": "position, RMS [mm]",
    "surface_rmse_mm": "surface, RMS [mm]",
    "sinkage_mae_mm": "sinkage [mm]",
    "force_nrmse": "force, NRMSE",
    "draft_abs_mpe_percent": "mean draft [%]",
}


def words(row: Row) -> str:
    """The model of a row."""
    closure = "" if row["closure"] == "none" else f", closure {row['closure']}"
    change = f", {row['change']}" if row["change"] else ""
    return f"{row['model']}, {row['modes']} modes{closure}{change}"


def lines(rows: list[Row], over: str) -> dict[str, dict[float, list[Row]]]:
    """Rows of every model by their number of runs, or by their steps; models with two places or more."""
    found: dict[str, dict[float, list[Row]]] = defaultdict(lambda: defaultdict(list))
    for row in rows:
        found[words(row)][float(row[over])].append(row)
    return {name: dict(sorted(places.items())) for name, places in found.items() if len(places) > 1}


def draw(axes: plt.Axes, rows: list[Row], over: str, column: str) -> None:
    """Mean and spread of one error over the seeds; time is that of the trainings."""
    xs: list[float] = []
    for name, places in lines(rows, over).items():
        x, means, low, high = [], [], [], []
        for place, own in places.items():
            values = [float(row[column]) for row in own]
            mean = sum(values) / len(values)
            times = [float(row["training_core_s"]) / 60.0 for row in own]
            x.append(place if over == "runs" else sum(times) / len(times))
            means.append(mean)
            low.append(mean - min(values))
            high.append(max(values) - mean)
        xs.extend(x)
        axes.errorbar(x, means, yerr=[low, high], marker="o", markersize=3, capsize=2, label=name)
    axes.set_xscale("log")
    axes.set_xticks(sorted(set(xs)), [f"{x:.3g}" for x in sorted(set(xs))])
    axes.set_xticks([], minor=True)
    axes.set(xlabel="training runs" if over == "runs" else "training [minutes of one core]")
    axes.set_ylabel(SHOWN[column])
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.3)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset")
    dataset = parser.parse_args().dataset
    rows = [row for row in read_rows(HERE / "table.csv") if row["dataset"] == dataset]
    columns = [column for column in SHOWN if any(row.get(column) for row in rows)]
    most = max(int(row["runs"]) for row in rows)
    steps = [row["steps"] for row in rows if row["model"] != "polynomial" and int(row["runs"]) < most]
    figure, grid = plt.subplots(2, len(columns), figsize=(3.4 * len(columns), 6.2), layout="constrained")
    for axes, column in zip(grid.T, columns, strict=True):
        draw(axes[0], [row for row in rows if row["steps"] in {*steps, "0"}], "runs", column)
        draw(axes[1], [row for row in rows if int(row["runs"]) == most], "steps", column)
    grid[0, 0].legend(fontsize=6)
    figure.savefig(HERE / f"{dataset}.png", dpi=120)
    plt.close(figure)


if __name__ == "__main__":
    main()
