"""Windows, padding, noise and the target that corrects it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from sgns.config import UserError
from sgns.model.network_dynamics import LatentDynamics
from sgns.settings import ModelSettings
from sgns.train.windows import (
    NoiseScales,
    TrainingWindows,
    WindowLoader,
    fit_normalisation,
    generator,
    random_walk,
)
from sgns_testing.tiny import MODEL


def windows_of(data, history: int = 3, seed: int = 0) -> TrainingWindows:
    return TrainingWindows(data.runs("train"), 4, history, "pose", seed)


SERIES = ("latent", "time", "pose", "body_points", "force", "torque")


def still(scale: float | torch.Tensor = 0.0) -> NoiseScales:
    """Noise on the modes only."""
    return NoiseScales(scale * torch.ones(4, 3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))


def test_every_frame_but_the_first_is_a_target(data) -> None:
    windows = windows_of(data)
    assert len(windows) == 4 * 13
    batch = windows.windows(windows.targets)
    for i, run in enumerate(data.runs("train")):
        rows = slice(13 * i, 13 * (i + 1))
        np.testing.assert_array_equal(batch.latent[rows, -1], run.latent[1:, :4])
        np.testing.assert_array_equal(batch.force[rows, 0], run.force[1:])
        np.testing.assert_array_equal(batch.body.position[rows, -1, 0], run.pose[1:, :3])


@pytest.mark.parametrize("number", [0, 1])
def test_every_run_starts_at_rest(data, number) -> None:
    windows = windows_of(data, history=4)
    first = windows.windows(windows.targets[13 * number : 13 * number + 1])
    start = data.runs("train")[number].latent[0, :4]
    for position in range(4):
        np.testing.assert_array_equal(first.latent[0, position], start)
    # The tool moves only into the frame to be predicted.
    assert not first.body.motion[0, :-1].any()
    assert first.body.motion[0, -1].any()


def test_batches_depend_on_seed_and_step_only(data) -> None:
    scale = still(torch.rand(4, 3, dtype=torch.float64))
    stream = iter(WindowLoader(windows_of(data), 8, scale))
    for _ in range(9):
        drawn = next(stream)
    alone = windows_of(data).batch(8, 8, scale)
    assert torch.equal(drawn.latent, alone.latent) and torch.equal(drawn.noise, alone.noise)
    other = windows_of(data, seed=1).batch(8, 8, scale)
    assert not torch.equal(other.noise, alone.noise)


def test_every_window_is_drawn_equally_often(data) -> None:
    windows = windows_of(data)
    seen = torch.cat([windows.batch(step, 64, still()).latent[:, -1] for step in range(130)])
    counts = torch.unique(seen.flatten(1), dim=0, return_counts=True)[1]
    # 160 each on average, with a deviation of 12.6 by chance.
    assert len(counts) == 52 and 105 < counts.min() and counts.max() < 215


def test_runs_with_other_numbers_of_points_are_kept_apart(data) -> None:
    runs = data.runs("train")
    runs[1] = replace(runs[1], body_points=runs[1].body_points[:, :6])
    windows = TrainingWindows(runs, 4, 3, "points")
    drawn = [windows.batch(step, 8, still()) for step in range(40)]
    counts = [batch.body.position.shape[2] for batch in drawn]
    assert set(counts) == {6, 15} and 3 <= counts.count(6) <= 20
    assert all(bool(torch.isfinite(part).all()) for batch in drawn for part in batch.shown_body)
    settings = ModelSettings(**(MODEL | {"body_nodes": "points"}))
    for scales in ("per_mode", "pooled"):
        dynamics = LatentDynamics(settings, 4)
        fit_normalisation(dynamics, windows, 0.1, "velocity", scales, 0.01)
        assert all(bool(torch.isfinite(value).all()) for value in dynamics.state_dict().values())


def test_noise_is_a_walk_of_the_stated_size() -> None:
    scale = torch.tensor([[1.0, 2.0, 0.0]], dtype=torch.float64)
    noise = random_walk(scale, (20000, 5), generator(0, 0, 1))
    assert not noise[:, 0].any()
    velocity = noise.diff(dim=1)
    for k in range(4):
        expected = scale[0] * ((k + 1) / 4) ** 0.5
        torch.testing.assert_close(velocity[:, k, 0].std(0), expected, rtol=0.03, atol=1e-12)
    # Increments of the velocity are independent.
    steps = velocity.diff(dim=1)
    correlation = (steps[:, 0, 0] * steps[:, 1, 0]).mean(0)
    assert correlation.abs().max() < 0.03


def test_the_target_undoes_the_noise_of_the_velocity(data) -> None:
    batch = windows_of(data).batch(0, 8, still(1e-3))
    clean_velocity = batch.latent[:, -1] - batch.latent[:, -2]
    torch.testing.assert_close(
        batch.following[:, 0] - batch.history[:, -1], clean_velocity, rtol=0, atol=1e-12
    )


def test_noise_of_the_body_moves_its_motion_along(data) -> None:
    noise = NoiseScales(
        torch.zeros(4, 3, dtype=torch.float64), torch.tensor([0.0, 0.0, 1e-3], dtype=torch.float64)
    )
    batch = windows_of(data).batch(0, 8, noise)
    shown, clean = batch.shown_body, batch.body
    assert torch.equal(shown.position[..., :2], clean.position[..., :2])
    torch.testing.assert_close(
        shown.position[:, :2, 0, 2] - clean.position[:, :2, 0, 2], batch.body_noise[:, 1:, 0, 2]
    )
    torch.testing.assert_close(
        shown.motion[:, 1, :, :3], shown.position[:, 1] - shown.position[:, 0], rtol=0, atol=1e-12
    )
    # The motion into the target is the true one: the position error of the history stays.
    torch.testing.assert_close(shown.motion[:, -1], clean.motion[:, -1], rtol=0, atol=1e-12)


def test_a_horizon_gives_as_many_targets(data) -> None:
    windows = TrainingWindows(data.runs("train"), 4, 3, "pose", horizon=4)
    assert len(windows) == 4 * 10
    batch = windows.windows(windows.targets)
    run = data.runs("train")[1]
    np.testing.assert_array_equal(batch.following[10], run.latent[1:5, :4])
    np.testing.assert_array_equal(batch.force[19], run.force[10:14])
    assert batch.body.position.shape[1] == 2 + 4
    np.testing.assert_array_equal(batch.body.position[19, -1, 0], run.pose[13, :3])


def test_runs_shorter_than_the_horizon_are_left_out_and_named_if_all_are(data) -> None:
    runs = data.runs("train")
    short = replace(runs[0], **{name: getattr(runs[0], name)[:3] for name in SERIES})
    assert len(TrainingWindows([short, runs[1]], 4, 3, "pose", horizon=4)) == 10
    with pytest.raises(UserError, match=r"too short for training\.horizon=4: they need 5 frames"):
        TrainingWindows([short], 4, 3, "pose", horizon=4)


def test_normalised_training_quantities_are_of_order_one(data) -> None:
    windows = windows_of(data)
    dynamics = LatentDynamics(ModelSettings(**MODEL), 4)
    noise = fit_normalisation(dynamics, windows, 0.1, "velocity", "per_mode", 0.01)
    torch.testing.assert_close(noise.latent, 0.1 * dynamics.velocity.scale)
    assert not noise.body.any()
    batch = windows.windows(windows.targets)
    velocity = dynamics.velocity.normalise(batch.latent.diff(dim=1)[:, -1])
    assert 0.9 < float(velocity[:, 0, 0].square().mean()) < 1.1
    assert float(dynamics.force.normalise(batch.force).abs().max()) < 10
    assert torch.isfinite(dynamics.body_motion.normalise(batch.body.motion)).all()
    assert torch.isfinite(dynamics.body_orientation.normalise(batch.body.orientation)).all()
