"""One latent step and whole paths: forces add up, rollouts are steps, modes have identities."""

from __future__ import annotations

import pytest
import torch
from tiny import MODEL, reduced

from sgns.errors import UserError
from sgns.learning.body import BodyTrack
from sgns.learning.data import TrainingWindows
from sgns.learning.dynamics import LatentDynamics
from sgns.learning.model_settings import ModelSettings
from sgns.learning.statistics import fit_normalisation


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return reduced(tmp_path_factory.mktemp("tiny"))


def fitted(data, body_nodes: str = "pose") -> tuple[LatentDynamics, TrainingWindows]:
    torch.manual_seed(0)
    settings = ModelSettings(**(MODEL | {"body_nodes": body_nodes}))
    windows = TrainingWindows(data.runs("train"), 4, settings.history, body_nodes)
    dynamics = LatentDynamics(settings, 4)
    fit_normalisation(dynamics, windows, 0.1, "velocity", "per_mode", 0.01)
    return dynamics.requires_grad_(False), windows


@pytest.mark.parametrize("body_nodes", ["pose", "points"])
def test_force_is_the_sum_of_contributions(data, body_nodes) -> None:
    dynamics, windows = fitted(data, body_nodes)
    batch = windows.windows(windows.targets[5:9])
    prediction = dynamics(batch.history, batch.body)
    nodes = 4 + (1 if body_nodes == "pose" else 15)
    contributions, turning = dynamics.force_contributions(prediction)
    assert contributions.shape == turning.shape == (4, nodes, 3)
    _, force, torque, _ = dynamics.advance(batch.history, batch.body)
    torch.testing.assert_close(contributions.sum(1), force)
    torch.testing.assert_close(turning.sum(1), torque)
    # The mean is in the sum once, however many nodes share it.
    torch.testing.assert_close(
        force, dynamics.force.mean + dynamics.force.scale * prediction.force.sum(1).double()
    )


def test_position_update(data) -> None:
    dynamics, windows = fitted(data)
    batch = windows.windows(windows.targets[5:9])
    following, *_ = dynamics.advance(batch.history, batch.body)
    acceleration = dynamics.change.denormalise(dynamics(batch.history, batch.body).change[:, :4])
    z = batch.history
    torch.testing.assert_close(following, z[:, -1] + (z[:, -1] - z[:, -2]) + acceleration)


def test_unrolling_is_stepping(data) -> None:
    dynamics, windows = fitted(data)
    frames = torch.arange(10)
    body = BodyTrack(*(part[frames][None] for part in windows.body))
    latent, force, *_ = dynamics.unroll(windows.latent[None, :3], body)
    states = [windows.latent[i] for i in range(3)]
    for t in range(3, 10):
        z, f, *_ = dynamics.advance(torch.stack(states[-3:])[None], body.frames(slice(t - 2, t + 1)))
        states.append(z[0])
        assert torch.equal(f[0], force[0, t])
    assert torch.equal(torch.stack(states), latent[0])
    assert not force[0, :3].any()


def test_the_tools_next_motion_is_seen_and_later_ones_are_not(data) -> None:
    dynamics, windows = fitted(data)
    batch = windows.windows(windows.targets[5:6])
    moved = batch.body._replace(motion=batch.body.motion.clone())
    moved.motion[:, -1] += 0.01
    assert not torch.equal(dynamics(batch.history, moved).force, dynamics(batch.history, batch.body).force)
    # Where it will be follows from the motion; it is not given twice.
    placed = batch.body._replace(position=batch.body.position.clone())
    placed.position[:, -1] += 1.0
    assert torch.equal(dynamics(batch.history, placed).force, dynamics(batch.history, batch.body).force)


def test_modes_are_told_apart(data) -> None:
    dynamics, windows = fitted(data)
    batch = windows.windows(windows.targets[5:6])
    for standard in (dynamics.position, dynamics.velocity):
        standard.mean.zero_(), standard.scale.fill_(1.0)
    order = torch.tensor([1, 0, 2, 3])
    swapped = dynamics(batch.history[:, :, order], batch.body).change[:, order]
    plain = dynamics(batch.history, batch.body).change[:, :4]
    assert not torch.allclose(swapped, plain)
    # With their identities exchanged as well, only names have changed.
    weight = dynamics.identity.weight
    weight[:2] = weight[[1, 0]].clone()
    swapped = dynamics(batch.history[:, :, order], batch.body).change[:, order]
    torch.testing.assert_close(swapped, plain)


@pytest.mark.parametrize(
    ("key", "value"),
    [("history", 1), ("hidden_layers", 0), ("body_nodes", "mesh"), ("activation", "step")],
)
def test_wrong_settings_name_their_key(key, value) -> None:
    with pytest.raises(UserError, match=f"model.{key}"):
        ModelSettings(**(MODEL | {key: value}))
