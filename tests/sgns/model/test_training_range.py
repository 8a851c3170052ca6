"""How far a path leaves what the training runs covered."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mpm_warp.poses import in_body_frame
from sgns.config import UserError
from sgns.model.training_range import FAR, NOTEWORTHY, Excess, TrainingRange, components, widths


@pytest.fixture(scope="module")
def known(data) -> TrainingRange:
    return TrainingRange.of(data.runs("train"), 4, ("depth",))


def excess(known, run, pose=None, points=None, latent=None, depth=None):
    """Of a training run's path with some of it changed."""
    own = in_body_frame(run.pose[0], run.body_points[0])
    return known.excess(
        run.pose if pose is None else pose,
        own if points is None else own + points,
        run.latent[:, :4] if latent is None else latent,
        {"depth": run.scene["depth"] if depth is None else depth},
    )


def test_training_runs_are_inside(data, known) -> None:
    for run in data.runs("train"):
        found = excess(known, run)
        assert found.largest == 0.0
        assert found.words() == ""


def test_the_unit_is_the_width_of_the_range(data, known) -> None:
    name = "the tool's position"
    low, high = known.low[name][0], known.high[name][0]
    run = data.runs("train")[0]
    shift = high - run.pose[-1, 0] + 2.5 * (high - low)
    found = excess(known, run, run.pose + np.eye(7)[0] * shift)
    assert found.amount[-1] == pytest.approx(2.5)
    assert found.quantity[-1] == "the tool's position (x)"
    assert found.words().startswith("from frame 0 on")
    assert "the tool's position (x) is 2.5 times its training range" in found.words()


@pytest.mark.parametrize(
    ("quantity", "words"),
    [
        ("the tool's position (x)", "path is"),
        ("the soil's velocity (mode 1, x)", "predicted soil is"),
        ("load", "scene is"),
    ],
)
def test_it_says_what_is_unlike_the_training_runs(quantity, words) -> None:
    assert f"from frame 1 on the {words}" in Excess(np.array([0.0, 0.1]), ["", quantity]).words()


def test_the_quick_look_at_a_step_agrees_with_the_whole(data, known) -> None:
    run, rng = data.runs("train")[0], np.random.default_rng(0)
    answers = []
    for size in np.repeat([0.0, 0.01, 0.1, 1.0], 20):
        before, pose = run.pose[3], run.pose[4].copy()
        pose[:3] += 0.1 * size * rng.normal(size=3)
        turn = Rotation.from_rotvec(size * rng.normal(size=3))
        pose[3:] = rng.choice([-1, 1]) * (turn * Rotation.from_quat(pose[3:])).as_quat()
        points = in_body_frame(run.pose[0], run.body_points[0])
        found = known.excess(
            np.stack([before, pose]), points, np.zeros((2, 4, 3)), {"depth": 0.0}, of="the tool's"
        )
        answers.append(known.far(before, pose, points))
        assert answers[-1] == (found.amount[1] > FAR)
    assert {True, False} == set(answers)


def turned(run):
    half = np.radians(60)
    return np.column_stack(
        [run.pose[:, :3], np.tile([0.0, 0.0, np.sin(half), np.cos(half)], (len(run.pose), 1))]
    )


def away(path):
    """Three times as far from where it began."""
    return path[:1] + 3.0 * (path - path[:1])


@pytest.mark.parametrize(
    ("quantity", "change"),
    {
        "the tool's orientation": lambda run: {"pose": turned(run)},
        "the tool's lowest point": lambda run: {"points": [0.0, 0.0, -0.1]},
        "the tool's displacement per frame (x)": lambda run: {
            "pose": np.column_stack([away(run.pose[:, 0]), run.pose[:, 1:]])
        },
        "the soil's state": lambda run: {"latent": run.latent[:, :4] + [[0.0, 0.0, 9.0]]},
        "the soil's": lambda run: {"latent": away(run.latent[:, :4])},
        "depth": lambda run: {"depth": 1.0},
    }.items(),
)
def test_every_quantity_counts(data, known, quantity, change) -> None:
    run = data.runs("train")[0]
    found = excess(known, run, **change(run))
    assert found.largest > NOTEWORTHY
    assert any(name.startswith(quantity) for name in found.quantity)


def test_fewer_modes_are_compared_with_the_first(data, known) -> None:
    run = data.runs("train")[0]
    assert excess(known, run, latent=run.latent[:, :2]).largest == 0.0


def test_the_number_of_points_counts_where_they_are_seen(data) -> None:
    run = data.runs("train")[0]
    for seen in (True, False):
        known = TrainingRange.of(data.runs("train"), 4, ("depth",), points=seen)
        one = in_body_frame(run.pose[0], run.body_points[0])[:1]
        found = known.excess(run.pose, one, run.latent[:, :4], {"depth": run.scene["depth"]})
        assert ("the number of the tool's points" in found.quantity) == seen
        assert (found.largest == pytest.approx(14 / 15)) == seen


def test_what_never_varied_has_a_unit_of_its_own() -> None:
    np.testing.assert_allclose(widths(np.array([0.0, 3.0]), np.array([10.0, 3.0])), [10.0, 1.0])
    np.testing.assert_allclose(widths(np.array([0.0, -4.0]), np.array([0.0, -4.0])), [4.0, 4.0])
    np.testing.assert_allclose(widths(np.zeros(3), np.zeros(3)), 1.0)
    # Round-off is no variation.
    np.testing.assert_allclose(widths(np.array([0.3]), np.array([0.3 + 1e-17])), 0.3)


def test_what_is_not_finite_is_noteworthy(data, known) -> None:
    run = data.runs("train")[0]
    latent = run.latent[:, :4].copy()
    latent[5] = np.nan
    found = excess(known, run, latent=latent)
    assert np.isnan(found.largest) and found.words().startswith("from frame 5 on")


def test_it_comes_back_from_plain_numbers(data, known) -> None:
    again = TrainingRange.from_plain(known.plain())
    for side in ("low", "high"):
        for name, values in getattr(known, side).items():
            np.testing.assert_array_equal(getattr(again, side)[name], values)


def test_a_scene_without_the_number_is_named(data) -> None:
    with pytest.raises(UserError, match="no number load"):
        TrainingRange.of(data.runs("train"), 4, ("load",))


def test_modes_are_numbered_from_one() -> None:
    assert components("the soil's state", 4)[3] == " (mode 2, x)"
    assert components("depth", 1) == [""]
