"""Campaigns, sweeps and evaluations in other processes, by launchers of Hydra that are packages of their own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from sgns.data.dataset import Dataset
from sgns_testing.commands import SMALL, TRAIN, environment, small_dataset

pytest.importorskip("hydra_plugins.hydra_joblib_launcher", reason="hydra-joblib-launcher is not installed")
pytest.importorskip(
    "hydra_plugins.hydra_submitit_launcher", reason="hydra-submitit-launcher is not installed"
)

pytestmark = pytest.mark.timeout(300)  # each process loads torch and Warp
SUBMITIT = ["-m", "hydra/launcher=submitit_local"]
JOBLIB = ["-m", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]
CAMPAIGN = [
    *("dataset=quick", "dataset.runs=3", "dataset.path=made", "scene.start=0.5", "shards=2", "shard=0,1"),
    *(word for word in SMALL if not word.startswith("scene.speed=")),
]
POLYNOMIAL = ["model=polynomial", "training.noises=[0.1]", "training.penalties=[1e-3]", *TRAIN[:2]]


def in_its_own_process(*arguments: str) -> subprocess.CompletedProcess[str]:
    """A command. Joblib's workers would go on in the folder of the test before, and submitit's would look for modules
    that other tests have made."""
    command = [sys.executable, "-m", "sgns", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=200, env=environment())


@pytest.mark.long
@pytest.mark.parametrize("launcher", [SUBMITIT, JOBLIB], ids=lambda one: one[1])
def test_shares_of_a_campaign(launcher: list[str], empty_folder: Path) -> None:
    done = in_its_own_process("simulate", *launcher, *CAMPAIGN)
    assert done.returncode == 0, done.stderr
    dataset = Dataset.open(Path("made"))
    assert sum(len(dataset.runs(split)) for split in ("train", "validation", "test")) == 3
    assert "as a table: multirun/simulate/" in done.stdout


@pytest.mark.long
def test_trainings_of_which_one_fails_and_evaluations(empty_folder: Path) -> None:
    small_dataset(Path("data/quick"))
    datasets = "dataset.path=data/none,data/quick"
    done = in_its_own_process("train", *JOBLIB, *POLYNOMIAL, datasets, "output=out")
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done
    assert done.stderr.startswith("sgns train: job 0 (dataset.path=data/none): no dataset in data/none: ")
    assert done.stderr.endswith("; 1 of 2 jobs failed, the others are kept\n")
    (_, line) = Path("out/sweep.csv").read_text().splitlines()
    assert "out/1/best.ckpt" in line
    done = in_its_own_process("evaluate", *SUBMITIT, "checkpoint=out/1/best.ckpt", "output=report")
    assert done.returncode == 0, done.stderr
    assert Path("report/0/report.html").is_file()
