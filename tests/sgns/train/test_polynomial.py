"""`sgns train model=polynomial`: the same folder as a network's, chosen by rollouts, refused in plain words."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sgns.config import UserError
from sgns.model.checkpoint import load_surrogate
from sgns.model.polynomial import PolynomialDynamics
from sgns.settings import FitSettings, PolynomialSettings
from sgns.train import polynomial as module
from sgns.train.command import train
from sgns.train.polynomial import best_polynomial
from sgns.train.validation import ValidationRollouts
from sgns_testing.commands import refusal, sgns
from sgns_testing.tiny import FIT, MODEL, POLYNOMIAL, TRAINING, make_dataset


def run(data, output, model=POLYNOMIAL, training=FIT, **kw) -> float:
    return train(data, num_modes=4, model=model, training=training, output=output, seed=3, **kw)


def without_validation(data, count: int):
    """The dataset with the first training runs only."""
    return replace(data, _runs={"train": data.runs("train")[:count], "validation": [], "test": []})


def fitted(runs, choosing, basis=None, **changes):
    settings = PolynomialSettings(**POLYNOMIAL), FitSettings.from_dict(FIT | changes)
    return best_polynomial(runs, choosing, 4, *settings, seed=3, basis=basis)


def test_what_is_written_is_what_was_fitted(data, tmp_path) -> None:
    skill = run(data, tmp_path)
    model = fitted(data.runs("train"), data.runs("validation")).dynamics
    loaded = load_surrogate(tmp_path / "best.ckpt").dynamics
    assert isinstance(loaded, PolynomialDynamics)
    state = loaded.state_dict()
    for name, value in model.state_dict().items():
        assert torch.equal(state[name], value), name
    assert torch.equal(loaded.used, model.used) and torch.equal(loaded.terms, model.terms)
    rollouts = ValidationRollouts(data.runs("validation"), 4, 3, "pose", basis=data.basis)
    assert rollouts.measure(loaded).skill == rollouts.measure(model).skill == skill
    summary = json.loads((tmp_path / "training.json").read_text())
    assert summary["skill"] == skill and summary["coefficients"] == model.num_terms
    assert summary["motion"]["noise"] in FIT["noises"] and summary["force"]["penalty"] in FIT["penalties"]
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    assert events.Scalars("result/skill")[0].value == pytest.approx(skill)


def test_a_complete_fit_is_not_repeated(data, tmp_path, monkeypatch) -> None:
    first = run(data, tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(module, "POLYNOMIAL", module.POLYNOMIAL._replace(run=None))
        assert run(data, tmp_path) == first
    with pytest.raises(UserError, match=r"model\.degree is 2 there and 1 here"):
        run(data, tmp_path, POLYNOMIAL | {"degree": 1})
    with pytest.raises(UserError, match=r"model\.kind is 'polynomial' there and 'network' here"):
        run(data, tmp_path, MODEL, TRAINING)
    (tmp_path / "training.json").unlink()  # interrupted
    assert run(data, tmp_path) == first
    run(data, tmp_path, POLYNOMIAL | {"degree": 1}, FIT | {"resume": False})


def test_without_validation_runs_a_third_chooses_and_all_are_fitted(data, tmp_path, caplog) -> None:
    quadratic = {"linear": False}
    skill = run(without_validation(data, 4), tmp_path, training=FIT | quadratic)
    assert "every third training run" in caplog.text
    runs = data.runs("train")
    without = fitted(runs[1:3], runs[::3], data.basis, **quadratic)
    assert without.score.skill == skill
    # The same noise and penalty for all runs.
    motion = without.selection.motion
    chosen = {"noises": [motion.noise], "penalties": [motion.penalty]}
    everything = fitted(runs, data.runs("test"), **quadratic, **chosen)
    loaded = load_surrogate(tmp_path / "best.ckpt").dynamics
    assert torch.equal(loaded.weights[:, :-6], everything.dynamics.weights[:, :-6])


def test_one_run_alone_can_be_fitted(data, tmp_path) -> None:
    assert run(without_validation(data, 1), tmp_path) > 0.5


def test_what_polynomials_have_no_use_for(data, tmp_path) -> None:
    with pytest.raises(UserError, match="but polynomials start from nothing"):
        run(data, tmp_path, start_from="a.ckpt")
    with pytest.raises(UserError, match="device is cuda, but polynomials are fitted on the CPU"):
        run(data, tmp_path, device="cuda")
    assert not list(tmp_path.iterdir())


def test_the_commands(tmp_path, no_pictures) -> None:
    make_dataset(tmp_path / "data", n=300)
    dataset = ["dataset=quick", "dataset.path=data"]
    train_it = ["train", *dataset, "model=polynomial", "reduction.num_modes=4", "training.threads=1"]
    assert sgns(tmp_path, *train_it, "output=out").returncode == 0
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {".hydra", "best.ckpt", "tensorboard", "training.json"}
    assert sgns(tmp_path, "evaluate", *dataset, "checkpoint=out/best.ckpt", "output=report").returncode == 0
    assert (tmp_path / "report" / "report.html").exists()
    assert "model has no key 'body_nodes'" in refusal(tmp_path, *train_it, "output=other", "preset=paper")


def test_more_coefficients_than_windows_are_told(data, caplog) -> None:
    fitted(data.runs("train")[:1], data.runs("train")[:1])
    assert any(
        "more coefficients of each output" in one and "model.degree=1" in one for one in caplog.messages
    )
