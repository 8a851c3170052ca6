"""The kernels that a GPU gets, checked on the CPU access by access (experiments/gpu).

(No `from __future__ import annotations`: Warp reads the types of the kernels.)
"""

import pytest
import warp as wp
from stand_in import Checked, Threads, compiler, on_stand_in

from mpm_warp import Bed, Plate, Solver
from mpm_warp.launch import Executor, Job, Launch, Program, SceneKernel, find_device
from sgns_testing.scenes import cut

pytestmark = pytest.mark.skipif(compiler() is None, reason="needs g++ on Linux")


@SceneKernel
def from_neighbour(i: int, a: wp.array(dtype=float)):
    if i + 1 < a.shape[0]:
        a[i] = a[i + 1]


@SceneKernel
def beyond_the_end(i: int, a: wp.array(dtype=float)):
    a[i + 1] = 1.0


@SceneKernel
def one_more(i: int, a: wp.array(dtype=float)):
    a[i] = a[i] + 1.0


def small_cut(duration):
    """280 particles, with the blade in the soil; one frame."""
    return cut(
        bed=Bed(size=(0.28, 0.2, 0.1), spacing=0.02, particles_per_cell=0.4, headroom=0.08),
        blade=Plate(length=0.1, width=0.1, thickness=0.044, edge="square"),
        clearance=0.0,
        depth=0.03,
        duration=duration,
        frame_rate=1.0 / duration,
        start=0.4,
    )


@pytest.mark.parametrize(
    ("kernel", "parts", "conflicts", "outside"),
    [
        (from_neighbour, [(0, 10)], 8, 0),  # the first and the last number are touched by one item only
        (one_more, [(0, 10), (5, 10)], 5, 0),  # two scenes that share half of an array
        (one_more, [(0, 5), (5, 10)], 0, 0),
        (beyond_the_end, [(0, 9)], 0, 1),
    ],
)
def test_what_is_wrong_is_found(kernel, parts, conflicts, outside):
    device = find_device("cpu")
    numbers = wp.zeros(10, dtype=float, device=device)
    with on_stand_in(Checked()) as checked:
        launches = [Launch(kernel, b - a, [numbers[a:b]], device) for a, b in parts]
        Executor(device).run([Job(Program([launch]), 1) for launch in launches])
    (report,) = checked.reports()
    assert (report.conflicts, report.outside) == (conflicts, outside)
    assert bool(report.first) == bool(conflicts + outside)


@pytest.mark.long
def test_no_two_items_of_a_launch_meet_but_in_atomic_sums():
    found = {}
    for atomic in (True, False):
        with on_stand_in(Checked(atomic=atomic)) as checked:
            *_, frame = Solver(small_cut(1.0 / 480.0)).frames()
        assert abs(frame.force[0]) > 0.1
        found[atomic] = {report.kernel: report for report in checked.reports()}
    assert len(found[True]) == len(found[False]) == 7
    assert not any(report.conflicts or report.outside for report in found[True].values())
    assert {name for name, report in found[False].items() if report.conflicts} == {"to_grid", "scatter"}


@pytest.mark.long
def test_threads_agree_with_the_loop():
    *_, one = Solver(small_cut(1.0 / 60.0)).frames()
    with on_stand_in(Threads()) as threads:
        *_, two = Solver(small_cut(1.0 / 60.0)).frames()
    assert threads.launches > 100
    # Fused products and another order of sums: 4e-6 m in longer runs; sums that are not atomic: 2e-4 m.
    assert abs(one.position - two.position).max() < 1e-5
    assert abs(one.force - two.force).max() < 1e-3 * abs(one.force).max()
