"""Good files, and what all random tests share."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from sgns.config import UserError
from sgns_testing.commands import TRAIN, call, small_dataset
from sgns_testing.fuzzing import OUTCOMES
from sgns_testing.runs import make_run


@pytest.fixture(autouse=True)
def outcomes(request: pytest.FixtureRequest) -> Any:
    """Say with `pytest -s` how many cases there were: a test whose cases are all refused shows less than it seems."""
    OUTCOMES.clear()
    yield
    print(f"\n{request.node.name}: {OUTCOMES['accepted']} cases accepted, {OUTCOMES['refused']} refused")


@pytest.fixture(scope="session")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a dataset of the small bed, a checkpoint, a run, a basis and everything else that is read."""
    folder = tmp_path_factory.mktemp("good")
    small_dataset(folder / "data")
    done = call("train", f"dataset.path={folder / 'data'}", *TRAIN, f"output={folder / 'out'}")
    assert done.returncode == 0, done.stderr
    make_run(folder / "run.h5", frames=4, n=6, m=3)
    return folder


class Begun(UserError):
    """The settings were good enough to begin the long part."""


@pytest.fixture
def nothing_long(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands end where the computing would begin."""

    def begun(*_: Any, **__: Any) -> None:
        raise Begun("begun")

    for name in (
        "sgns.simulate.command.simulate_scene",
        "sgns.simulate.workers.compile_kernels",
        "sgns.train.lightning_module.run_trainer",
        "sgns.train.polynomial.best_polynomial",
        "sgns.evaluate.costs.roll_out",
        "sgns.evaluate.command.roll_out",
        "sgns.rollout.rollout_scene",
    ):
        monkeypatch.setattr(name, begun)
