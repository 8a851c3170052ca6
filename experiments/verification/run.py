"""The solver against cases with known answers, resolved well enough to see how it converges.

    python experiments/verification/run.py [bagnold cohesion crater mckyes passive runout silo slope stopping waves]

Writes NAME.csv beside this script; all of them take about 25 minutes on one core. A case is a module here with a
function `measure`, which returns the rows of the table; Bagnold's flow is drawn, too.
"""

from __future__ import annotations

import argparse
import importlib
import logging
import sys
import time
from pathlib import Path

sys.path.insert(1, str(Path(__file__).resolve().parents[1]))

import matplotlib.pyplot as plt
from common import write_rows

HERE = Path(__file__).parent
CASES = ("bagnold", "cohesion", "crater", "mckyes", "passive", "runout", "silo", "slope", "stopping", "waves")


def draw(rows: list[dict]) -> None:
    """Bagnold's flow: speed as points, theory as lines, a panel for each number of particles per cell."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 5), layout="constrained", sharey=True)
    curves: dict[tuple, list[dict]] = {}
    for row in rows:
        curves.setdefault((row["particles_per_cell"], row["spacing"], row["courant"]), []).append(row)
    for (per_cell, spacing, courant), part in curves.items():
        axis = axes[int(per_cell > 1)]
        height, speed, theory = ([row[key] for row in part] for key in ("height", "speed", "theory"))
        axis.plot(height, speed, "o-", ms=4, lw=0.5, label=f"spacing {spacing}, courant {courant}")
        axis.plot(height, theory, "k--", lw=1.0)
        axis.set(xlabel="height [m]", title=f"{per_cell} per cell")
    axes[0].set_ylabel("speed after 2 s [m/s]")
    axes[1].legend(fontsize=8, title="dashed: theory")
    figure.savefig(HERE / "bagnold.png", dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", nargs="*", default=CASES, help=f"some of {', '.join(CASES)}; default: all")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    for name in options.cases:
        case = importlib.import_module(name)
        start = time.perf_counter()
        rows = case.measure()
        logging.info("%s: %.0f s", name, time.perf_counter() - start)
        write_rows(HERE / f"{name}.csv", rows, digits=6)
        if name == "bagnold":
            draw(rows)


if __name__ == "__main__":
    main()
