"""A disk that is really full, or only to be read: a file system of a few megabytes, mounted for the test.

Every command finds so little space that it has to end; then there is one line, status 2, and what was complete stays.
With space again, the same command goes on to the result of one that was never disturbed. `SGNS_FREE=0,50000,...` tries
other amounts of space for all commands.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from kills import broken, same
from small import REDUCED, SMALL, TRAIN, call, small_dataset
from test_disk import CAMPAIGN, TRAINING_STEPS, files

NETWORK = [*TRAIN, *TRAINING_STEPS]
POLYNOMIAL = [*REDUCED, "model=polynomial", "training.noises=[0.1]", "training.penalties=[0.01]"]
MOUNTED = 16 << 20
"""Size of the file system [bytes]."""


def mount(*arguments: str) -> None:
    """Call the system's `mount`, or skip the test."""
    if shutil.which("mount") is None:
        pytest.skip("this system has no mount command")
    done = subprocess.run(["mount", *arguments], capture_output=True, text=True)
    if done.returncode != 0:
        pytest.skip(f"file systems cannot be mounted here: {done.stderr.strip()}")


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """Folder with a file system of its own."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount("-t", "tmpfs", "-o", f"size={MOUNTED}", "tmpfs", str(folder))
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def leave(disk: Path, free: int) -> Path:
    """Fill the disk up with a file, which is returned, until only `free` bytes are left."""
    filler = disk / "filler"
    filler.write_bytes(bytes(max(0, shutil.disk_usage(disk).free - free)))
    return filler


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Data and checkpoints that commands need, and what they make of them undisturbed."""
    folder = tmp_path_factory.mktemp("elsewhere")
    small_dataset(folder / "given" / "data")
    for name, arguments in COMMANDS.items():
        if name == "evaluate":  # takes long, and its tables have times of the clock in them
            continue
        shutil.copytree(folder / "given" / "data", folder / name / "data")
        status, said = call(*placed(arguments, folder / name, folder))
        assert status == 0, said
    return folder


COMMANDS = {
    "network": ["train", "dataset.path={here}/data", *NETWORK, "output={here}/out"],
    "polynomial": ["train", "dataset.path={here}/data", *POLYNOMIAL, "output={here}/out"],
    "simulate": ["simulate", *SMALL, "output={here}/run.h5"],
    "campaign": ["simulate", *CAMPAIGN, "dataset.path={here}/made"],
    "reduce": ["reduce", "dataset.path={here}/data", *REDUCED, "output={here}/out"],
    "rollout": ["rollout", *SMALL, "checkpoint={there}/network/out/best.ckpt", "output={here}/run.h5"],
    "rollout of polynomials": [
        *("rollout", *SMALL, "checkpoint={there}/polynomial/out/best.ckpt", "output={here}/run.h5"),
    ],
    "evaluate": [
        *("evaluate", "dataset.path={here}/data", "checkpoint={there}/network/out/best.ckpt"),
        "output={here}/out",
    ],
}


def placed(arguments: list[str], here: Path, there: Path) -> list[str]:
    """Arguments with their folders."""
    return [
        argument.format(here=here, there=there) if "/" in argument else argument for argument in arguments
    ]


@pytest.fixture
def no_estimate(monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk was empty enough when the command began: others fill it up."""
    for module in ("command", "workers", "campaign"):
        monkeypatch.setattr(f"sgns.simulate.{module}.require_space", lambda *_: None)


FREE = {
    "network": [280_000, 400_000],
    "polynomial": [210_000],
    "simulate": [100_000],
    "campaign": [250_000],
    "reduce": [100_000],
    "rollout": [0],
    "rollout of polynomials": [100_000],
    "evaluate": [400_000],
}
"""Bytes that each command finds free: it gets into its work, and some of its files are complete."""
if more := os.environ.get("SGNS_FREE"):
    FREE = {name: [int(free) for free in more.split(",")] for name in FREE}


@pytest.mark.parametrize(("name", "free"), [(name, free) for name in FREE for free in FREE[name]])
def test_a_full_disk(name, free, elsewhere, disk, no_estimate, empty_folder) -> None:
    shutil.copytree(elsewhere / "given" / "data", disk / "data")
    filler = leave(disk, free)
    before = files(disk)
    arguments = placed(COMMANDS[name], disk, elsewhere)
    status, said = call(*arguments)
    if status == 0:
        assert "SGNS_FREE" in os.environ, "the disk was not full"
        return
    assert status == 2 and said.count("\n") == 1 and "No space left on device" in said, said
    assert {path: files(disk).get(path) for path in before} == before
    assert broken(disk) == []
    assert not list(disk.rglob("*.partial"))

    filler.unlink()
    status, said = call(*arguments)
    assert status == 0, said
    if name == "evaluate":
        assert broken(disk) == [] and (disk / "out" / "report.html").stat().st_size > 0
    else:
        assert same(elsewhere / name, disk)


def test_a_run_that_would_not_fit_is_not_begun(disk, empty_folder) -> None:
    leave(disk, 25 * 4096)  # the lock takes the first 4096
    status, said = call("simulate", *SMALL, f"output={disk / 'run.h5'}")
    assert status == 2 and said.count("\n") == 1, said
    assert "94 kB are free; free some space" in said  # the lock of the output takes a page
    assert [path.name for path in disk.iterdir()] == ["filler"]


@pytest.mark.parametrize("name", COMMANDS)
def test_a_disk_that_can_only_be_read(name, elsewhere, disk, empty_folder) -> None:
    shutil.copytree(elsewhere / "given" / "data", disk / "data")
    before = files(disk)
    mount("-o", "remount,ro", str(disk))
    status, said = call(*placed(COMMANDS[name], disk, elsewhere))
    assert status == 2 and said.count("\n") == 1 and "Read-only file system" in said, said
    assert files(disk) == before


def test_data_on_a_disk_that_can_only_be_read(elsewhere, disk, empty_folder) -> None:
    """What is reduced can be trained on and evaluated."""
    shutil.copytree(elsewhere / "reduce" / "data", disk / "data")
    mount("-o", "remount,ro", str(disk))
    status, said = call(
        "train", f"dataset.path={disk / 'data'}", *POLYNOMIAL, f"output={empty_folder / 'out'}"
    )
    assert status == 0, said
    assert same(elsewhere / "polynomial" / "out", empty_folder / "out")
