"""The campaigns that ship: how many runs, of which scenes."""

from __future__ import annotations

from collections import Counter
from types import SimpleNamespace

import pytest
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf

from sgns.cli.help import options_of
from sgns.simulate import command as simulate
from sgns.simulate.campaign import plan, run_cost


@pytest.fixture
def planned(monkeypatch, tmp_path):
    """The campaign of `sgns simulate dataset=<name> <overrides>`."""

    def planned(name, *overrides):
        task = [f"dataset={name}", *overrides]
        current = SimpleNamespace(overrides=SimpleNamespace(task=task))
        monkeypatch.setattr(simulate.HydraConfig, "get", lambda: current)
        with initialize_config_module("sgns.conf", version_base="1.3"):
            cfg = compose("simulate", task)
            settings = OmegaConf.to_container(cfg.dataset, resolve=True)
            return plan(settings, simulate._base_scene(settings), {}, "float32", cfg.seed)

    return planned


@pytest.mark.parametrize("name", [name for name in options_of("dataset") if name != "published"])
def test_every_dataset_has_valid_scenes_that_share_a_bed(planned, name):
    campaign = planned(name)
    assert campaign.name == name
    assert len({scene.arrangement_hash for scene in campaign.scenes.values()}) == 1
    assert all(count > 0 for count in Counter(campaign.split.values()).values())


def test_the_papers_excavation(planned):
    campaign = planned("paper_excavation")
    scenes = list(campaign.scenes.values())
    assert len({(s.motion, s.rake, s.depth, s.speed) for s in scenes}) == 250
    assert {s.frame_count for s in scenes} == {321}
    assert {s.bed.size for s in scenes} == {(0.80, 0.60, 0.15)}
    assert sum(run_cost(s).size for s in scenes) == pytest.approx(250 * 46e6, rel=0.01)


def test_the_desktop_excavation_is_part_of_the_papers(planned):
    whole = {(s.motion, s.rake, s.depth, s.speed) for s in planned("paper_excavation").scenes.values()}
    part = {(s.motion, s.rake, s.depth, s.speed) for s in planned("desktop_excavation").scenes.values()}
    assert len(part) == 60 and part < whole
    for values in zip(*part, strict=True):
        assert min(Counter(values).values()) >= 12


@pytest.mark.parametrize(("name", "runs"), [("paper_wheel", 243), ("desktop_wheel", 60), ("quick_wheel", 16)])
def test_the_wheels(planned, name, runs):
    scenes = planned(name).scenes.values()
    assert len(scenes) == runs
    if name == "paper_wheel":
        small = {s.load for s in scenes if s.diameter == 0.05}
        assert sorted(small) == pytest.approx([100 / 9, 164 / 9, 225 / 9])
        assert {s.width for s in scenes if s.diameter == 0.30} == {0.125}
        assert {round(1e3 * s.speed, 6) for s in scenes} == {15.6, 12.0, 5.85}


def test_the_command_line_comes_after_what_the_dataset_changes(planned):
    def recorded(*overrides):
        return next(iter(planned("desktop_excavation", *overrides).scenes.values())).bed.store_every

    assert recorded() == 5
    assert recorded("scene.bed.store_every=2") == 2
    assert recorded("dataset.change={bed.store_every: 4}") == 4
