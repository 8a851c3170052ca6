"""`sgns simulate`: one run and a campaign, resumed; what goes wrong leaves nothing behind."""

from __future__ import annotations

import os
import time

import h5py
import numpy as np
import pytest
from omegaconf import OmegaConf

from mpm_warp import Effects, Excavation, effects_for
from mpm_warp.launch import run_concurrently
from sgns.config import UserError
from sgns.data.check import check_run
from sgns.data.files import only_here
from sgns.data.run import Run
from sgns.simulate import command as simulate
from sgns.simulate.run import scene_stages
from sgns.simulate.scene import effects_line
from sgns_testing.campaigns import campaign
from sgns_testing.commands import SHORT, sgns


def test_command_writes_a_complete_run(tmp_path):
    done = sgns(tmp_path, "simulate", *SHORT, "scene.rake=5", "scene.bed.store_every=7", "output=run.h5")
    assert done.returncode == 0, done.stderr
    assert "run.h5: 200 particles (one of every 7 recorded), 4 frames" in done.stdout
    assert "particle-steps/s" in done.stdout
    assert done.stdout.rstrip().endswith("to look at it: sgns plot run.h5")
    (physics,) = (line for line in done.stdout.splitlines() if "effects on" in line)
    assert "yielding" in physics and "granular soil flows" not in physics  # the run says why
    assert check_run(tmp_path / "run.h5") == []
    with Run(tmp_path / "run.h5") as run:
        assert run.producer == "mpm"
        assert run.scene["rake"] == 5.0
        assert run.effects["separation"]["on"] is True
        assert run.effects["separation"]["reason"]
        assert run.frame_count == 4
    with h5py.File(tmp_path / "run.h5") as file:
        assert file["particles/soil/position/value"].shape == (4, 29, 3)
    assert [p.name for p in tmp_path.iterdir()] == ["run.h5"]


def test_threads_compute_a_run_but_no_dataset(tmp_path):
    runs = []
    for threads in (1, 2):
        file = f"{threads}.h5"
        done = sgns(tmp_path, "simulate", *SHORT, f"solver.threads={threads}", f"output={file}")
        assert done.returncode == 0, done.stderr
        with Run(tmp_path / file) as run:
            assert run.extra["threads"] == threads
            runs.append(run.positions(3))
    np.testing.assert_allclose(*runs, atol=1e-5)
    done = sgns(tmp_path, "simulate", "dataset=quick", "solver.threads=2")
    assert done.returncode == 2
    assert "solver.threads is 2; a dataset makes a run per core" in done.stderr


def test_scenes_side_by_side_share_the_time_that_passes(tmp_path):
    scenes, begin = list(campaign(tmp_path).scenes.values())[:2], time.perf_counter()
    stages = [scene_stages(scene, tmp_path / f"{n}.h5", effects=Effects()) for n, scene in enumerate(scenes)]
    timings = dict(run_concurrently(stages, 2, "cpu"))
    passed = time.perf_counter() - begin
    assert 0.0 < sum(timing.wall_time for timing in timings.values()) < passed
    for number, timing in timings.items():
        assert timing.wall_time < 0.7 * passed
        with Run(tmp_path / f"{number}.h5") as run:
            assert run.wall_time_s == timing.wall_time


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes")
def test_an_output_that_is_a_pipe_or_taken_is_refused_before_anything_is_computed(tmp_path, monkeypatch):
    monkeypatch.setattr(simulate, "simulate_scene", None)
    cfg = OmegaConf.create({"output": str(tmp_path / "run.h5"), "device": "cpu"})
    scene = Excavation()
    with only_here(tmp_path / "run.h5"), pytest.raises(UserError, match=f"made by process {os.getpid()}"):
        simulate.simulate_one(scene, cfg)
    os.mkfifo(tmp_path / "run.stopped.h5")
    with pytest.raises(UserError, match=r"run\.stopped\.h5: it is a pipe"):
        simulate.simulate_one(scene, cfg)
    os.mkfifo(tmp_path / "run.h5")
    with pytest.raises(UserError, match=r"run\.h5: it is a pipe"):
        simulate.simulate_one(scene, cfg)


@pytest.mark.parametrize(
    "what", [[*SHORT, "output=run.h5"], ["dataset=quick", "dataset.runs=5", "dataset.path=data"]]
)
def test_what_takes_longer_or_more_disk_than_the_limits_is_refused_before_it_begins(tmp_path, what):
    for limit, words in (
        ("time=1e-9", "limits.time is 1e-09 days"),
        ("disk=1e-9", "limits.disk is 1e-09 GB"),
    ):
        done = sgns(tmp_path, "simulate", *what, f"limits.{limit}")
        assert done.returncode == 2 and words in done.stderr.splitlines()[-1], done.stderr
        assert " of one core and " in done.stdout + done.stderr
        assert not list(tmp_path.rglob("*.h5"))


def test_other_settings_are_looked_at_before_an_output_that_is_taken(tmp_path):
    """And a run is a .h5 file."""
    (tmp_path / "run.h5").touch()
    for settings, words in (
        (["scene.depth=9", "output=run.h5"], "leaves the bin"),
        (["output=run.h5"], "run.h5 is there already; choose another output"),
        (["output=run.csv"], "output is run.csv; a run is a .h5 file: output=run.h5"),
        (["output=run"], "output=run.h5"),
    ):
        done = sgns(tmp_path, "simulate", *SHORT, *settings)
        assert done.returncode == 2 and words in done.stderr.splitlines()[-1], done.stderr
    assert (tmp_path / "run.h5").stat().st_size == 0


def test_effects_are_told_in_one_line_with_what_decided_them():
    scene = Excavation(speed=4.0)
    decisions = effects_for(scene, {"torque": False})[1]
    line = effects_line([decisions])
    assert line.startswith("effects on: yielding, separation")
    assert "; rate_dependence on: the body moves soil at" in line
    assert "; torque off: asked for; auto would turn it on" in line
    assert "fluidity" not in line and "granular soil" not in line


def test_a_wheel_that_came_to_the_floor_is_told_afterwards(tmp_path):
    """Before, its height is not known."""
    shallow = [
        "scene.bed.size=[0.3,0.19,0.025]",
        "scene.load=4000",
        "scene.duration=0.15",
        "scene.settle=0.1",
    ]
    done = sgns(tmp_path, "simulate", "scene=wheel", *shallow, "output=run.h5")
    assert done.returncode == 0, done.stderr
    [line] = [line for line in (done.stdout + done.stderr).splitlines() if "above the floor" in line]
    assert line.startswith("warning: the tool's lowest point comes to ")
