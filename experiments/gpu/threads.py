"""Would the kernels be right on a GPU? Their accesses to memory checked item by item, and whole runs by threads.

    python experiments/gpu/threads.py

Needs Linux and g++, and no GPU. First faults are planted, which must be found. Then every case of scenes.py is
computed: its first frames with every access of every item looked at; all of it by four threads in shuffled order, which
must agree with the ordinary run; and captured and replayed as graphs, which must give the ordinary run's bits. Writes
conflicts.csv and threads.csv beside this script; the status is 1 if something was found or does not agree.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
import warp as wp
from scenes import FARTHEST, FORCE, Case, cases, outcome, write_rows
from stand_in import Checked, Report, Threads, compiler, on_stand_in, with_graphs

from mpm_warp.launch import Executor, Job, Launch, Program, find_device, scene_kernel

HERE = Path(__file__).resolve().parent
FRAMES = 2  # checked; every launch of every step in them


@dataclass
class Agreement:
    """A case computed by threads, beside other ways that should make no difference either."""

    case: str
    scenes: int
    particles: int
    launches: int
    farthest: float
    """Largest distance of a particle from where the ordinary run has it [m]."""
    rms: float
    force: float
    """Difference of the forces over the forces, root mean squares over the frames; 0 without a body."""
    farthest_orders: float
    """The same between two runs by threads in different orders."""
    rms_orders: float
    force_orders: float
    farthest_precisions: float
    """The same between ordinary runs in float32 and in float64."""
    rms_precisions: float
    force_precisions: float
    same_by_graphs: bool
    """Captured and replayed as graphs on the CPU, the ordinary run has the same bits."""

    @property
    def holds(self) -> bool:
        return self.farthest < FARTHEST and self.force < FORCE and self.same_by_graphs


@scene_kernel()
def from_neighbour(i: int, a: wp.array(dtype=float)):
    if i + 1 < a.shape[0]:
        a[i] = a[i + 1]


@scene_kernel()
def beyond_the_end(i: int, a: wp.array(dtype=float)):
    a[i + 1] = 1.0


@scene_kernel()
def one_more(i: int, a: wp.array(dtype=float)):
    a[i] = a[i] + 1.0


def planted(given: Sequence[Case]) -> dict[str, list[Report]]:
    """What the check finds where there is something to be found, by fault."""
    named = {case.name: case for case in given}
    found = {}
    for words, faulty, names in (
        ("kernels for one thread", {"atomic": False}, ("cut", "cut, nonlocality")),
        ("atomic operations that are not", {"plain": True}, ("cut",)),
    ):
        with on_stand_in(Checked(**faulty)) as checked:
            for name in names:
                outcome(named[name].shortened(1))
        found[words] = [report for report in checked.reports() if report.conflicts]

    device = find_device("cpu")
    numbers = wp.zeros(10, dtype=float, device=device)
    for words, kernel, arrays in (
        ("an item reads what the next one writes", from_neighbour, [numbers]),
        ("two scenes share an array", one_more, [numbers, numbers]),
        ("a write beyond the end", beyond_the_end, [numbers[:9]]),
    ):
        with on_stand_in(Checked()) as checked:
            launches = [Launch(kernel, len(array), [array], device) for array in arrays]
            Executor(device).run([Job(Program([launch]), 1) for launch in launches])
        found[words] = [report for report in checked.reports() if report.conflicts or report.outside]
    return found


def lost_sums(case: Case) -> float:
    """Largest distance of a particle from where it belongs if threads sum without atomics [m]."""
    with on_stand_in(Threads(plain=True)):
        wrong = outcome(case)
    return wrong.moved_apart(outcome(case))[0]


def agreement(case: Case) -> Agreement:
    """Compute a case by threads and in the ordinary ways."""
    serial, exact = outcome(case), outcome(case, precision="float64")
    with on_stand_in(Threads(seed=1)) as threads:
        one = outcome(case)
    with on_stand_in(Threads(seed=2)):
        two = outcome(case)
    with with_graphs():
        replayed = outcome(case)
    same = np.array_equal(replayed.position, serial.position) and np.array_equal(replayed.force, serial.force)
    values = [
        number
        for a, b in ((one, serial), (one, two), (serial, exact))
        for number in (*a.moved_apart(b), a.pushed_apart(b))
    ]
    return Agreement(case.name, len(case.scenes), case.particles, threads.launches, *values, same)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="cases with this in their name; no tables are written")
    options = parser.parse_args()
    if compiler() is None:
        print("nothing was checked: g++ on Linux is needed")
        return 2
    with tempfile.TemporaryDirectory() as folder:
        everything = cases(Path(folder))
        chosen = [case for case in everything if options.only in case.name]
        missed, faults = 0, planted(everything)
        for words, reports in faults.items():
            missed += not reports
            print(f"planted: {words}: {'found in' if reports else 'MISSED'}", end=" ")
            print("; ".join(f"{r.kernel} ({r.conflicts} + {r.outside}; {r.first})" for r in reports))
        lost = lost_sums(everything[0])
        missed += lost < FARTHEST / 10.0
        print(f"planted: threads without atomic sums: particles up to {1e3 * lost:.2g} mm off")

        checked, rows = Checked(), []
        for case in chosen:
            begin = time.perf_counter()
            with on_stand_in(checked):
                outcome(case.shortened(FRAMES))
            row = agreement(case)
            rows.append(row)
            print(
                f"{case.name}: {row.farthest:.1e} m and {row.force:.1e} off the ordinary run "
                f"(orders {row.farthest_orders:.1e} m, {row.force_orders:.1e}; precisions "
                f"{row.farthest_precisions:.1e} m, {row.force_precisions:.1e}), {time.perf_counter() - begin:.0f} s",
                flush=True,
            )
    for report in checked.reports():
        print(report)
    found = sum(report.conflicts + report.outside for report in checked.reports())
    apart = [row.case for row in rows if not row.holds]
    print(
        f"{found} conflicts and accesses outside; {len(apart)} cases disagree {apart or ''}; {missed} missed"
    )
    if not options.only:
        reports = [("", report) for report in checked.reports()]
        reports += [(words, report) for words, some in faults.items() for report in some]
        write_rows(
            HERE / "conflicts.csv", [{"planted": words, **asdict(report)} for words, report in reports]
        )
        write_rows(
            HERE / "threads.csv",
            [{field.name: getattr(row, field.name) for field in fields(row)} for row in rows],
        )
    return 1 if found or apart or missed else 0


if __name__ == "__main__":
    sys.exit(main())
