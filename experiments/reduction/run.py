"""What r modes cost on runs that the basis has not seen, for the three centrings.

    python experiments/reduction/run.py data/quick

One stream over the training runs gives the bases of all three centrings. Writes curves.csv and curves.png beside
this script. "Held out" are the validation and the test runs.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(1, str(Path(__file__).resolve().parents[1]))

import matplotlib.pyplot as plt
import numpy as np
import torch
from common import write_rows

from sgns.data.dataset import SPLITS, Dataset
from sgns.evaluate.costs import cpu_model
from sgns.reduction.basis import CENTRINGS, ReductionCurves, reduction_curves
from sgns.reduction.reduce import fit_runs

HERE = Path(__file__).parent
POWERS = [2**k for k in range(9)]


def rows_of(centring: str, curves: ReductionCurves) -> list[dict[str, str]]:
    """Lines of curves.csv."""
    return [
        {
            "centring": centring,
            "modes": str(r),
            "energy": f"{curves.energy[r - 1]:.8f}",
            "displacement_energy": f"{curves.displacement_energy[r - 1]:.6f}",
            "rmse_training_mm": f"{1e3 * curves.training[r - 1] ** 0.5:.4f}",
            "rmse_held_out_mm": f"{1e3 * curves.held_out[r] ** 0.5:.4f}",
        }
        for r in POWERS
    ]


def draw(curves: dict[str, ReductionCurves], path: Path) -> None:
    """Errors and what the two energies leave out, against the number of modes."""
    figure, (errors, energies) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    for colour, (centring, found) in enumerate(curves.items()):
        modes = np.arange(1, len(found.energy) + 1)
        style = {"color": f"C{colour}", "lw": 1.2}
        errors.loglog(modes, 1e3 * np.sqrt(found.held_out[1:]), label=f"{centring}, held out", **style)
        errors.loglog(modes, 1e3 * np.sqrt(found.training), ls=":", label="training", **style)
        energies.loglog(modes, 1.0 - found.displacement_energy, label=f"{centring}, displacement", **style)
        energies.loglog(modes, 1.0 - found.energy, ls="--", label="the paper's", **style)
    errors.set(xlabel="modes r", ylabel="reduction RMSE [mm]")
    energies.set(xlabel="modes r", ylabel="1 − energy")
    for axis in (errors, energies):
        axis.axvline(8, color="0.6", lw=0.8)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7)
    figure.savefig(path, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", nargs="?", default="data/quick", help="folder of a complete campaign")
    dataset = Dataset.open(parser.parse_args().dataset)
    paths = {split: [Path(path) for path in dataset.runs(split)] for split in SPLITS}
    print(
        cpu_model(), "threads", torch.get_num_threads(), {split: len(runs) for split, runs in paths.items()}
    )
    pca = fit_runs(paths["train"], POWERS[-1])
    curves, rows = {}, []
    for centring in CENTRINGS:
        basis = pca.basis(centring)
        curves[centring] = reduction_curves(basis, paths["validation"] + paths["test"])
        rows += rows_of(centring, curves[centring])
    write_rows(HERE / "curves.csv", rows)
    print(*("  ".join(row.values()) for row in rows), sep="\n")
    draw(curves, HERE / "curves.png")


if __name__ == "__main__":
    main()
