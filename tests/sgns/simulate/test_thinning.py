"""Runs that hold one of several particles: what is recorded, and that all that follows goes on with it."""

from __future__ import annotations

import numpy as np
import pytest

from mpm_warp import Effects, Scene
from sgns.config import UserError
from sgns.data.check import check_run
from sgns.data.run import Run
from sgns.rollout import require_known_bed, rollout_scene
from sgns.simulate.run import simulate_scene
from sgns_testing.campaigns import campaign
from sgns_testing.surrogates import FakeSimulator, fitted


def longer(scene, store_every=1):
    data = scene.to_dict()
    data |= {"duration": 0.4, "depth": 0.1, "speed": 0.3}
    data["bed"]["store_every"] = store_every
    return Scene.from_dict(data)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    return list(campaign(tmp_path_factory.mktemp("scenes")).scenes.values())


@pytest.fixture(scope="module")
def runs(scenes, tmp_path_factory):
    """Three runs, long enough to move soil, with a third of their particles, and the first of them with all."""
    folder = tmp_path_factory.mktemp("runs")
    paths = [folder / name for name in ("a.h5", "b.h5", "c.h5", "all.h5")]
    for path, scene in zip(paths, [*(longer(s, 3) for s in scenes[:3]), longer(scenes[0])], strict=True):
        simulate_scene(scene, path, effects=Effects())
    return paths


def test_the_recorded_particles_are_those_of_the_whole_run(scenes, runs):
    kept = longer(scenes[0], 3).stored
    with Run(runs[0]) as part, Run(runs[-1]) as whole:
        assert part.particle_count == len(kept) == 67
        np.testing.assert_array_equal(part.positions(), whole.positions()[:, kept])
        np.testing.assert_array_equal(part.velocities(), whole.velocities()[:, kept])
        np.testing.assert_array_equal(part.force, whole.force)  # the solver computes all particles
        assert part.scene["bed"]["store_every"] == 3
        assert part.extra["particles_simulated"] == 200
    assert check_run(runs[0]) == []


def test_a_basis_of_thinned_runs_rolls_out_thinned_scenes_only(scenes, runs, tmp_path):
    simulator = FakeSimulator(fitted(runs[:3], 4), runs[:3])
    new = longer(scenes[3], 3)
    require_known_bed(simulator, new, "best.ckpt")
    rollout_scene(simulator, new, tmp_path / "new.h5")
    assert check_run(tmp_path / "new.h5") == []
    with pytest.raises(UserError, match=r"it knows store_every 3 \(here 1\)"):
        require_known_bed(simulator, scenes[3], "best.ckpt")
