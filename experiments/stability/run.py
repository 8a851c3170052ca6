"""Measure the hard cases, each in a process of its own.

    python experiments/stability/run.py --workers 2

Goes on where it stopped: a case is measured again only if its limit or its words changed, or with --fresh. Writes
table.csv and margins.png beside this script when all cases have been measured.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

import matplotlib.pyplot as plt
from hard_cases import AREAS, Case, Row, cases

from sgns.data.files import write_whole

HERE = Path(__file__).resolve().parent
sys.path.insert(1, str(HERE.parent))

from common import write_rows  # noqa: E402

log = logging.getLogger(__name__)
LONGEST = 1800.0  # seconds that a case may take
LEAST, MOST = 1e-4, 1e2  # measured / limit that the figure shows


def row_file(folder: Path, area: str, name: str) -> Path:
    """Where a case's row is kept until the table is written."""
    return folder / area / (name.replace("/", "-").replace(" ", "_") + ".json")


def stored(file: Path, case: Case) -> Row | None:
    """The row measured earlier, unless the case has changed since."""
    try:
        row = Row(**json.loads(file.read_text()))
    except (OSError, ValueError, TypeError):
        return None
    words = ("hard", "must", "quantity", "limit", "unit")
    return row if all(getattr(row, word) == getattr(case, word) for word in words) else None


def keep(file: Path, row: Row) -> None:
    """Write a row for `stored`."""
    write_whole(file, json.dumps(asdict(row)))


def measure(area: str, case: Case, folder: Path) -> Row:
    """Have a process of its own measure a case: one that crashes or hangs is a failure, not the end."""
    file = row_file(folder, area, case.name)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.unlink(missing_ok=True)
    start, command = time.perf_counter(), [sys.executable, __file__, "--rows", str(folder), "--one"]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    try:
        ended = subprocess.run(
            [*command, area, case.name], timeout=LONGEST, env=environment, capture_output=True, text=True
        )
        note = f"the process ended with status {ended.returncode}: {' '.join(ended.stderr.split())[-300:]}"
    except subprocess.TimeoutExpired:
        note = f"it was not done after {LONGEST:g} s"
    row = stored(file, case)
    if row is None:
        row = case.row(area, (math.nan, note), time.perf_counter() - start)
        keep(file, row)
    words = f"{row.result:4} {area}: {row.name}: {row.measured:.3g} {row.unit} (limit {row.limit:g})"
    log.info("%s, %.0f s %s", words, row.seconds, row.note)
    return row


def write_table(file: Path, rows: list[Row]) -> None:
    """All rows as CSV."""
    formats = {"measured": ".4g", "limit": "g", "margin": ".3f", "seconds": ".1f"}
    write_rows(
        file,
        [asdict(row) | {key: f"{getattr(row, key):{to}}" for key, to in formats.items()} for row in rows],
    )


def draw(rows: list[Row], file: Path) -> None:
    """Measured over limit of every case on a logarithmic axis; what broke down is at its end."""
    figure, axis = plt.subplots(figsize=(9.0, 0.2 * len(rows) + 1.5), layout="constrained")
    for place, row in enumerate(rows):
        known = math.isfinite(row.measured) and row.limit > 0.0
        share = row.measured / row.limit if known else LEAST if row.passed else MOST
        share = min(max(share, LEAST), MOST)
        axis.barh(
            place, share - LEAST, left=LEAST, color="tab:green" if row.passed else "tab:red", height=0.7
        )
        text = f" {row.measured:.2g} {row.unit}" if math.isfinite(row.measured) else " broke down"
        axis.text(min(share, MOST / 8.0), place, text, va="center", fontsize=6.5)
    axis.axvline(1.0, color="black", linewidth=1.0)
    axis.set(xscale="log", xlim=(LEAST, MOST), ylim=(len(rows) - 0.4, -0.6))
    axis.set_yticks(range(len(rows)), [f"{row.area}: {row.name}" for row in rows], fontsize=7)
    axis.set_xlabel("measured / limit (1: at the limit)")
    axis.grid(axis="x", linewidth=0.3)
    figure.savefig(file, dpi=110)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="measure cases whose area or name holds this text")
    parser.add_argument("--workers", type=int, default=1, help="processes at once")
    parser.add_argument("--fresh", action="store_true", help="measure again what has been measured")
    parser.add_argument("--rows", type=Path, default=Path("outputs/stability"), help="where rows are kept")
    parser.add_argument("--one", nargs=2, metavar=("AREA", "NAME"), help="measure this case in this process")
    options = parser.parse_args()
    if options.one:
        area, name = options.one
        keep(row_file(options.rows, area, name), cases(area)[name].run(area))
        return
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    files = {
        (area, case): row_file(options.rows, area, case.name)
        for area in AREAS
        for case in cases(area).values()
    }
    chosen = [(area, case) for area, case in files if options.only in f"{area} {case.name}"]
    missing = [one for one in chosen if options.fresh or not stored(files[one], one[1])]
    log.info("%d cases, %d to measure", len(chosen), len(missing))
    with ThreadPoolExecutor(options.workers) as pool:
        list(pool.map(lambda item: measure(*item, options.rows), missing))
    done = [row for (_, case), file in files.items() if (row := stored(file, case))]
    log.info("%d of %d cases measured, %d fail", len(done), len(files), sum(not row.passed for row in done))
    if len(done) == len(files):
        write_table(HERE / "table.csv", done)
        draw(done, HERE / "margins.png")


if __name__ == "__main__":
    main()
