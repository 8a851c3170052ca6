"""The campaigns that ship: how many runs, of which scenes."""

from __future__ import annotations

from collections import Counter
from functools import cache
from types import SimpleNamespace

import pytest
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf

from mpm_warp import Effects
from sgns.cli.help import options_of
from sgns.simulate import command as simulate
from sgns.simulate.campaign import plan, run_cost


@cache
def planned(name, *overrides):
    """The campaign of `sgns simulate dataset=<name> <overrides>`."""
    task = [f"dataset={name}", *overrides]
    with pytest.MonkeyPatch.context() as patch, initialize_config_module("sgns.conf", version_base="1.3"):
        current = SimpleNamespace(overrides=SimpleNamespace(task=task))
        patch.setattr(simulate.HydraConfig, "get", lambda: current)
        cfg = compose("simulate", task)
        settings = OmegaConf.to_container(cfg.dataset, resolve=True)
        return plan(settings, simulate.base_scene(settings), {}, "float32", cfg.seed)


def cuts(name):
    return {(s.motion, s.rake, s.depth, s.speed) for s in planned(name).scenes.values()}


@pytest.mark.parametrize(
    "name",
    [
        name
        for name in options_of("dataset")
        if name not in ("published", "own", "imported") and "reduced" not in name
    ],
)
def test_every_dataset_has_valid_scenes_that_share_a_bed(name):
    campaign = planned(name)
    assert campaign.name == name
    assert len({scene.arrangement_hash for scene in campaign.scenes.values()}) == 1
    assert all(count > 0 for count in Counter(campaign.split.values()).values())


def test_the_papers_excavation():
    scenes = list(planned("paper_excavation").scenes.values())
    assert len(cuts("paper_excavation")) == len(scenes) == 250
    assert {s.frame_count for s in scenes} == {321}
    assert {s.bed.size for s in scenes} == {(0.80, 0.60, 0.15)}
    half = run_cost(scenes[0], Effects(symmetry=True))
    assert half.size == pytest.approx(95e6, rel=0.02)
    assert 2 * half.particles == pytest.approx(run_cost(scenes[0]).particles, abs=1)


def test_the_desktop_excavation_is_part_of_the_papers():
    part = cuts("desktop_excavation")
    assert len(part) == 60 and part < cuts("paper_excavation")
    for values in zip(*part, strict=True):
        assert min(Counter(values).values()) >= 12


@pytest.mark.parametrize(("name", "runs"), [("paper_wheel", 243), ("desktop_wheel", 60), ("quick_wheel", 16)])
def test_the_wheels(name, runs):
    scenes = planned(name).scenes.values()
    assert len(scenes) == runs
    if name == "paper_wheel":
        small = {s.load for s in scenes if s.diameter == 0.05}
        assert sorted(small) == pytest.approx([100 / 9, 164 / 9, 225 / 9])
        assert {s.width for s in scenes if s.diameter == 0.30} == {0.125}
        assert {round(1e3 * s.speed, 6) for s in scenes} == {15.6, 12.0, 5.85}


def test_the_command_line_comes_after_what_the_dataset_changes():
    def recorded(*overrides):
        return next(iter(planned("desktop_excavation", *overrides).scenes.values())).bed.store_every

    assert recorded() == 3
    assert recorded("dataset.runs=3", "scene.bed.store_every=2") == 2
    assert recorded("dataset.runs=3", "dataset.change={bed.store_every: 4}") == 4
