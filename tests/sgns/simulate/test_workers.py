"""The runs of a campaign: order, shares, estimates; several processes on one folder; what fails."""

from __future__ import annotations

import logging
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sgns.config import UserError
from sgns.data.check import check_run
from sgns.data.files import file_lock
from sgns.data.run import Run
from sgns.simulate import workers as campaign_runs
from sgns.simulate.campaign import run_cost
from sgns.simulate.run import simulate_scene
from sgns.simulate.workers import simulate_campaign
from sgns_testing.campaigns import EFFECTS, campaign
from sgns_testing.commands import environment

# Compiles a kernel when told to.
COMPILE = """
import warp as wp
from mpm_warp.kernels.grid import grid_step
from mpm_warp.launch import start_warp
start_warp()
print("ready", flush=True)
input()
kernel = grid_step(wp.float32, ("no_slip",) * 3).step.alone
wp.load_module(kernel.module, device="cpu")
print("done")
"""


@pytest.fixture
def order(monkeypatch):
    """Names of the runs in the order of their beginning, without making any."""
    names = []

    def make_all(self, disk):
        names.extend(self.costs)
        self._pool.shutdown()
        return {}

    monkeypatch.setattr(campaign_runs.Workers, "make_all", make_all)
    monkeypatch.setattr(campaign_runs, "compile_kernels", lambda *_: None)
    return names


def unequal(tmp_path):
    return campaign(tmp_path, draw={"duration": [0.1, 0.5, 0.2], "depth": [0.02, 0.04]}, runs=None)


def test_campaign_is_resumed(tmp_path, caplog):
    c = campaign(tmp_path, runs=3)
    with caplog.at_level(logging.INFO):
        simulate_campaign(c, device="cpu", workers=2)
    assert "3 runs, 3 to do" in caplog.text
    assert re.search(r"about \d+ s with 2 at once, about \d+ kB of disk", caplog.text)
    files = [c.file(name) for name in c.scenes]
    assert all(check_run(f) == [] for f in files)
    before = [f.stat().st_mtime_ns for f in files]
    force = Run(files[1]).force
    files[1].unlink()
    files[2].write_bytes(files[2].read_bytes()[:5000])  # a torn file is made again
    simulate_campaign(c, device="cpu", workers=1)
    after = [f.stat().st_mtime_ns for f in files]
    assert after[0] == before[0]
    assert check_run(files[2]) == []
    np.testing.assert_array_equal(Run(files[1]).force, force)
    assert sorted(f.name for f in files[0].parent.iterdir()) == sorted(f.name for f in files)


@pytest.mark.long
def test_runs_that_take_turns_are_the_runs_made_one_by_one(tmp_path, caplog):
    one, two = campaign(tmp_path / "one", runs=5), campaign(tmp_path / "two", runs=5)
    simulate_campaign(one, device="cpu", workers=1)
    with caplog.at_level(logging.INFO):
        simulate_campaign(two, device="cpu", workers=1, batch=3)
    assert "with 3 at once" in caplog.text
    for name in two.scenes:
        assert check_run(two.file(name)) == []
        with Run(one.file(name)) as alone, Run(two.file(name)) as together:
            np.testing.assert_array_equal(alone.positions(), together.positions())
            np.testing.assert_array_equal(alone.force, together.force)


def test_the_longest_runs_come_first(tmp_path, order):
    c = unequal(tmp_path)
    simulate_campaign(c, device="cpu", workers=2)
    assert [c.scenes[name].duration for name in order] == [0.5, 0.5, 0.2, 0.2, 0.1, 0.1]


def test_shards_are_the_campaign_in_shares_of_like_work(tmp_path, order):
    c = unequal(tmp_path)
    shares = []
    for shard in range(2):
        simulate_campaign(c, device="cpu", shard=shard, shards=2)
        shares.append([run_cost(c.scenes[name]).particle_steps for name in order])
        done = list(order)
        order.clear()
        assert len(done) == 3
    assert sum(shares[0]) == pytest.approx(sum(shares[1]), rel=0.01)
    simulate_campaign(c, device="cpu")
    assert len(order) == 6


def test_a_system_that_does_not_say_which_cores_a_process_has(tmp_path, order, monkeypatch):
    """As macOS."""
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    simulate_campaign(campaign(tmp_path), device="cpu")
    assert len(order) == 10


@pytest.mark.parametrize("shard", [2, -1])
def test_shards_it_refuses(tmp_path, shard):
    with pytest.raises(UserError, match=f"shard is {shard}; with shards=2 .* from 0 to 1"):
        simulate_campaign(campaign(tmp_path), device="cpu", shard=shard, shards=2)
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_is_too_full_is_refused_before_anything_is_made(tmp_path, order, monkeypatch):
    monkeypatch.setattr("sgns.simulate.campaign.shutil.disk_usage", lambda path: SimpleNamespace(free=1000))
    with pytest.raises(UserError, match=r"of disk and 1\.0 kB are free; .*store_every"):
        simulate_campaign(campaign(tmp_path), device="cpu")
    assert order == []


def test_kernels_are_compiled_once_for_each_kind_of_scene_and_set_of_effects(tmp_path, monkeypatch):
    compiled = []

    def solver(scene, effects, *_):
        compiled.append((scene.motion, scene.blade.friction, effects.rate_dependence))
        return SimpleNamespace(frames=lambda: iter(["the first"]))

    monkeypatch.setattr(campaign_runs, "Solver", solver)
    fast = {"start": [0.3], "clearance": [0.0], "speed": [0.05, 0.06, 4.0]}
    for draw, effects, kernels in (
        ({"rake": [5.0, 10.0], "depth": [0.02, 0.04, 0.05]}, EFFECTS, [("curved", 0.3, True)]),
        (
            {"motion": ["curved", "ramp"], "blade.friction": [0.0, 0.1, 0.3]},
            EFFECTS,
            [("curved", 0.0, True), ("curved", 0.1, True), ("ramp", 0.0, True), ("ramp", 0.1, True)],
        ),
        (fast, {}, [("curved", 0.3, False), ("curved", 0.3, True)]),
    ):
        compiled.clear()
        c = replace(campaign(tmp_path, draw=draw, runs=None), effects=effects)
        campaign_runs.compile_kernels(c, list(c.scenes), "cpu")
        assert sorted(compiled) == kernels


def test_time_left_follows_from_the_work_left_and_the_speed_seen(tmp_path):
    c = campaign(tmp_path, runs=6)
    costs = {name: run_cost(scene) for name, scene in c.scenes.items()}
    per_frame = costs[next(iter(costs))].steps_per_frame
    workers = campaign_runs.Workers(c, costs, "cpu", 4)
    try:
        assert workers.time_left() == "an unknown time"
        # A frame takes a worker 100 s; six runs of three steps on four workers end after two runs.
        workers._steps_seen, workers._seconds_seen = 10 * per_frame, 1000.0
        assert workers.time_left() == "10 min"
        # Then an hour at half that speed, with three of the workers busy: the estimate says so.
        for _ in range(60):
            workers._see(0.9 * per_frame, seconds=60.0, busy=3)
        assert workers.time_left() == "20 min"
        # Four runs have only one step left (frames 0 to 2 are there), two have not begun.
        workers._frames_done[:] = [3, 3, 3, 3, 0, 0]
        assert workers.steps_made() == 8 * per_frame
        assert workers.time_left() == "13 min"
    finally:
        workers._pool.shutdown()


@pytest.mark.parametrize("batch", [1, 2])
def test_a_run_that_fails_does_not_stop_the_others(tmp_path, batch):
    c = campaign(tmp_path, draw={"depth": [0.02, 0.04, 0.05], "path": [None]}, runs=None)
    name = next(iter(c.scenes))
    c.file(name).mkdir(parents=True)  # nothing can be written there
    with pytest.raises(UserError, match=f"1 of 3 runs could not be made .* first is {name}: .* is a folder"):
        simulate_campaign(c, device="cpu", workers=1, batch=batch)
    assert [check_run(c.file(n)) for n in list(c.scenes)[1:]] == [[], []]


@pytest.mark.parametrize("batch", [1, 2])
def test_a_run_that_another_process_makes_is_left_to_it(tmp_path, caplog, batch):
    c = campaign(tmp_path, runs=3)
    first, *others = c.scenes
    with file_lock(c.file(first)) as ours, caplog.at_level(logging.INFO):
        assert ours
        simulate_campaign(c, device="cpu", workers=1, batch=batch)
    assert "runs left to another process that is making them or has made them: 1" in caplog.text
    assert not c.file(first).exists()
    assert all(c.file(name).exists() for name in others)


@pytest.mark.long
def test_two_processes_may_compile_into_an_empty_cache_at_once(tmp_path):
    variables = os.environ | {"WARP_CACHE_PATH": str(tmp_path)}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "env": variables}
    processes = [subprocess.Popen([sys.executable, "-c", COMPILE], **pipes) for _ in range(2)]
    for process in processes:
        assert process.stdout.readline() == "ready\n"
    said = [process.communicate("go\n", timeout=100)[0] for process in processes]
    assert said == ["done\n"] * 2
    # One kernel, and no half-made folder beside it.
    assert len(list(tmp_path.glob("*/wp_grid_step*"))) == 1
    assert len(list(tmp_path.glob("*/wp_grid_step*/*.o"))) == 1


# --- campaigns that are ended ------------------------------------------------------------------------------

LONG = {"depth": [0.02, 0.03], "duration": [0.1, 6.0], "speed": [0.02]}  # the long ones come first
MAKE = f"""
import pathlib, sys
from sgns.config import heeded_signals
from sgns.simulate.workers import simulate_campaign
from sgns_testing.campaigns import campaign
if __name__ == "__main__":
    made = campaign(pathlib.Path(sys.argv[1]), runs=4, draw={LONG})
    with heeded_signals():
        simulate_campaign(made, device="cpu", workers=2)
"""


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def workers_of(pid: int) -> list[int]:
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [int(child) for child in children if "spawn_main" in Path(f"/proc/{child}/cmdline").read_text()]


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="looks at /proc")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_the_workers_of_an_ended_campaign_keep_what_they_have_and_end(tmp_path, number):
    script = tmp_path / "make.py"
    script.write_text(MAKE)
    command, runs = [sys.executable, str(script), str(tmp_path)], tmp_path / "tiny" / "runs"
    heeding = {"env": environment(), "preexec_fn": lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, **heeding)
    deadline = time.monotonic() + 90.0
    while process.poll() is None and len(list(runs.glob(".*.partial"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.02)
    assert process.poll() is None, process.communicate()
    time.sleep(0.5)  # some frames
    workers = workers_of(process.pid)
    assert len(workers) == 2
    process.send_signal(number)
    process.communicate(timeout=60)
    while any(map(alive, workers)) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not any(map(alive, workers))
    kept = list(runs.glob("*.stopped.h5"))
    assert len(kept) == 2 and not list(runs.glob(".*.partial"))
    with Run(kept[0]) as run:
        assert run.frame_count > 1
    if number == signal.SIGTERM:
        c = campaign(tmp_path, runs=4, draw=LONG)
        simulate_campaign(c, device="cpu", workers=2)
        name = kept[0].name.removesuffix(".stopped.h5")
        simulate_scene(c.scenes[name], tmp_path / "whole.h5", effects=c.physics[name][0])
        with Run(c.file(name)) as one, Run(tmp_path / "whole.h5") as two:
            assert one.extra["continued"]
            assert one.content_hash == two.content_hash
        assert sorted(runs.iterdir()) == sorted(map(c.file, c.scenes))
