"""What all tests share."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import pytest
import torch

if TYPE_CHECKING:
    from sgns.reduction.reduce import ReducedDataset

os.environ.setdefault("OMP_NUM_THREADS", "1")  # of child processes, as below
os.environ.setdefault("MPLBACKEND", "Agg")  # figures without a screen, in child processes too
torch.set_num_threads(1)  # the tests' networks are so small that more threads only wait for each other


@pytest.fixture
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder that is the current one during the test."""
    folder = tmp_path / "empty"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports without pictures, which take seconds; tests/sgns/evaluate looks at them."""
    monkeypatch.setattr("sgns.evaluate.report.report_figures", lambda evaluation: [])


class Trained(NamedTuple):
    """A training and what it was of."""

    data: ReducedDataset
    output: Path


@pytest.fixture(scope="session")
def trained_briefly(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """The tiny dataset and a network trained on it for two steps: to be read and copied, never changed."""
    from sgns.train.command import train
    from sgns_testing.tiny import BRIEF, MODEL, reduced

    folder = tmp_path_factory.mktemp("trained")
    data = reduced(folder / "data")
    train(data, num_modes=4, model=MODEL, training=BRIEF, output=folder / "out")
    return Trained(data, folder / "out")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> ReducedDataset:
    """The tiny dataset in its basis."""
    from sgns_testing.tiny import reduced

    return reduced(tmp_path_factory.mktemp("tiny"))
