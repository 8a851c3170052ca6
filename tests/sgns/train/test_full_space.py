"""Windows hold what the files hold."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mpm_warp.poses import in_world_frame
from sgns.config import UserError
from sgns.data.run import Run
from sgns.train.full_space import FullSpaceRun, FullSpaceWindows
from sgns_testing.runs import make_run


@pytest.fixture(scope="module")
def paths(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    return [make_run(folder / f"{seed}.h5", frames=6 + seed, n=20, seed=seed) for seed in range(2)]


def test_a_window_is_frames_of_the_file(paths) -> None:
    windows = FullSpaceWindows([FullSpaceRun(path) for path in paths], history=3)
    assert len(windows) == 5 + 6
    window = windows.window(5 + 3)  # the second run's frame 4
    with Run(paths[1]) as run:
        torch.testing.assert_close(window.position[0], torch.from_numpy(run.positions(slice(1, 5))).double())
        torch.testing.assert_close(window.force[0], torch.from_numpy(run.force[4]))
        torch.testing.assert_close(window.body.position[0], torch.from_numpy(run.body_points[2:5]))
        np.testing.assert_allclose(
            window.body.motion[0, -1], run.body_points[4] - run.body_points[3], atol=1e-15
        )


def test_a_run_starts_from_rest(paths) -> None:
    windows = FullSpaceWindows([FullSpaceRun(path) for path in paths], history=3)
    window = windows.window(0)
    assert bool((window.position[0, :3] == window.position[0, 0]).all())
    assert float(window.body.motion[0, :2].abs().max()) == 0.0


def test_body_nodes_of_ones_own_are_carried_along(paths) -> None:
    nodes = np.array([[0.0, 0.0, 0.0], [0.01, 0.1, -0.1]])
    run = FullSpaceRun(paths[0], nodes)
    with Run(paths[0]) as file:
        expected = in_world_frame(file.pose, nodes)
    np.testing.assert_allclose(run.track.position, expected)


def test_a_batch_depends_on_seed_and_step_only(paths) -> None:
    runs = [FullSpaceRun(path) for path in paths]
    scale = torch.tensor([1e-4, 1e-5, 1e-4], dtype=torch.float64)
    a, b, other, seeded = (
        FullSpaceWindows(runs, 3, seed).batch(step, 4, scale)
        for step, seed in ((7, 0), (7, 0), (8, 0), (7, 1))
    )
    assert torch.equal(a.history, b.history) and torch.equal(a.force, b.force)
    assert not torch.equal(a.history, other.history) and not torch.equal(a.history, seeded.history)
    # The oldest position is exact, the newest velocity's noise has the stated size.
    assert float(a.noise[:, 0].abs().max()) == 0.0
    found = (a.noise[:, -1] - a.noise[:, -2]).square().mean((0, 1)).sqrt()
    torch.testing.assert_close(found / scale, torch.ones(3, dtype=torch.float64), atol=0.35, rtol=0)


def test_runs_that_do_not_belong_together_are_refused(paths, tmp_path) -> None:
    other = make_run(tmp_path / "other.h5", frames=6, n=21)
    with pytest.raises(UserError, match="one bed"):
        FullSpaceWindows([FullSpaceRun(paths[0]), FullSpaceRun(other)], 3)
    with pytest.raises(UserError, match="no training runs"):
        FullSpaceWindows([], 3)
    with pytest.raises(UserError, match="no body points"):
        FullSpaceRun(make_run(tmp_path / "bare.h5", frames=3, n=5, m=0))
