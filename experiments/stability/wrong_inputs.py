"""Try wrong inputs on every command, and write what happened into wrong_inputs.csv.

    python experiments/stability/wrong_inputs.py

Goes on where it stopped: inputs that the table has are not tried again, unless with --fresh. The status is 1 if a
command did not refuse one, or not in a line, soon and small.
"""

from __future__ import annotations

import argparse
import csv
import os
import shutil
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch: processes are forked
os.environ.setdefault("MPLBACKEND", "Agg")
HERE = Path(__file__).resolve().parent
sys.path[1:1] = [str(HERE.parent), str(HERE.parents[1] / "support")]

from common import read_rows  # noqa: E402

from sgns_testing.wrong_inputs import Case, every_case, good_cases, run_cases  # noqa: E402

COLUMNS = ["command", "kind", "wrong input", "status", "seconds", "MB", "fault", "line"]


def input_of(case: Case) -> str:
    """As the table has it."""
    return case.what.removeprefix(case.command).strip()[:100]


def main() -> int:
    """Returns the number of faults, at most 1."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--fresh", action="store_true", help="try all of them again")
    parser.add_argument("--table", type=Path, default=HERE / "wrong_inputs.csv")
    asked = parser.parse_args()
    known = [] if asked.fresh else read_rows(asked.table)
    done = {(row["command"], row["wrong input"]) for row in known}
    cases = [one for one in [*good_cases(), *every_case()] if (one.command, input_of(one)) not in done]
    folder = Path(tempfile.mkdtemp())
    faults = sum(bool(row["fault"]) for row in known)
    with asked.table.open("a" if known else "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        if not known:
            writer.writerow(COLUMNS)
        for one in run_cases(cases, folder):
            measured = [one.status, f"{one.seconds:.1f}", one.bytes >> 20, one.fault]
            line = one.line.removeprefix(f"sgns {one.case.command}: ").replace(f"{folder}/", "")
            line = line[:90] if one.status else ""
            writer.writerow([one.case.command, one.case.kind, input_of(one.case), *measured, line])
            file.flush()
            faults += bool(one.fault)
            if one.fault:
                print(one.fault, "|", one.case.what[:200], "|", one.said[-500:])
    shutil.rmtree(folder)
    print(f"{len(known) + len(cases)} inputs, {faults} faults")
    return min(faults, 1)


if __name__ == "__main__":
    sys.exit(main())
