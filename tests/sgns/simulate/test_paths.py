"""Paths drawn by chance: smooth, inside the bin, the same for a seed."""

from __future__ import annotations

import numpy as np
import pytest

import sgns
from mpm_warp import Bed, Body, Box, Cylinder
from mpm_warp.poses import in_world_frame
from sgns.simulate.scene import read_path

BED = Bed(size=(0.8, 0.6, 0.15), spacing=0.02)


@pytest.mark.parametrize("tool", [Box(size=(0.06, 0.16, 0.08)), Cylinder()])
def test_paths_stay_inside_and_are_smooth(tool):
    for path in sgns.random_paths(20, tool, BED, depth=0.08):
        points = in_world_frame(path[:, 1:], tool.outline())
        low, high = points.min(axis=(0, 1)), points.max(axis=(0, 1))
        assert np.all(low[:2] > 0.059) and np.all(high[:2] < np.array(BED.size[:2]) - 0.059)
        assert -0.0801 < low[2] < -0.019
        assert points[[0, -1], :, 2].min() > 0.0  # all begin from the same bed
        speed = np.diff(path[:, 1:4], axis=0) * 30
        assert np.abs(speed[[0, -1]]).max() < 0.1
        assert np.abs(np.diff(speed, axis=0)).max() < 0.15  # m/s in a thirtieth of a second
        Body(bed=BED, tool=tool, path=tuple(map(tuple, path.tolist())))


def test_a_seed_decides_and_files_hold_the_paths(tmp_path):
    three = sgns.random_paths(3, Box(), BED, seed=4, folder=tmp_path / "paths")
    np.testing.assert_array_equal(three[:2], sgns.random_paths(2, Box(), BED, seed=4))
    assert not np.allclose(three[0], sgns.random_paths(1, Box(), BED, seed=5)[0])
    assert not np.allclose(three[0], three[1])
    files = sorted((tmp_path / "paths").iterdir())
    assert [file.name for file in files] == ["path_000.csv", "path_001.csv", "path_002.csv"]
    np.testing.assert_allclose(read_path(files[2]), three[2], atol=1e-8)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"count": 0}, "count is 0; allowed: 1 to"),
        ({"depth": 0.12}, "depth is 0.12 m; allowed: above 0 up to 0.09 m"),
        ({"duration": float("nan")}, "duration is nan"),
        ({"tool": Box(size=(80.0, 200.0, 100.0))}, "no room in a bin of 0.8 x 0.6 m"),
    ],
)
def test_numbers_it_refuses(change, words):
    with pytest.raises(sgns.UserError, match=words):
        sgns.random_paths(**({"count": 1, "tool": Box(), "bed": BED} | change))
