"""Trainings of a given time: whole, kept, told apart by what they depend on."""

import json

import pytest
from tiny import FIT, MODEL, POLYNOMIAL, TRAINING, reduced

from sgns.errors import UserError
from sgns.frontier import timed_training
from sgns.frontier.timed_training import read_record, seconds_per_step, train_for
from sgns.learning.model_settings import ModelSettings
from sgns.learning.surrogate import read_checkpoint

NAMES = {"preset": {"name": "tiny"}, "dataset": {"name": "tiny"}}
NETWORK = {"model": MODEL, "training": TRAINING, **NAMES}


@pytest.fixture
def data(tmp_path, monkeypatch):
    monkeypatch.setattr(timed_training, "seconds_per_step", lambda *_: 0.01)
    return reduced(tmp_path / "data")


def test_as_many_steps_as_fit_and_the_rate_falls_over_them(data, tmp_path):
    done = train_for(0.2, data, NETWORK, tmp_path / "kept")
    assert (done.steps, done.samples) == (20, 20 * TRAINING["batch_size"])
    assert done.processor_s >= 0
    training = read_checkpoint(done.checkpoint)["hyper_parameters"]["settings"]["training"]
    assert training["max_steps"] == 20
    assert training["warmup_steps"] == 2
    assert json.loads((done.checkpoint.parent / "training.json").read_text())["steps"] == 20


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"processor_s": 1, "steps": "x", "samples": 3}', "[" * 10**5]
)
def test_a_damaged_record_is_one_line(tmp_path, text):
    (tmp_path / "timed.json").write_text(text)
    with pytest.raises(UserError, match=r"timed\.json.*; remove it to train again"):
        read_record(tmp_path / "timed.json")


def test_what_is_complete_is_taken_and_what_is_not_is_begun_anew(data, tmp_path):
    done = train_for(0.1, data, NETWORK, tmp_path / "kept")
    made = done.checkpoint.stat().st_mtime_ns
    assert train_for(0.1, data, NETWORK, tmp_path / "kept") == done
    assert done.checkpoint.stat().st_mtime_ns == made
    (done.checkpoint.parent / "timed.json").unlink()  # as if killed before its end
    again = train_for(0.1, data, NETWORK, tmp_path / "kept")
    assert again.checkpoint == done.checkpoint
    assert again.checkpoint.stat().st_mtime_ns > made


def test_other_settings_have_another_folder(data, tmp_path, monkeypatch):
    monkeypatch.setattr(timed_training, "train", lambda *_, output, **__: output.mkdir(parents=True))
    wider = NETWORK | {"model": MODEL | {"hidden_width": 8}}
    done = {
        train_for(seconds, data, settings, tmp_path / "kept", seed).checkpoint
        for seconds, settings, seed in (
            (0.1, NETWORK, 0),
            (0.12, NETWORK, 0),
            (0.1, wider, 0),
            (0.1, NETWORK, 1),
        )
    }
    assert len(done) == 4


def test_polynomials_have_no_steps(data, tmp_path):
    done = train_for(1.0, data, {"model": POLYNOMIAL, "training": FIT, **NAMES}, tmp_path / "kept")
    assert done.steps == 0
    assert done.samples == FIT["draws"] * 4 * 13  # four runs of 14 frames
    assert done.checkpoint.exists()


def test_a_step_with_more_windows_takes_longer(tmp_path):
    data = reduced(tmp_path)
    few, many = (
        seconds_per_step(data, ModelSettings(**MODEL), TRAINING | {"batch_size": size}, 0)
        for size in (2, 2000)
    )
    assert 0 < few < many


def test_a_clock_that_stands_still_gives_no_number_of_steps(tmp_path, monkeypatch):
    monkeypatch.setattr(timed_training.time, "process_time", lambda: 1.0)
    with pytest.raises(UserError, match="the processor's clock stands still"):
        train_for(0.2, reduced(tmp_path / "data"), NETWORK, tmp_path / "kept")
