"""One latent step and whole paths: forces add up, modes have identities, one path is stepped as many are."""

from typing import Any

import numpy as np
import pytest
import torch

from mpm_warp.poses import in_world_frame
from sgns.model.features import BodyTrack, body_track
from sgns.model.network_dynamics import LatentDynamics
from sgns.settings import ModelSettings
from sgns.train.windows import TrainingWindows, fit_normalisation
from sgns_testing.tiny import MODEL


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
    assert prediction.force.shape == prediction.torque.shape == (4, nodes, 3)
    _, force, torque, _ = dynamics.advance(batch.history, batch.body)
    # The mean is in the sum once, however many nodes share it.
    for found, unit, shares in (
        (force, dynamics.force, prediction.force),
        (torque, dynamics.torque, prediction.torque),
    ):
        torch.testing.assert_close(found, unit.mean + unit.scale * shares.sum(1).double())


def test_position_update(data) -> None:
    dynamics, windows = fitted(data)
    batch = windows.windows(windows.targets[5:9])
    following, *_ = dynamics.advance(batch.history, batch.body)
    acceleration = dynamics.change.denormalise(dynamics(batch.history, batch.body).change[:, :4])
    z = batch.history
    torch.testing.assert_close(following, z[:, -1] + (z[:, -1] - z[:, -2]) + acceleration)


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


# --- The stepper of one path against `advance`, whatever the network sees and predicts ------------------

POINTS = np.random.default_rng(0).normal(size=(5, 3)) * 0.1


def dynamics_of(predicts_body: bool = False, **kw: Any) -> LatentDynamics:
    """A network with random weights and statistics."""
    torch.manual_seed(3)
    settings = ModelSettings(**(MODEL | kw))
    dynamics = LatentDynamics(settings, 4, tuple(settings.context), predicts_body).requires_grad_(False)
    for name in ("position", "velocity", "body_position", "body_motion", "force", "torque", "context"):
        standard = getattr(dynamics, name)
        standard.mean.normal_()
        standard.scale.uniform_(0.5, 2.0)
    # Small changes, as in a real bed: the path stays where the network knows it.
    for name in ("change", "body_change"):
        getattr(dynamics, name).scale.uniform_(0.01, 0.02)
    return dynamics


def track_of(body_nodes: str, turning: bool, frames: int = 12) -> BodyTrack:
    """A body on a random way, turning about y or not; one path."""
    poses = np.zeros((frames, 7))
    poses[:, :3] = np.random.default_rng(1).normal(size=(frames, 3)).cumsum(axis=0) * 0.02
    angle = np.linspace(0.0, 1.0, frames) if turning else np.full(frames, 0.3)
    poses[:, 4], poses[:, 6] = np.sin(angle / 2), np.cos(angle / 2)
    return BodyTrack(*(part[None] for part in body_track(poses, in_world_frame(poses, POINTS), body_nodes)))


def step_by_step(dynamics, latent, body, context=None):
    """Positions and forces by `advance`, a prescribed body."""
    states, loads = [*latent[0]], []
    for t in range(dynamics.history, body.position.shape[1]):
        window = body.frames(slice(t - dynamics.history + 1, t + 1))
        step = dynamics.advance(torch.stack(states[-dynamics.history :])[None], window, context)
        states.append(step.latent[0])
        loads.append(torch.cat([step.force[0], step.torque[0]]))
    return torch.stack(states), torch.stack(loads)


VARIANTS: list[dict[str, Any]] = [
    {},
    {"positions": False},
    {"edge_scale": 0.05, "edge_length": False},
    {"identity": "type", "force": "mean"},
    {"torque": False, "predicts": "velocity"},
    {"edges": "star"},
    {"self_loops": True, "history": 4},
    {"layer_norm": True, "residual": True, "message_passing_steps": 2},
    {"next_motion": False, "activation": "gelu", "hidden_layers": 1},
]


@pytest.mark.parametrize("turning", [False, True])
@pytest.mark.parametrize("body_nodes", ["pose", "points"])
@pytest.mark.parametrize("variant", VARIANTS, ids=str)
def test_following_is_advancing(variant, body_nodes, turning) -> None:
    dynamics = dynamics_of(body_nodes=body_nodes, **variant)
    body, latent = track_of(body_nodes, turning), torch.randn(1, dynamics.history, 4, 3).double()
    states, loads = step_by_step(dynamics, latent, body)
    with torch.no_grad():
        path = dynamics.unroll(latent, body)
    torch.testing.assert_close(path.latent[0], states, rtol=0.0, atol=1e-6 * float(states.abs().max()))
    found = torch.cat([path.force, path.torque], -1)[0, dynamics.history :]
    torch.testing.assert_close(found, loads, rtol=0.0, atol=1e-6 * float(loads.abs().max()))
    assert not path.latent.is_inference()


def test_the_context_is_told() -> None:
    dynamics = dynamics_of(context=["gravity", "load"])
    body, latent = track_of("pose", True), torch.randn(1, 3, 4, 3).double()
    found = []
    for context in (torch.tensor([[9.8, 100.0]]).double(), torch.tensor([[1.6, 100.0]]).double()):
        states, _ = step_by_step(dynamics, latent, body, context)
        with torch.no_grad():
            found.append(dynamics.unroll(latent, body, context).latent[0])
        torch.testing.assert_close(found[-1], states, rtol=0.0, atol=1e-6 * float(states.abs().max()))
    assert not torch.allclose(*found)


@pytest.mark.parametrize("body_nodes", ["pose", "points"])
def test_a_predicted_body_is_the_same_alone_and_among_others(body_nodes) -> None:
    dynamics = dynamics_of(predicts_body=True, body_nodes=body_nodes)
    body, latent = track_of(body_nodes, True), torch.randn(1, 3, 4, 3).double()
    with torch.no_grad():
        alone = dynamics.unroll(latent, body)
        twice = dynamics.unroll(latent.expand(2, -1, -1, -1), BodyTrack(*(torch.cat([p, p]) for p in body)))
    for name in ("latent", "force"):
        one, both = getattr(alone, name)[0], getattr(twice, name)[1]
        torch.testing.assert_close(one, both, rtol=0.0, atol=1e-6 * float(both.abs().max()))
    torch.testing.assert_close(alone.body.position[0], twice.body.position[1], rtol=0.0, atol=1e-6)


def test_with_gradients_the_weights_are_differentiated() -> None:
    dynamics = dynamics_of().requires_grad_(True)
    body, latent = track_of("pose", False), torch.randn(1, 3, 4, 3).double()
    dynamics.unroll(latent, body).force.sum().backward()
    assert all(p.grad is not None for p in dynamics.network.parameters())
