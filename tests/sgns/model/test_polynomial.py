"""Polynomial latent dynamics: known systems are found, rollouts are steps, nothing runs away."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sgns.config import UserError
from sgns.model.features import BodyTrack
from sgns.model.polynomial import PolynomialDynamics, normalised, polynomial_terms
from sgns.settings import PolynomialSettings
from sgns.train.polynomial import (
    Selection,
    Setting,
    candidates,
    coefficients,
    moments,
    refitted,
    ridge,
    select,
    take,
    unfitted,
)
from sgns.train.validation import ValidationRollouts
from sgns.train.windows import TrainingWindows

HISTORY = 3


def windows_of(runs, modes: int = 4, context=()) -> TrainingWindows:
    return TrainingWindows(runs, modes, HISTORY, "pose", context=context)


def blank(windows, degree: int) -> PolynomialDynamics:
    return unfitted(windows, PolynomialSettings(HISTORY, degree, []))


def fit(windows, degree: int, motion: Setting, force: Setting) -> PolynomialDynamics:
    model = blank(windows, degree)
    refitted(model, windows, Selection(motion, motion, force))
    return model


def with_known_law(data, law):
    """Runs of random tool paths and random starts whose two modes, force and torque follow a law.

    They are short and many: within a run the law ties the newest velocity to the other inputs, so that only the starts
    tell which of them a step depends on.

    Args:
        data: Where the rest of a run comes from.
        law: (latent history (3, 2, 3), displacement (3,)) -> velocity (2, 3), force (3,), torque (3,).
    """
    rng = np.random.default_rng(0)
    runs = []
    frames, pattern = 8, data.runs("train")[0]
    for _ in range(220):
        pose = np.zeros((frames, 7))
        pose[:, 6] = 1.0
        pose[:, :3] = np.cumsum(0.01 * rng.standard_normal((frames, 3)), axis=0)
        latent = np.zeros((frames, 2, 3))
        latent[0] = rng.standard_normal((2, 3))
        force, torque = np.zeros((frames, 3)), np.zeros((frames, 3))
        shown = [latent[0]] * HISTORY
        for t in range(1, frames):
            velocity, force[t], torque[t] = law(np.array(shown), pose[t, :3] - pose[t - 1, :3])
            latent[t] = latent[t - 1] + velocity
            shown = [*shown[1:], latent[t]]
        time = np.arange(frames) / 60.0
        runs.append(replace(pattern, latent=latent, pose=pose, force=force, torque=torque, time=time))
    return runs


def linear_law(shown, step):
    velocity = shown[-1] - shown[-2]
    move = 0.3 * velocity[::-1] - 0.05 * shown[-1] + np.outer([1.0, -0.5], step)
    return move, 100.0 * step + shown[-1, 0], 7.0 + shown[-1, 1] - 20.0 * step


def unbound(model) -> PolynomialDynamics:
    """The model, its inputs held to no range."""
    model.bounds.copy_(torch.tensor([[-torch.inf], [torch.inf]]))
    return model


def check_rollouts(model, runs) -> None:
    """A law found exactly holds outside the range of the training runs, too."""
    unbound(model)
    rollouts = ValidationRollouts(runs, 2, HISTORY, "pose")
    score = rollouts.measure(model)
    assert min(score.skill, score.skill_at_rest) > 1 - 1e-9
    assert max(score.force_nrmse, score.force_nrmse_at_rest) < 1e-5


def test_terms_are_all_monomials_once() -> None:
    assert polynomial_terms(3, 1).tolist() == [[0, 0], [0, 1], [0, 2], [0, 3]]
    pairs = {tuple(pair) for pair in polynomial_terms(3, 2).tolist()}
    assert pairs == {(i, j) for i in range(4) for j in range(i, 4)}
    assert polynomial_terms(3, 2)[0].tolist() == [0, 0]


def test_monomials_are_products_of_inputs(data) -> None:
    windows = windows_of(data.runs("train"))
    model = blank(windows, 2)
    batch = windows.windows(windows.targets)
    inputs = normalised(model.inputs, model.raw_inputs(batch.history, batch.body, None))[:, model.used]
    # Inputs that never move are left out; the others are of order one.
    assert (inputs.std(0) > 0.01).all() and len(model.used) < len(model.inputs.mean)
    values = model.monomials(batch.history, batch.body, None)
    for place, (i, j) in enumerate(model.terms.tolist()):
        expected = torch.ones(len(inputs), dtype=torch.float64)
        for factor in (i, j):
            expected = expected * (inputs[:, factor - 1] if factor else 1.0)
        torch.testing.assert_close(values[:, place], expected)


def test_unfitted_stands_still_with_the_mean_force(data) -> None:
    windows = windows_of(data.runs("train"))
    batch = windows.windows(windows.targets[:5])
    step = blank(windows, 2).advance(batch.history, batch.body)
    assert torch.equal(step.latent, batch.history[:, -1])
    assert torch.equal(step.displacement, batch.body.motion[:, -1, :, :3])
    for found, series in ((step.force, windows.force), (step.torque, windows.torque)):
        mean = series[windows.targets].double().mean(0)
        torch.testing.assert_close(found, mean.expand(5, 3))


@pytest.mark.parametrize("degree", [1, 2])
def test_ridge_finds_a_linear_system(data, degree) -> None:
    runs = with_known_law(data, linear_law)
    # Without a penalty the law is exact on runs that are held out, too.
    model = fit(windows_of(runs[:-20], 2), degree, Setting(0.0, 0.0), Setting(0.0, 0.0))
    check_rollouts(model, runs[-20:])


def test_noise_is_on_the_inputs_and_not_on_the_targets(data) -> None:
    windows = windows_of(data.runs("train"))
    model = unbound(blank(windows, 1))
    clean, noisy = moments(model, windows, draws=1), moments(model, windows, noise=0.5, draws=40)
    # Raw inputs are 12 positions, then 12 older and 12 newest velocities.
    moving = [(place, int(raw)) for place, raw in enumerate(model.used, 1) if 24 <= raw < 36]
    assert len(moving) > 4
    for place, raw in moving:
        added = (0.5 * model.velocity.scale[raw - 24] / model.inputs.scale[raw]) ** 2
        torch.testing.assert_close(
            noisy.gram[place, place] - clean.gram[place, place], added, rtol=0.2, atol=0.0
        )
    # With the constant, targets average to the same.
    torch.testing.assert_close(noisy.target[0], clean.target[0])
    again = moments(model, windows, noise=0.5, draws=40)
    assert torch.equal(again.gram, noisy.gram)


def test_penalty_draws_towards_the_mean(data) -> None:
    windows = windows_of(data.runs("train"))
    model = blank(windows, 2)
    known = moments(model, windows)
    sizes = [ridge(known, penalty)[1:].norm() for penalty in (1e-3, 1e-1, 1e1, 1e9)]
    assert sizes == sorted(sizes, reverse=True) and sizes[-1] < 1e-6
    # The constant is free.
    torch.testing.assert_close(ridge(known, 1e9)[0], known.target[0], rtol=1e-6, atol=1e-6)


def test_nothing_runs_away_outside_the_known_range(data) -> None:
    windows = windows_of(data.runs("train"))
    model = blank(windows, 2)
    model.weights.copy_(10.0 * ridge(moments(model, windows), 1e-6))  # unstable
    batch = windows.windows(windows.targets[:4])
    body = BodyTrack(*(part[:, -1:].expand(-1, 300, -1, -1) for part in batch.body))
    latent, force, _, _ = model.unroll(batch.history, body)
    largest = model.monomials(batch.history, batch.body, None).shape[1] * float(
        model.bounds.abs().amax().clamp_min(1.0) ** 2 * model.weights.abs().max() * model.velocity.scale.max()
    )
    assert float((latent[:, 1:] - latent[:, :-1]).abs().max()) <= largest + float(windows.latent.abs().max())
    assert torch.isfinite(force).all()


def test_settings_are_chosen_by_rollouts(data) -> None:
    windows = windows_of(data.runs("train"))
    rollouts = ValidationRollouts(data.runs("validation"), 4, HISTORY, "pose")
    model = blank(windows, 1)
    known = {noise: moments(model, windows, noise) for noise in (0.0, 0.3)}
    found = candidates(known, (1e-3, 1e-1))
    motion, _, force = select(model, found, rollouts)
    assert len(found) == 4
    chosen = rollouts.measure(model)
    for weights in found.values():
        model.weights.copy_(weights)
        assert rollouts.measure(model).skill <= chosen.skill
    # The force is chosen along the chosen motion, from settings of its own.
    modes = 3 * model.num_modes
    for weights in found.values():
        model.weights.copy_(torch.cat([found[motion][:, :modes], weights[:, modes:]], dim=1))
        assert rollouts.measure(model).force_nrmse >= chosen.force_nrmse
    again = fit(windows, 1, motion, force)
    assert again.num_terms == model.num_terms
    torch.testing.assert_close(rollouts.measure(again).force, chosen.force)


def wheels(data, count: int = 220, frames: int = 8):
    """Short runs of wheels on random ways, whose height, two modes and force are linear in what is known before a
    step, and in the load."""
    rng = np.random.default_rng(1)
    runs, pattern = [], data.runs("train")[0]
    for _ in range(count):
        load = float(rng.uniform(50.0, 150.0))
        pose = np.zeros((frames, 7))
        pose[:, 6] = 1.0
        pose[:, 0] = np.cumsum(0.01 * rng.standard_normal(frames))
        pose[0, 2] = 0.02 * rng.standard_normal()
        latent = np.zeros((frames, 2, 3))
        latent[0] = rng.standard_normal((2, 3))
        force = np.zeros((frames, 3))
        for t in range(1, frames):
            before, last = max(t - 2, 0), t - 1
            drive = pose[t, 0] - pose[t - 1, 0]
            fall = pose[last, 2] - pose[before, 2]
            rise = 0.4 * fall - 0.1 * pose[last, 2] + 0.3 * drive + 1e-3 * latent[last, 0, 2] - 2e-5 * load
            velocity = latent[last] - latent[before]
            latent[t] = latent[last] + 0.3 * velocity - 0.05 * latent[last] + fall + drive + 1e-4 * load
            pose[t, 2] = pose[last, 2] + rise
            force[t] = 30.0 * drive + latent[last, 1] + 500.0 * fall + 0.1 * load
        scene, torque, time = {"kind": "wheel", "load": load}, np.zeros((frames, 3)), np.arange(frames) / 60.0
        runs.append(
            replace(pattern, latent=latent, pose=pose, force=force, torque=torque, time=time, scene=scene)
        )
    return runs


def blank_wheel(windows, context=("load",)) -> PolynomialDynamics:
    return unfitted(windows, PolynomialSettings(HISTORY, 1, ["load"]), tuple(context), predicts_body=True)


def fitted_wheel(runs, context) -> PolynomialDynamics:
    windows = windows_of(runs, 2, context)
    model = blank_wheel(windows, context)
    refitted(model, windows, Selection(*[Setting(0.0, 0.0)] * 3))
    return unbound(model)


def test_a_wheels_height_is_predicted_and_the_load_is_used(data) -> None:
    runs = wheels(data)
    rollouts = ValidationRollouts(runs[-20:], 2, HISTORY, "pose", ["load"])
    score = rollouts.measure(fitted_wheel(runs[:-20], ["load"]))
    assert min(score.skill, score.skill_at_rest) > 1 - 1e-9 and score.force_nrmse < 1e-5
    assert score.body_rmse < 1e-7
    # Not told the load, it has to guess.
    ignorant = ValidationRollouts(runs[-20:], 2, HISTORY, "pose").measure(fitted_wheel(runs[:-20], []))
    assert ignorant.body_rmse > 1e-4 and ignorant.force_nrmse > 1e-3


def test_where_a_wheel_will_be_is_not_looked_at(data) -> None:
    runs = wheels(data)
    model = fitted_wheel(runs, ["load"])
    windows = windows_of(runs[:3], 2, ["load"])
    batch = windows.windows(windows.targets)
    seen = model.advance(batch.history, batch.body, batch.context)
    elsewhere = batch.body.moved_last(batch.body.motion[:, -1, :, :3] + torch.tensor([0.0, 0.0, 1.0]))
    again = model.advance(batch.history, elsewhere, batch.context)
    for one, other in zip(seen, again, strict=True):
        assert torch.equal(one, other)
    assert torch.equal(seen.displacement[..., :2], batch.body.motion[:, -1, :, :2])
    with pytest.raises(UserError, match="this polynomial needs the scene's load"):
        model.advance(batch.history, batch.body)


def test_noise_moves_a_free_body_as_well(data) -> None:
    windows = windows_of(wheels(data, 40), 2, ["load"])
    model = unbound(blank_wheel(windows))
    clean, noisy = (moments(model, windows, noise, draws=20) for noise in (0.0, 0.5))
    # The newest past rise is the last input before the context; its noise is that of the newest velocity.
    place = len(model.inputs.mean) - 2
    column = 1 + model.used.tolist().index(place)
    added = (0.5 * model.body_displacement.scale[0] / model.inputs.scale[place]) ** 2
    found = noisy.gram[column, column] - clean.gram[column, column]
    torch.testing.assert_close(found, added, rtol=0.1, atol=0.0)
    torch.testing.assert_close(noisy.target[0], clean.target[0])


def test_fewer_modes_are_the_others_at_their_mean(data) -> None:
    windows = windows_of(data.runs("train"))
    model = fit(windows, 2, Setting(0.1, 1e-2), Setting(0.1, 1e-2))
    batch = windows.windows(windows.targets[:20])
    held = batch.history.clone()
    held[:, :, 2:] = model.inputs.mean[: 3 * 4].unflatten(0, (4, 3))[2:]
    step = model.advance(held, batch.body)
    fewer = model.with_modes(2)
    assert (fewer.num_modes, fewer.history) == (2, HISTORY)
    found = fewer.advance(held[:, :, :2], batch.body)
    torch.testing.assert_close(found.latent, step.latent[:, :2])
    torch.testing.assert_close(found.force, step.force)
    assert torch.equal(model.with_modes(4).weights, model.weights)


def test_a_free_body_is_chosen_by_its_own_error(data) -> None:
    runs = wheels(data, 40)
    windows = windows_of(runs[:-5], 2, ["load"])
    model = blank_wheel(windows)
    rollouts = ValidationRollouts(runs[-5:], 2, HISTORY, "pose", ["load"])
    found = candidates({noise: moments(model, windows, noise) for noise in (0.0, 1.0)}, (1e-4, 1.0))
    selection = select(model, found, rollouts)
    best = rollouts.measure(model).body_rmse
    for setting in found:
        take(model, found[selection.motion], found[setting], found[selection.motion])
        assert rollouts.measure(model).body_rmse >= best
    assert best < rollouts.measure(blank_wheel(windows)).body_rmse


def test_without_products_is_the_linear_fit(data) -> None:
    windows = windows_of(data.runs("train"))
    quadratic, linear = blank(windows, 2), blank(windows, 1)
    setting = Setting(0.1, 1e-2, linear=True)
    found = coefficients(moments(quadratic, windows, 0.1), setting)
    alone = ridge(moments(linear, windows, 0.1), 1e-2)
    torch.testing.assert_close(found[: len(alone)], alone)
    assert not found[len(alone) :].any()
    known = {0.1: moments(quadratic, windows, 0.1)}
    assert len(candidates(known, (1e-2, 1.0), linear=True)) == 2 * len(candidates(known, (1e-2, 1.0)))
