"""Closures: known functions, the choice on other runs, the basis that holds one, and its way through a training."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from sgns.config import UserError
from sgns.data.run import Run
from sgns.reduction.basis import Basis
from sgns.reduction.closure import Closure, fit_closure
from sgns.reduction.reduce import reduce_dataset
from sgns.simulator import Simulator
from sgns.train.command import main, train
from sgns.train.validation import ValidationRollouts
from sgns_testing.commands import composed
from sgns_testing.tiny import FIT, POLYNOMIAL, REDUCTION, make_dataset

N, R, C = 40, 2, 3
KINDS = "kernel", "quadratic"


def modes() -> torch.Tensor:
    return torch.linalg.qr(torch.from_numpy(np.random.default_rng(0).normal(size=(N, R + C))))[0]


def curved(seed: int, frames: int = 30) -> np.ndarray:
    """Coordinates of a run from a family with two numbers; three modes are products of the first two's."""
    p, q = np.random.default_rng(seed).uniform(size=2)
    s = np.linspace(0.0, 1.0, frames)
    ways = [[s, s * p, s * q], [np.sin(3 * s) * (1 + p), s**2, np.cos(2 * s) * q]]
    z = 0.1 * np.array(ways).transpose(2, 0, 1)
    a, b = z[:, :1], z[:, 1:]
    return np.concatenate([z, 5 * a * a, 5 * a * b, 5 * b * b + 0.01], axis=1)


@cache
def fitted(kind: str, validation: int = 2):
    runs = [curved(seed) for seed in range(20)]
    return fit_closure(kind, modes(), R, runs[validation:], runs[:validation])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("validation", [2, 0])
def test_products_of_coordinates_are_found_on_an_unseen_run(kind, validation) -> None:
    found, new = fitted(kind, validation), torch.from_numpy(curved(99))
    assert found.error < 0.15 * found.without
    truth = new[:, R:]
    error = (found.closure.coordinates(new[:, :R]) - truth).square().mean() ** 0.5
    assert float(error) < 0.15 * float((truth - truth.mean(0)).square().mean() ** 0.5)


def shadow(seed: int) -> np.ndarray:
    """Two modes that are nearly one; the rest follows from their small difference, which no rollout gets right."""
    first, difference = curved(seed)[:, :1], 1e-3 * curved(seed)[:, 1:2]
    return np.concatenate([first, 0.5 * first + difference, *[1e2 * difference] * C], axis=1)


@pytest.mark.parametrize("kind", KINDS)
def test_errors_of_the_coordinates_do_not_grow(kind) -> None:
    runs, new = [shadow(seed) for seed in range(20)], torch.from_numpy(shadow(99))
    z, truth = new[:, :R], new[:, R:]
    chance = torch.Generator().manual_seed(1)
    missed = 0.2 * z.std(0) * torch.randn(z.shape, generator=chance, dtype=z.dtype)
    closure = fit_closure(kind, modes(), R, runs[2:], runs[:2]).closure
    errors = [g - truth for g in (closure.coordinates(z + missed), closure.offset)]
    error, without = (float(one.square().mean().sqrt()) for one in errors)
    assert error < 1.2 * without


@pytest.mark.parametrize("kind", KINDS)
def test_what_does_not_follow_is_left_at_its_mean(kind) -> None:
    chance = np.random.default_rng(1)
    runs = [
        np.concatenate([one[:, :R], chance.normal(size=(30, C, 3))], axis=1) for one in map(curved, range(8))
    ]
    found = fit_closure(kind, modes(), R, runs[2:], runs[:2])
    assert found.without * 0.9 < found.error < found.without * 1.02


def test_far_from_all_frames_it_is_their_mean() -> None:
    closure = fitted("kernel").closure
    torch.testing.assert_close(closure.coordinates(torch.full((R, 3), 1e3)).float(), closure.offset)


@pytest.mark.parametrize("kind", KINDS)
def test_frames_that_are_alike_make_no_trouble(kind) -> None:
    still = np.repeat(curved(3)[:1], 200, axis=0)
    found = fit_closure(kind, modes(), R, [still, *map(curved, range(4))], [curved(5)])
    assert found.error < found.without


@pytest.fixture(params=KINDS)
def basis(request) -> Basis:
    chance = np.random.default_rng(2)
    mean, values = (torch.from_numpy(chance.uniform(size=shape)) for shape in ((N, 3), R))
    return Basis(
        mean, modes()[:, :R], values, 4.0, 3.0, "particle_axis", closure=fitted(request.param).closure
    )


def test_decoding_adds_the_closures_modes(basis) -> None:
    latent = torch.from_numpy(curved(7))
    flat, closure = replace(basis, closure=None).inverse(latent[:, :R]), basis.closure
    expected = flat + torch.einsum("nc,tca->tna", closure.modes.double(), closure.coordinates(latent[:, :R]))
    soil = basis.inverse(latent[:, :R])
    torch.testing.assert_close(soil, expected, atol=1e-7, rtol=0)
    torch.testing.assert_close(basis.inverse(latent[3, :R]), soil[3], atol=1e-7, rtol=0)
    # What is stepped is found again: the closure's modes are at right angles to it.
    torch.testing.assert_close(basis.transform(soil), latent[:, :R], atol=1e-4, rtol=0)
    assert basis.sliced(1).closure is None
    assert basis.sliced(R).closure is closure is not None


def test_the_file_keeps_it_to_the_bit(basis, tmp_path) -> None:
    basis.save(tmp_path / "basis.h5")
    again, latent = Basis.load(tmp_path / "basis.h5"), torch.from_numpy(curved(7)[:, :R])
    assert torch.equal(again.inverse(latent), basis.inverse(latent))
    assert torch.equal(basis.to("cpu").inverse(latent), basis.inverse(latent))


@pytest.mark.parametrize("change", [lambda x: x[:-1], lambda x: x * torch.nan, lambda x: x.sum(), None])
def test_damaged_arrays_are_refused(basis, change) -> None:
    for name, value in basis.closure.state().items():
        state = basis.state()
        del state[f"closure_{name}"]
        if change:
            state[f"closure_{name}"] = change(value)
        with pytest.raises(UserError):
            Basis.from_state(state)


def test_a_closure_of_other_modes_is_refused(basis) -> None:
    with pytest.raises(UserError, match="closure is of 2 modes of 40 particles, the basis has 1 of 40"):
        replace(basis.sliced(1), closure=basis.closure)


@pytest.fixture(scope="module", params=KINDS)
def data(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    return reduce_dataset(
        make_dataset(folder, frames=30), REDUCTION | {"closure": request.param}, progress=False
    )


def test_a_dataset_says_what_its_closure_gains(data, caplog) -> None:
    kind = data.closure.kind
    with caplog.at_level("INFO"):
        dataset = make_dataset(data.folder.parents[1], frames=30)
        again = reduce_dataset(dataset, REDUCTION | {"closure": kind}, progress=False)
    assert f"{kind} closure: modes 5 to 6 follow from the first 4 with an RMSE of" in caplog.text
    assert "2 validation runs" in caplog.text
    assert again.closure.num_modes == 2 and again.of_modes(4).closure is again.closure
    assert again.of_modes(3).closure is None and again.of_modes(3).num_modes == 3
    assert reduce_dataset(make_dataset(data.folder.parents[1], frames=30), REDUCTION).closure is None


@pytest.mark.parametrize("change", [{"closure_modes": 4}, {"num_modes": 6}])
def test_a_closure_without_modes_is_refused(data, change) -> None:
    with pytest.raises(UserError, match=r"no modes to add .* raise reduction\.closure_modes"):
        reduce_dataset(
            make_dataset(data.folder.parents[1], frames=30),
            REDUCTION | {"closure": data.closure.kind} | change,
            progress=False,
        )


@pytest.fixture(scope="module")
def checkpoint(data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("trained")
    train(data, num_modes=4, model=POLYNOMIAL, training=FIT, output=folder)
    return folder / "best.ckpt"


def test_a_simulator_decodes_with_it(data, checkpoint) -> None:
    simulator, run = Simulator.load(checkpoint), data.runs("test")[0]
    latent = torch.from_numpy(run.latent[:, :4])
    assert torch.equal(simulator.basis.inverse(latent), data.of_modes(4).inverse(latent))
    state = simulator.reset(run.pose)
    np.testing.assert_array_equal(state.soil(), data.of_modes(4).inverse(state.latent).numpy())
    assert Simulator.load(checkpoint, num_modes=3).basis.closure is None


def test_only_decoding_is_changed(data, checkpoint, tmp_path) -> None:
    train(replace(data, closure=None), num_modes=4, model=POLYNOMIAL, training=FIT, output=tmp_path)
    closed, plain = Simulator.load(checkpoint), Simulator.load(tmp_path / "best.ckpt")
    poses = data.runs("test")[0].pose
    for name in ("latent", "force", "torque"):
        np.testing.assert_array_equal(
            getattr(closed.rollout(poses), name), getattr(plain.rollout(poses), name)
        )


def test_a_training_with_another_closure_is_another_training(data, checkpoint) -> None:
    with pytest.raises(UserError, match=f"closure is '{data.closure.kind} to 6 modes' there and None here"):
        train(
            replace(data, closure=None), num_modes=4, model=POLYNOMIAL, training=FIT, output=checkpoint.parent
        )
    assert train(data, num_modes=4, model=POLYNOMIAL, training=FIT, output=checkpoint.parent) > 0


def test_the_validation_error_is_that_of_decoded_soil(data, checkpoint) -> None:
    simulator, runs = Simulator.load(checkpoint, rate_independent=False), data.runs("validation")[:1]
    settings = simulator.dynamics.settings
    d, basis = settings.history, data.of_modes(4)
    score = ValidationRollouts(runs, 4, d, "pose", (), basis).measure(simulator.dynamics)
    with Run(runs[0].path) as run:
        truth = run.positions()
    latent = simulator.rollout(runs[0].pose, latent_history=runs[0].latent[:d, :4]).latent
    error = basis.inverse(latent).numpy()[d:] - truth[d:]
    assert score.position_rmse == pytest.approx(float(np.mean(error**2) ** 0.5), rel=1e-5)


def test_published_runs_have_nothing_to_decode(tmp_path) -> None:
    changes = (
        "dataset=published",
        f"dataset.path={tmp_path}",
        f"output={tmp_path}",
        "reduction.closure=kernel",
    )
    with pytest.raises(UserError, match=r"no particles to decode; use reduction\.closure=none"):
        main(composed(*changes, command="train"))


def test_shapes_say_what_belongs_together(basis) -> None:
    with pytest.raises(UserError, match="do not belong together"):
        Closure(**basis.closure.state() | {"offset": torch.zeros(C + 1, 3)})
