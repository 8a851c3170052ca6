"""Every option of model and training is trainable, and does what it says."""

import pytest
import torch
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf

from sgns.model.network_dynamics import LatentDynamics
from sgns.settings import ModelSettings, TrainingSettings
from sgns.train.command import train
from sgns.train.lightning_module import prepared
from sgns_testing.tiny import MODEL, TRAINING

OPTIONS = {
    "velocity": ({"predicts": "velocity"}, {}),
    "blind": ({"positions": False, "next_motion": False}, {}),
    "type": ({"identity": "type", "identity_width": 16}, {}),
    "star": ({"edges": "star"}, {}),
    "loops": ({"self_loops": True, "edge_length": False, "edge_scale": 0.025}, {}),
    "mean": ({"force": "mean", "torque": False}, {}),
    "context": ({"context": ["depth", "speed", "no_such_key", "gravity"]}, {}),
    "pooled": (
        {"body_nodes": "points"},
        {"scales": "pooled", "noise": 3e-4, "noise_unit": "metre", "change_of": "all"},
    ),
    "pooled pose": ({}, {"scales": "pooled"}),
    "horizon": ({}, {"horizon": 3}),
    "horizon of velocities": ({"predicts": "velocity"}, {"horizon": 3}),
    "fewer modes": ({}, {"fewer_modes": 1.0}),
    "exponential": ({}, {"schedule": "exponential", "decades": 4.0}),
}


def module_of(data, model=None, training=None):
    """A training module and its windows."""
    from sgns.train.lightning_module import SurrogateTraining

    settings = TrainingSettings.from_dict(TRAINING | (training or {}))
    torch.manual_seed(0)
    card = {"frame_rate": 60.0, "scene": data.runs("train")[0].scene}
    surrogate, windows = prepared(data, 4, ModelSettings(**(MODEL | (model or {}))), settings, 0, card, None)
    return SurrogateTraining(surrogate, settings), windows


@pytest.mark.parametrize("option", OPTIONS)
def test_it_trains_and_comes_back(data, tmp_path, option) -> None:
    model, training = OPTIONS[option]
    changes = TRAINING | training | {"learning_rate": 3e-3, "max_steps": 60, "validate_every": 60}
    assert train(data, num_modes=4, model=MODEL | model, training=changes, output=tmp_path) > -10.0
    module, windows = module_of(data, model, training)
    batch = windows.training_windows.batch(0, 8, windows.noise)
    losses = module.losses(batch)
    assert all(bool(torch.isfinite(loss)) for loss in losses.values())
    sum(losses.values()).backward()
    assert all(p.grad is not None for p in module.surrogate.dynamics.network.parameters())


def test_context_is_what_varies(data) -> None:
    module, windows = module_of(data, {"context": ["depth", "speed", "no_such_key", "gravity"]})
    assert module.surrogate.dynamics.context_keys == ("depth", "speed")
    batch = windows.training_windows.batch(0, 8, windows.noise)
    dynamics = module.surrogate.dynamics
    plain = dynamics(batch.history, batch.shown_body, batch.context)
    other = dynamics(batch.history, batch.shown_body, batch.context + 0.01)
    assert not torch.allclose(plain.force, other.force)


def test_later_steps_of_the_horizon_start_from_predictions(data) -> None:
    module, windows = module_of(data, training={"horizon": 2})
    batch = windows.training_windows.batch(0, 8, windows.noise)
    dynamics = module.surrogate.dynamics
    body = batch.shown_body
    first = dynamics.advance(batch.history, body.frames(slice(0, 3)))
    latent = torch.cat([batch.history[:, 1:], first.latent[:, None]], dim=1)
    second = dynamics.advance(latent, body.frames(slice(1, 4)))
    errors = [
        ((step.latent - batch.following[:, k]) / dynamics.change.scale / (1, 3)[k]).square().sum(-1).mean()
        for k, step in enumerate((first, second))
    ]
    torch.testing.assert_close(module.losses(batch)["change"].double(), sum(errors) / 2, rtol=1e-5, atol=0)
    force = [
        ((step.force - batch.force[:, k]) / dynamics.force.scale).square().sum(-1).mean()
        for k, step in enumerate((first, second))
    ]
    torch.testing.assert_close(module.losses(batch)["force"].double(), sum(force) / 2, rtol=1e-4, atol=0)


@pytest.mark.parametrize("edges", ["complete", "star"])
def test_a_rollout_does_not_stand_in_the_way_of_training(data, edges) -> None:
    module, windows = module_of(data, {"edges": edges})
    batch = windows.training_windows.batch(0, 8, windows.noise)
    with torch.inference_mode():
        module.surrogate.dynamics.advance(batch.history, batch.shown_body)
    module.losses(batch)["change"].backward()


def parameters(preset: str, modes: int = 8, **changes) -> int:
    """Weights of a preset's network for a blade."""
    with initialize_config_module("sgns.conf", version_base="1.3"):
        config = compose("train", [f"preset={preset}"])
    model = OmegaConf.to_container(config.model, resolve=True)
    TrainingSettings.from_dict(OmegaConf.to_container(config.training, resolve=True))
    return sum(p.numel() for p in LatentDynamics(ModelSettings(**(model | changes)), modes).parameters())


def mlp(inputs: int, outputs: int = 128, norm: bool = False) -> int:
    """Two hidden layers of 128."""
    return (inputs + 1) * 128 + 129 * 128 + 129 * outputs + 2 * 128 * norm


def test_presets_build_what_they_say() -> None:
    # Five velocities and a type vector of 16 on nodes; relative positions on edges; two type vectors.
    paper = mlp(5 * 3 + 16) + mlp(3) + mlp(3 * 128) + mlp(2 * 128) + mlp(128, 6) + 2 * 16
    assert parameters("paper") == paper == 252_710
    released = (
        mlp(5 * 3 + 16, norm=True) + mlp(4, norm=True) + mlp(128, 6) + 2 * 16
        + 10 * (mlp(3 * 128, norm=True) + mlp(2 * 128, norm=True))
    )  # fmt: skip
    assert parameters("released") == released
    # The pose node: place, two columns of its rotation, three motions of six numbers, a vector of its own.
    default = mlp(3 + 6 + 18 + 8) + mlp(4) + mlp(3 * 128) + mlp(2 * 128) + mlp(128, 9) + 9 * 8
    assert parameters("default") == default
