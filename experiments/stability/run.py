"""Measure the hard cases, each in a process of its own.

    python experiments/stability/run.py --workers 2

Goes on where it stopped: a case is measured again only if its limit or its words changed, or with --fresh. Writes
table.csv and margins.png beside this script when all cases have been measured.
"""

from __future__ import annotations

import argparse
import csv
import json
import logging
import math
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, fields
from pathlib import Path

from hard_cases import AREAS, Case, Row, cases
from margins import draw

from sgns.data.files import write_whole

HERE = Path(__file__).resolve().parent
log = logging.getLogger(__name__)
LONGEST = 1800.0  # seconds that a case may take


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
    log.info(
        "%-4s %s: %s: %.3g %s (limit %g), %.0f s %s",
        row.result,
        area,
        row.name,
        row.measured,
        row.unit,
        row.limit,
        row.seconds,
        row.note,
    )
    return row


def write_table(file: Path, rows: list[Row]) -> None:
    """All rows as CSV."""
    with file.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, [f.name for f in fields(Row)])
        writer.writeheader()
        for row in rows:
            numbers = {
                "measured": f"{row.measured:.4g}",
                "limit": f"{row.limit:g}",
                "margin": f"{row.margin:.3f}",
                "seconds": f"{row.seconds:.1f}",
            }
            writer.writerow(asdict(row) | numbers)


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
        row = cases(area)[name].run(area)
        keep(row_file(options.rows, area, name), row)
        return
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    wanted = [(area, case) for area in AREAS for case in cases(area).values()]
    chosen = [(area, case) for area, case in wanted if options.only in f"{area} {case.name}"]
    missing = [
        (area, case)
        for area, case in chosen
        if options.fresh or not stored(row_file(options.rows, area, case.name), case)
    ]
    log.info("%d cases, %d to measure", len(chosen), len(missing))
    with ThreadPoolExecutor(options.workers) as pool:
        list(pool.map(lambda item: measure(*item, options.rows), missing))
    rows = [stored(row_file(options.rows, area, case.name), case) for area, case in wanted]
    done = [row for row in rows if row is not None]
    log.info("%d of %d cases measured, %d fail", len(done), len(wanted), sum(not row.passed for row in done))
    if len(done) == len(wanted):
        write_table(HERE / "table.csv", done)
        draw(done, HERE / "margins.png")


if __name__ == "__main__":
    main()
