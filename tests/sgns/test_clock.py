"""A clock that stands still or goes back, as that of a virtual machine that was paused."""

from __future__ import annotations

import itertools
import time

import pytest
import torch

from mpm_warp import Effects
from sgns.data.run import Run
from sgns.evaluate import full_space
from sgns.numbers import elapsed
from sgns.simulate import workers as campaign_runs
from sgns.simulate.run import simulate_scene
from sgns_testing.campaigns import campaign, job


@pytest.fixture(params=[0.0, -7.0], ids=["still", "back"])
def odd_clock(request, monkeypatch):
    """Every clock moves by so many seconds each time it is read."""
    for name in ("perf_counter", "process_time", "monotonic"):
        readings = itertools.count(1e6, request.param)
        monkeypatch.setattr(time, name, lambda readings=readings: next(readings))


def test_a_time_is_above_zero():
    assert elapsed(2.0, 5.0) == 3.0
    assert elapsed(2.0, 2.0) == elapsed(2.0, 1.0) == 1e-9


def test_a_run_is_made_and_said_to_have_been_quick(tmp_path, odd_clock):
    scene = next(iter(campaign(tmp_path).scenes.values()))
    timing = simulate_scene(scene, tmp_path / "run.h5", effects=Effects())
    assert 0.0 < timing.per_simulated_second < 1e-3
    assert timing.rate > 1e9
    with Run(tmp_path / "run.h5") as run:
        assert run.wall_time_s > 0.0


def test_a_trial_ends_and_takes_some_time(tmp_path, odd_clock, monkeypatch):
    scene = next(iter(campaign(tmp_path).scenes.values()))
    monkeypatch.setattr(
        campaign_runs, "_barrier", type("Barrier", (), {"wait": lambda self, timeout: None})()
    )
    counts, seconds = campaign_runs.time_jobs([job(scene, tmp_path / "run.h5")])
    assert counts == [scene.frame_count - 1]
    assert seconds > 0.0


def test_other_times_can_be_divided_by(odd_clock):
    assert full_space.wall_time(lambda: torch.zeros(1), 3) > 0.0
