"""The solver against cases with known answers, resolved well enough to see how it converges.

    python experiments/verification/run.py [bagnold mckyes passive runout silo slope stopping waves]

Writes NAME.csv and NAME.png beside this script; all of them take about 25 minutes on one core.
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
CASES = ("bagnold", "mckyes", "passive", "runout", "silo", "slope", "stopping", "waves")


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
        figure = plt.figure(figsize=(9, 5), layout="constrained")
        case.draw(figure, rows)
        figure.savefig(HERE / f"{name}.png", dpi=100)


if __name__ == "__main__":
    main()
