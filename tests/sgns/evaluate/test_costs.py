import json
import math
import mmap
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from mpm_warp import Effects
from sgns.data.run import Run
from sgns.evaluate import costs
from sgns.evaluate.costs import forget_peak, network_costs, peak_memory, solver_rates
from sgns.evaluate.full_space import full_space_cost
from sgns.settings import ModelSettings
from sgns.simulate.run import simulate_scene
from sgns_testing.runs import make_run
from sgns_testing.scenes import cut
from sgns_testing.tiny import MODEL

CARD = {"settings": {"training": {"batch_size": 32}}}


def test_training_is_read_from_beside_the_checkpoint(tmp_path):
    unknown = network_costs(tmp_path / "best.ckpt", CARD)
    assert math.isnan(unknown.parameters) and math.isnan(unknown.seconds_per_step)
    (tmp_path / "training.json").write_text(json.dumps({"steps": 50, "seconds": 2.0, "skill": 0.5}))
    known = network_costs(tmp_path / "best.ckpt", CARD)
    assert known.seconds_per_step == pytest.approx(0.04) and known.batch_size == 32
    assert math.isnan(network_costs(tmp_path / "best.ckpt", {}).batch_size)


def test_size_and_weights_of_a_checkpoint(tmp_path, monkeypatch):
    class Loaded:
        dynamics = torch.nn.Linear(3, 4)

    monkeypatch.setattr(costs, "load_surrogate", lambda path: Loaded)
    (tmp_path / "best.ckpt").write_bytes(b"x" * 1234)
    known = network_costs(tmp_path / "best.ckpt", {})
    assert known.parameters == 16 and known.checkpoint_bytes == 1234


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux counts it this way")
def test_peak_of_memory_is_seen_and_forgotten():
    forget_peak()
    before = peak_memory()
    np.frombuffer(mmap.mmap(-1, 40_000_000), np.uint8)[:] = 1  # pages of its own, not what was freed before
    assert peak_memory() > before + 30e6


def test_systems_that_do_not_count_it(monkeypatch):
    monkeypatch.setattr(costs, "Path", lambda name: (_ for _ in ()).throw(OSError(name)))
    forget_peak()
    assert math.isnan(peak_memory())


def test_the_solver_is_timed_on_the_scene_of_a_run(tmp_path, caplog):
    scene = cut()
    file = tmp_path / "run.h5"
    simulate_scene(scene, file, effects=Effects())
    with Run(file) as run:
        rates = list(solver_rates(run))
    # Frames 2 to 12, without the first ones, in whole stretches.
    assert len(rates) == (scene.frame_count - 2) // costs.SOLVER_FRAMES == 3 and min(rates) > 0.0
    with Run(make_run(tmp_path / "synthetic.h5")) as run, caplog.at_level("INFO"):
        assert list(solver_rates(run)) == []
    assert "the solver cannot be timed on synthetic.h5" in caplog.text


def test_cost_of_a_network_on_every_particle(tmp_path):
    run, settings = make_run(tmp_path / "run.h5", n=500), ModelSettings(**MODEL)
    cost = full_space_cost(run, settings, 3)
    assert cost.training_step > cost.rollout / 60.0 > 0.0
    assert cost.peak_bytes > 1e7 and cost.batch_size == 2
    wider = full_space_cost(run, replace(settings, hidden_width=2 * settings.hidden_width), 1)
    assert wider.parameters > 2 * cost.parameters
