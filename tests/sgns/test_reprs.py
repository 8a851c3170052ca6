"""Whatever a person prints is one short line that says what it is."""

from __future__ import annotations

import pydoc

import numpy as np
import pytest

from mpm_warp import Bed, Body, Excavation, Solver
from sgns import IncrementalPCA, Run
from sgns_testing.runs import make_run
from sgns_testing.scenes import cut
from sgns_testing.tiny import MODEL
from sgns_testing.trained import TrainedKinds

LONGEST = 400


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> TrainedKinds:
    return TrainedKinds.of(tmp_path_factory.mktemp("tiny"), {"network": MODEL})


def test_what_is_learned_prints_in_a_line(trained) -> None:
    simulator, path = trained.simulator("network"), trained.run.pose
    state, rollout = simulator.reset(path), simulator.rollout(path)
    shown = {
        "Simulator(network: ": simulator,
        "State(frame=0, latent=<(4, 3) float64>, force=[0, 0, 0]": state,
        f"Rollout(latent=<({len(path)}, 4, 3) float64>, ": rollout,
        f"Rollouts(latent=<(1, {len(path)}, 4, 3) float64>, ": simulator.rollouts(path[None]),
        "Snapshot(frame=0, latent=<(4, 3) float64>, pose=[": simulator.save(),
        "Excess(amount=<": rollout.excess,
        "Basis(mean=<(": simulator.basis,
        "Surrogate(network: 4 modes of ": trained.surrogate("network"),
        "ReducedRun(name='": trained.run,
        "IncrementalPCA(4 modes, 0 frames": IncrementalPCA(4),
    }
    for begins, thing in shown.items():
        text = repr(thing)
        assert text.startswith(begins) and "\n" not in text and len(text) < LONGEST, text


def test_what_is_simulated_prints_in_a_line(tmp_path) -> None:
    solver = Solver(cut())
    with Run(make_run(tmp_path / "a.h5", n=2000)) as run:
        shown = {
            "Solver(excavation: ": solver,
            "Frame(index=0, time=0, position=<(": next(solver.frames()),
            "Surface(x=<(": run.surface(),
            "Run('": run,
        }
    for begins, thing in shown.items():
        text = repr(thing)
        assert text.startswith(begins) and "\n" not in text and len(text) < LONGEST, text


def test_a_scene_prints_what_differs_from_its_defaults() -> None:
    assert repr(Excavation()) == "Excavation()"
    assert repr(Excavation(depth=0.07, bed=Bed(seed=3))) == "Excavation(bed=Bed(seed=3), depth=0.07)"
    path = [(t, 0.1 + t, 0.3, 0.1, 0.0, 0.0, 0.0, 1.0) for t in np.linspace(0.0, 0.5, 500)]
    assert repr(Body(path=path)) == "Body(path=<500 items>)"


def test_the_help_of_a_scene_lists_settings_with_units_defaults_and_ranges() -> None:
    text = pydoc.plain(pydoc.render_doc(Excavation))
    for line in (
        "depth = 0.05 m: the motion reaches this far below the tip's starting height (0 to 1000)",
        "rake = 10.0 degrees: angle of the plate from vertical, tip leading (-60 to 60)",
        "motion = 'curved': of the tip (curved, ramp, rest, path, passes)",
    ):
        assert line in text
