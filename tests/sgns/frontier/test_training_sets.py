"""Smaller training sets: nested subsets of runs, every nth frame."""

import numpy as np
import pytest
from tiny import make_dataset, reduced

from sgns.errors import UserError
from sgns.frontier.training_sets import EveryNthFrame, every_nth_frame, frame_means, with_training_runs
from sgns.runs import Run


def test_subsets_of_runs_are_nested_and_leave_the_other_splits_alone(tmp_path):
    dataset = make_dataset(tmp_path)
    subsets = [set(with_training_runs(dataset, count, seed=3).split["train"]) for count in (1, 2, 3, 4)]
    assert [len(subset) for subset in subsets] == [1, 2, 3, 4]
    assert subsets[0] < subsets[1] < subsets[2] < subsets[3] == set(dataset.split["train"])
    part = with_training_runs(dataset, 2)
    assert part.split["test"] == dataset.split["test"]
    assert part.split["train"] == [n for n in dataset.split["train"] if n in part.split["train"]]
    assert with_training_runs(dataset, None) is dataset


@pytest.mark.parametrize("count", [0, 5])
def test_more_runs_than_there_are_is_one_line(tmp_path, count):
    with pytest.raises(UserError, match=f"training_runs is {count}.*give 1 to 4"):
        with_training_runs(make_dataset(tmp_path), count)


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_means_of_frames_keep_the_impulse(n):
    force = np.random.default_rng(0).normal(size=(3 * n + 1, 3))
    means = frame_means(force, n)
    assert len(means) == len(force[::n])
    np.testing.assert_array_equal(means[0], force[0])
    np.testing.assert_allclose(n * means[1:].sum(axis=0), force[1:].sum(axis=0), atol=1e-12)


def test_frames_that_fill_no_whole_mean_are_left_out():
    assert len(frame_means(np.zeros((8, 3)), 3)) == 3  # 0, 1-3, 4-6


def test_a_slower_dataset_has_every_nth_frame(tmp_path):
    fast = reduced(tmp_path)  # 14 frames, run f 12
    slow = every_nth_frame(fast, 3)
    assert slow.frame_rate == fast.frame_rate / 3
    for split in ("train", "validation", "test"):
        for whole, part in zip(fast.runs(split), slow.runs(split), strict=True):
            np.testing.assert_array_equal(part.latent, whole.latent[::3])
            np.testing.assert_array_equal(part.pose, whole.pose[::3])
            assert len(part.time) == len(part.force) == len(part.torque) == len(part.latent)
    assert every_nth_frame(fast, 1) is fast


def test_a_run_read_slowly_is_the_slow_reduced_run(tmp_path):
    slow = every_nth_frame(reduced(tmp_path), 3).runs("test")[0]
    with Run(tmp_path / "runs" / "g.h5") as run:
        view = EveryNthFrame(run, 3)
        assert view.frame_rate == 20.0
        assert view.frame_count == len(slow.latent)
        for name in ("time", "pose", "body_points", "force", "torque"):
            np.testing.assert_allclose(getattr(view, name), getattr(slow, name), atol=1e-12)
        np.testing.assert_array_equal(view.positions(slice(1, 3)), run.positions([3, 6]))
        same = EveryNthFrame(run, 1)
        np.testing.assert_array_equal(same.force, run.force)
