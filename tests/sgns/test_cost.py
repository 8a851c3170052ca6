"""What runs cost: counted, scheduled, and said in words."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from test_campaign import campaign

from mpm_warp import Effects, Scene
from sgns import cost
from sgns.cost import duration_words, finishing_time, require_space, run_cost, size_words
from sgns.errors import UserError
from sgns.scene_run import simulate_scene


@pytest.mark.parametrize("store_every", [1, 4])
def test_work_and_size_are_those_of_the_run(tmp_path, store_every):
    scene = next(iter(campaign(tmp_path).scenes.values()))
    data = scene.to_dict()
    data["bed"] |= {"spacing": 0.02, "store_every": store_every}
    data["duration"] = 0.5
    scene = Scene.from_dict(data)
    expected = run_cost(scene)
    timing = simulate_scene(scene, tmp_path / "run.h5", effects=Effects())
    assert expected.work == timing.particle_steps
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
        ([2.0], [5.0], 2, 5.0),
    ],
)
def test_end_of_the_last_run(waiting, running, workers, end):
    assert finishing_time(waiting, running, workers) == end


def test_a_disk_that_is_too_full_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(cost.shutil, "disk_usage", lambda path: SimpleNamespace(free=10**9))
    require_space(tmp_path / "not" / "there", 10**9)
    with pytest.raises(UserError, match=r"there needs 1.4 GB of disk and 1.0 GB are free; .*store_every"):
        require_space(tmp_path / "not" / "there", 14 * 10**8)


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0.0, "1 s"),
        (99.0, "99 s"),
        (100.0, "2 min"),
        (5990.0, "1 h 40 min"),
        (12000.0, "3 h 20 min"),
        (2e5, "2 d 8 h"),
    ],
)
def test_durations(seconds, words):
    assert duration_words(seconds) == words


@pytest.mark.parametrize(
    ("size", "words"),
    [(100, "0.1 kB"), (56_300_000, "56 MB"), (999_600_000, "1.0 GB"), (3e12, "3.0 TB"), (3e15, "3000 TB")],
)
def test_sizes(size, words):
    assert size_words(size) == words
