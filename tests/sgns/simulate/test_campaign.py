"""What runs cost: counted, scheduled, and said in words."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from omegaconf import OmegaConf

from mpm_warp import Effects, Scene, effects_for
from sgns.config import UserError
from sgns.data.dataset import SPLITS, Dataset
from sgns.numbers import duration_words
from sgns.simulate.campaign import Campaign, finishing_time, plan, run_cost, size_words, split_runs
from sgns.simulate.run import simulate_scene
from sgns.simulate.scene import scene_from_config, warning_summary
from sgns_testing.campaigns import BASE, EFFECTS, campaign
from sgns_testing.commands import composed
from sgns_testing.meshes import BOX_FACES, box_corners, write_obj

# --- What runs cost: counted, scheduled, and said in words ----------------------------------------------


@pytest.mark.parametrize("store_every", [1, 4])
def test_work_and_size_are_those_of_the_run(tmp_path, store_every):
    scene = next(iter(campaign(tmp_path).scenes.values()))
    data = scene.to_dict()
    data["bed"] |= {"spacing": 0.02, "store_every": store_every}
    data["duration"] = 0.5
    scene = Scene.from_dict(data)
    expected = run_cost(scene)
    timing = simulate_scene(scene, tmp_path / "run.h5", effects=Effects())
    assert expected.particle_steps == timing.particle_steps
    assert expected.particles == 20 * 10 * 8
    assert (tmp_path / "run.h5").stat().st_size == pytest.approx(expected.size, rel=0.05)


@pytest.mark.parametrize(
    ("waiting", "running", "workers", "end"),
    [
        ([], [], 2, 0.0),
        ([3.0], [], 4, 3.0),  # a run is not shared among cores
        ([5.0, 4.0, 3.0, 3.0, 3.0], [], 2, 10.0),
        ([3.0, 3.0, 3.0, 4.0, 5.0], [], 2, 11.0),  # the longest last: worse
        ([2.0], [1.0, 6.0], 2, 6.0),
    ],
)
def test_end_of_the_last_run(waiting, running, workers, end):
    assert finishing_time(waiting, running, workers) == end


@pytest.mark.parametrize(
    ("say", "value", "words"),
    [
        (duration_words, 0.0, "1 s"),
        (duration_words, 100.0, "2 min"),
        (duration_words, 5990.0, "1 h 40 min"),
        (duration_words, 2e5, "2 d 8 h"),
        (size_words, 100, "0.1 kB"),
        (size_words, 999_600_000, "1.0 GB"),
        (size_words, 3e15, "3000 TB"),
    ],
)
def test_durations_and_sizes(say, value, words):
    assert say(value) == words


# --- Campaigns and datasets: what is drawn, how it is split, what is on disk ----------------------------


def test_runs_are_different_scenes_of_the_grid_and_each_in_one_split(tmp_path):
    c = campaign(tmp_path)
    drawn = {(s.rake, s.depth, s.blade.friction) for s in c.scenes.values()}
    assert len(drawn) == 10
    assert {d for _, d, _ in drawn} <= {0.02, 0.04, 0.05}
    assert len({s.arrangement_hash for s in c.scenes.values()}) == 1
    assert [list(c.split.values()).count(s) for s in SPLITS] == [8, 1, 1]
    assert list(campaign(tmp_path, split=[0.9, 0.0, 0.1]).split.values()).count("validation") == 0
    assert len(campaign(tmp_path, runs=None).scenes) == 12  # all combinations when no number is given
    name, scene = next(iter(c.scenes.items()))
    assert Scene.from_dict(c.describe()["scenes"][name]) == scene


@pytest.mark.parametrize(
    ("count", "shares", "parts"),
    [
        (1, (0.8, 0.1, 0.1), [1, 0, 0]),
        (2, (0.8, 0.1, 0.1), [1, 1, 0]),
        (3, (0.1, 0.6, 0.3), [1, 2, 0]),
        (2, (0.0, 0.0, 1.0), [0, 0, 2]),
    ],
)
def test_of_few_runs_one_is_trained_on(count, shares, parts):
    split = split_runs([[str(number) for number in range(count)]], shares, np.random.default_rng(0))
    assert [list(split.values()).count(part) for part in SPLITS] == parts


def test_seed_decides_draw_and_split(tmp_path):
    one, two, other = campaign(tmp_path), campaign(tmp_path), campaign(tmp_path, seed=1)
    assert one == two
    assert (list(one.scenes), one.split) != (list(other.scenes), other.split)


def test_several_grids_are_joined(tmp_path):
    grids = [
        {"motion": ["curved"], "depth": [0.02, 0.04]},
        {"motion": ["ramp"], "depth": [0.02], "speed": [0.1, 0.2]},
    ]
    planned = campaign(tmp_path, draw=grids, runs=None)
    assert sorted(planned.split.values()) == ["test", "train", "train", "validation"]  # of two runs each
    scenes = planned.scenes.values()
    assert sorted((s.motion, s.depth, s.speed) for s in scenes) == [
        ("curved", 0.02, 0.1), ("curved", 0.04, 0.1), ("ramp", 0.02, 0.1), ("ramp", 0.02, 0.2)
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"runs": 13}, "allowed: 3 to 12, the combinations of dataset.draw; dataset.runs=null takes all"),
        ({"draw": {"rake": 3.0}}, "dataset.draw.rake is 3.0"),
        ({"draw": [3]}, "must be a grid"),
        ({"split": [0.8, 0.1, 0.2]}, "sum to 1"),
    ],
)
def test_settings_it_refuses(tmp_path, change, words):
    with pytest.raises(UserError, match=words):
        campaign(tmp_path, **change)


def test_record_once_and_open(tmp_path):
    c = campaign(tmp_path)
    c.record()
    c.record()  # the same again is fine
    with pytest.raises(UserError, match="made with other settings: seed is 0 there and 1 here; give"):
        campaign(tmp_path, seed=1).record()
    with pytest.raises(UserError, match="are missing: 10"):
        Dataset.open(c.path)
    (c.path / "runs").mkdir()
    for name in c.scenes:
        c.file(name).touch()
    dataset = Dataset.open(c.path)
    assert dataset.name == "tiny"
    assert sum(len(dataset.runs(s)) for s in SPLITS) == 10
    assert all(run.exists() for run in dataset.runs("train"))
    with pytest.raises(UserError, match="allowed: train, validation, test"):
        dataset.runs("valid")


DRAW = {"rake": [0.0, 10.0], "depth": [0.02, 0.04, 0.05], "blade.friction": [0.1, 0.3]}


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        (
            {"draw": DRAW | {"depth": [0.02, 0.03, 0.05]}},
            "scene.depth is 0.02, 0.04, 0.05 there and 0.02, 0.03, ",
        ),
        ({"draw": DRAW | {"rake": [5.0, 6.0]}}, "scene.rake is 0.0, 10.0 there and 5.0, 6.0 here; give"),
        ({"split": [0.6, 0.2, 0.2]}, "dataset.split is another; give"),
        ({"runs": 8}, "the number of runs is 10 there and 8 here; give"),
    ],
)
def test_what_a_folder_was_made_with_otherwise_is_named(tmp_path, changed, words):
    campaign(tmp_path).record()
    with pytest.raises(UserError, match=f"made with other settings: {words}"):
        campaign(tmp_path, **changed).record()


def test_another_path_is_named_without_its_rows(tmp_path):
    c = campaign(tmp_path)
    c.path.mkdir()
    scenes = {
        name: data | {"path": [[0.1 * n] * 8 for n in range(50)]}
        for name, data in c.describe()["scenes"].items()
    }
    (c.path / "dataset.yaml").write_text(yaml.safe_dump(c.describe() | {"scenes": scenes}))
    with pytest.raises(UserError, match=r"scene.path is 1 value there and None here; give"):
        c.record()


def test_a_dataset_in_another_folder_is_called_by_it(tmp_path):
    here, there = Dataset("quick", tmp_path / "quick", {}), Dataset("quick", tmp_path / "mine", {})
    assert here.title == "quick" and here.command == "sgns simulate dataset=quick"
    assert there.title == "mine"
    assert there.command == f"sgns simulate dataset=quick dataset.path={tmp_path / 'mine'}"


def test_a_tolerance_that_decides_alike_makes_no_other_dataset(tmp_path):
    """The default tolerance was 0.01 once; such datasets stay what they are while each run is decided alike."""
    c = campaign(tmp_path)
    numbers = [effects_for(scene)[1]["rate_dependence"].number for scene in c.scenes.values()]
    numbers = [number for number in numbers if number > 0.0]  # the others' blades stay above the soil

    def asking(friction: float):
        tolerance = {"friction": friction, "grid": 0.03, "reach": 0.02}
        return replace(c, effects={"rate_dependence": "auto", "tolerance": tolerance})

    asking(10.0 * max(numbers)).record()
    text = (c.path / "dataset.yaml").read_text()
    asking(2.0 * max(numbers)).record()
    assert (c.path / "dataset.yaml").read_text() == text
    friction = 10.0 * max(numbers)
    with pytest.raises(
        UserError,
        match=rf"{len(numbers)} of its 10 runs have .*go on with it: effects.tolerance.friction={friction}$",
    ):
        asking(0.5 * min(numbers)).record()
    with pytest.raises(UserError, match="made with other settings"):
        replace(asking(friction), precision="float64").record()


@pytest.mark.parametrize("effects", [3, {"colour": True}, {"tolerance": [1]}, None])
def test_a_dataset_file_with_odd_effects_is_another_dataset(tmp_path, effects):
    c = campaign(tmp_path)
    c.path.mkdir()
    (c.path / "dataset.yaml").write_text(yaml.safe_dump(c.describe() | {"effects": effects}))
    with pytest.raises(UserError, match="made with other settings"):
        c.record()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "sgns simulate dataset="),
        ("split: [", "cannot read"),
        ("- 1", "has no split"),
    ],
)
def test_what_is_no_dataset_is_refused(tmp_path, text, words):
    if text is not None:
        (tmp_path / "dataset.yaml").write_text(text)
    with pytest.raises(UserError, match=words):
        Dataset.open(tmp_path)


def test_where_picks_runs_by_their_scene(tmp_path) -> None:
    (tmp_path / "runs").mkdir()
    scenes = {n: {"load": 100.0 / n, "material": {"friction": n}} for n in (1, 2, 3, 4)}
    content = {
        "name": "some",
        "split": {"train": ["1", "2"], "validation": ["3"], "test": ["4"]},
        "scenes": {str(n): scene for n, scene in scenes.items()},
    }
    (tmp_path / "dataset.yaml").write_text(yaml.safe_dump(content))
    for n in scenes:
        (tmp_path / "runs" / f"{n}.h5").touch()
    names = lambda where: [p.stem for s in SPLITS for p in Dataset.open(tmp_path, where).runs(s)]  # noqa: E731
    assert names(None) == names({}) == ["1", "2", "3", "4"]
    assert names({"load": 33.3333333333}) == ["3"]
    assert names({"load": [100, 25], "material.friction": [1, 2]}) == ["1"]
    assert names(OmegaConf.create({"material": {"friction": [2, 4]}})) == ["2", "4"]
    with pytest.raises(UserError, match=r"dataset\.where names depth, which the scene of \d in"):
        names({"depth": 1})
    with pytest.raises(UserError, match=r"leaves no run: load is \[7\]; .* it is 100\.0, 25\.0, 33"):
        names({"load": 7})


def test_every_scene_reads_the_mesh_that_the_settings_name(tmp_path):
    sizes = {"one": (0.08, 0.09, 0.10), "two": (0.08, 0.09, 0.11)}
    files = [
        str(write_obj(tmp_path / f"{name}.obj", box_corners(size), BOX_FACES)) for name, size in sizes.items()
    ]
    rows = [[0.0, 0.1, 0.1, 0.03, 0, 0, 0, 1], [1.0, 0.2, 0.1, 0.03, 0, 0, 0, 1]]
    tool = {"shape": "mesh", "file": files[0]}
    base = Scene.from_dict({"kind": "body", "bed": BASE["bed"], "duration": 0.05, "path": rows, "tool": tool})
    draw = {"tool.file": files, "tool.friction": [0.1, 0.3]}
    settings = {"name": "tiny", "path": str(tmp_path / "tiny"), "draw": draw}
    c = plan(settings, base.to_dict(), EFFECTS, "float32", 0)
    assert {scene.tool.digest for scene in c.scenes.values()} > {base.tool.digest}
    c.record()
    c.record()  # the same settings go on


# --- Runs drawn from files ------------------------------------------------------------------------------

ROWS = "t,x,y,z,qx,qy,qz,qw\n0,0.1,0.1,{z},0,0,0,1\n0.05,0.1,0.1,{z},0,0,0,1\n"
BODY = {key: value for key, value in BASE.items() if key != "blade"} | {"kind": "body", "path": "???"}


def of_files(folder: Path, **change: Any) -> Campaign:
    settings = {"name": "own", "path": str(folder / "own"), "draw": {"path": "paths/*.csv"}}
    return plan(settings | change, BODY, EFFECTS, "float32", 0)


@pytest.fixture
def paths(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "paths").mkdir()
    for name, z in (("a", 0.07), ("b", 0.08), ("c d", 0.09)):
        (tmp_path / "paths" / f"{name}.csv").write_text(ROWS.format(z=z))
    return tmp_path


@pytest.mark.parametrize(
    "draw",
    [
        {"path": "paths/*.csv"},
        {"scene.path": ["paths/*.csv"]},
        {"path": ["paths/a.csv", "paths/b.csv", "paths/c d.csv"]},
    ],
)
def test_paths_are_drawn_by_name_or_pattern(paths, draw):
    c = of_files(paths, draw=draw)
    assert {name: scene.path[0][3] for name, scene in c.scenes.items()} == {
        "0000_path-a": 0.07, "0001_path-b": 0.08, "0002_path-c d": 0.09
    }  # fmt: skip


def test_meshes_are_drawn(paths):
    for name, size in (("small", 0.09), ("large", 0.12)):
        write_obj(paths / f"{name}.obj", box_corners((size, size, size)), BOX_FACES)
    base = BODY | {"tool": {"shape": "mesh", "file": "???"}}
    draw = {"tool.file": "*.obj", "path": "paths/*.csv"}
    c = plan({"name": "own", "path": "own", "draw": draw}, base, EFFECTS, "float32", 0)
    assert len(c.scenes) == 6
    assert c.scenes["0000_file-large_path-a"].tool.half_size[0] == pytest.approx(0.06)
    assert c.scenes["0005_file-small_path-c d"].tool.half_size[0] == pytest.approx(0.045)


def test_long_values_give_short_names_and_a_table(paths):
    rows = [[[t, 0.1, 0.1, z, 0, 0, 0, 1] for t in (0.0, 0.01, 0.02, 0.05)] for z in (0.07, 0.08, 0.09)]
    c = of_files(paths, draw={"path": rows})
    assert list(c.scenes) == ["0000", "0001", "0002"]
    c = of_files(paths)
    c.record()
    c.record()  # is the same dataset
    table = (paths / "own" / "runs.csv").read_text().splitlines()
    assert table[0] == "run,split,path" and table[1] == f"0000_path-a,{c.split['0000_path-a']},paths/a.csv"
    assert len(table) == 4
    assert yaml.safe_load((paths / "own" / "dataset.yaml").read_text())["scenes"]["0001_path-b"]["path"]


@pytest.mark.parametrize(
    ("draw", "words"),
    [
        ({"path": "paths/*.txt"}, "no file in .* fits this pattern"),
        ({"path": "paths/a.csv"}, "gives 1 runs; a campaign needs 3 or more"),
        ({"path": ["paths/a.csv", "x.csv", "y.csv"]}, "cannot read x.csv"),
        ({"contact_margin": [0.0, 0.1, 0.2]}, "scene.path is missing"),
    ],
)
def test_draws_of_files_it_refuses(paths, draw, words):
    with pytest.raises(UserError, match=words):
        of_files(paths, draw=draw)


def test_runs_of_several_passes_share_a_bed(tmp_path):
    base = scene_from_config(composed("scene=quick_excavation", "scene.motion=passes", "scene.duration=11"))
    draw = {"passes.number": [1, 2], "passes.deepening": [0.0, 0.02], "passes.advance": [0.0, 0.04]}
    c = plan({"name": "own", "path": str(tmp_path), "draw": draw}, base.to_dict(), EFFECTS, "float32", 0)
    scenes = list(c.scenes.values())
    assert (
        len(scenes) == 8 == len({scene.body_poses().tobytes() for scene in scenes}) + 3
    )  # one pass has no spacing
    assert len({scene.arrangement_hash for scene in scenes}) == 1
    assert warning_summary(c.scenes) == []
