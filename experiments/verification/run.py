"""The solver against cases with known answers, resolved well enough to see how it converges.

    python experiments/verification/run.py [bagnold mckyes passive runout silo slope stopping waves]

Writes NAME.csv and NAME.png beside this script; all of them take about 25 minutes on one core. A case is a module here
with a function `measure`, which returns the rows of the table, and a dictionary PLOT: `x` and `y`, columns to draw;
`theory`, a column with what y should be; `curves` and `panels`, columns that tell curves and panels apart; `where`,
values that rows must have; and settings of matplotlib's axes.
"""

from __future__ import annotations

import argparse
import importlib
import logging
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(1, str(Path(__file__).resolve().parents[1]))

import matplotlib.pyplot as plt
from common import write_rows

HERE = Path(__file__).parent
CASES = ("bagnold", "mckyes", "passive", "runout", "silo", "slope", "stopping", "waves")


def grouped(rows: Sequence[dict[str, Any]], columns: Sequence[str]) -> dict[str, list[dict[str, Any]]]:
    """Rows by the values of some columns, in words."""
    found: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        words = ", ".join(f"{column.replace('_', ' ')} {row[column]}" for column in columns)
        found.setdefault(words, []).append(row)
    return found


def draw(
    file: Path,
    rows: Sequence[dict[str, Any]],
    x: str,
    y: str,
    curves: Sequence[str],
    panels: Sequence[str] = (),
    theory: str = "",
    where: dict[str, Any] | None = None,
    **settings: Any,
) -> None:
    """What was measured as points, theory as lines."""
    rows = [row for row in rows if all(row[key] == value for key, value in (where or {}).items())]
    shown = grouped(rows, panels)
    figure = plt.figure(figsize=(9, 5), layout="constrained")
    axes = figure.subplots(1, len(shown), sharey=True, squeeze=False)[0]
    for axis, (title, part) in zip(axes, shown.items(), strict=True):
        for number, (label, points) in enumerate(grouped(part, curves).items()):
            at = [point[x] for point in points]
            axis.plot(at, [point[y] for point in points], "o-", ms=4, lw=0.5, color=f"C{number}", label=label)
            if theory:
                axis.plot(at, [point[theory] for point in points], "--", lw=1.2, color=f"C{number}")
        axis.set(**settings)
        axis.set_title(title, fontsize=9)
        axis.label_outer()
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8, title="dashed: theory" if theory else None)
    figure.savefig(file, dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", nargs="*", default=CASES, help=f"some of {', '.join(CASES)}; default: all")
    options = parser.parse_args()
    if unknown := set(options.cases) - set(CASES):
        parser.error(f"no case {sorted(unknown)[0]}; there are {', '.join(CASES)}")
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    for name in options.cases:
        case = importlib.import_module(name)
        start = time.perf_counter()
        rows = case.measure()
        logging.info("%s: %.0f s", name, time.perf_counter() - start)
        write_rows(HERE / f"{name}.csv", rows, digits=6)
        draw(HERE / f"{name}.png", rows, **case.PLOT)


if __name__ == "__main__":
    main()
