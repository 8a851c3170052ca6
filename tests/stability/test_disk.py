"""A full disk, a folder that cannot be written, a clock that goes back: one clear line, and what was there stays.

A limit on file sizes stands for the full disk: a write stops in the middle as it does there, with another error. A disk
that is really full, or only to be read, is a file system of a few megabytes, mounted for the test where the machine
permits it. With space again, the same command goes on to the result of one that was never disturbed.
`SGNS_FREE=0,50000,...` tries other amounts of space for all commands.
"""

import errno
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from kills import broken, same

from sgns.data.dataset import Dataset
from sgns.data.files import whole_file, write_whole
from sgns.evaluate.command import read_log
from sgns.reduction.reduce import reduce_dataset
from sgns.train.command import train
from sgns_testing.commands import REDUCED, SMALL, TRAIN, call, files, python, refused, small_dataset
from sgns_testing.tiny import MODEL, REDUCTION, TRAINING, make_dataset, reduced

resource = pytest.importorskip("resource", reason="needs limits on a process")

NETWORK = [*TRAIN, "training.max_steps=20", "training.validate_every=10"]
POLYNOMIAL = [
    *(*REDUCED, "training.threads=1", "model=polynomial"),
    *("training.noises=[0.1]", "training.penalties=[0.01]"),
]
CAMPAIGN = ["dataset=quick", "dataset.draw=[{rake:[0.0,10.0,20.0]}]", "dataset.runs=3", *SMALL]


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """No file can be larger than `size` bytes meanwhile."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def limited(limit: int, *arguments: str) -> str:
    """The line with which a command ends when no file can be larger than `limit` bytes."""
    with largest_file(limit):
        done = call(*arguments)
    assert done.returncode == 2, done
    assert "Traceback" not in done.stderr and "Logging error" not in done.stderr, done.stderr
    return done.stderr.splitlines()[-1]


def test_simulate(tmp_path, empty_folder) -> None:
    (tmp_path / "run.h5").write_bytes(b"earlier")
    line = limited(20_000, "simulate", *SMALL, f"output={tmp_path / 'run.h5'}", "overwrite=true")
    assert "cannot write" in line and "File too large" in line
    assert files(tmp_path) == {"run.h5": b"earlier"}


@pytest.mark.long
def test_a_campaign(tmp_path, empty_folder) -> None:
    arguments = ["simulate", f"dataset.path={tmp_path / 'a'}", *CAMPAIGN]
    assert "3 of 3 runs could not be made" in limited(20_000, *arguments)
    left = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert broken(tmp_path) == [] and left == ["dataset.yaml", "runs", "runs.csv"]
    assert not any((tmp_path / "a" / "runs").iterdir())


@pytest.mark.parametrize("limit", [0, 15_000])
def test_reduce_and_train(tmp_path, limit, empty_folder) -> None:
    make_dataset(tmp_path / "data")
    before = files(tmp_path)
    limited(limit, "train", f"dataset.path={tmp_path / 'data'}", *NETWORK, f"output={tmp_path / 'out'}")
    assert broken(tmp_path) == []
    assert before.items() <= files(tmp_path).items()
    assert not (tmp_path / "out" / "training.json").exists()
    assert not [path for path in tmp_path.rglob("*") if path.name.endswith(".partial")]


@pytest.mark.long
def test_a_training_whose_disk_fills_up_goes_on_when_there_is_space(tmp_path, monkeypatch) -> None:
    data = reduced(tmp_path / "data")

    def run(output: Path) -> None:
        train(data, num_modes=4, model=MODEL, training=TRAINING, output=output, seed=1)

    run(tmp_path / "whole")
    room = [3]  # best.ckpt and last.ckpt of step 10, best.ckpt of step 20

    def full(path: Path):
        room[0] -= 1
        if room[0] < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return whole_file(path)

    with monkeypatch.context() as patch, pytest.raises(OSError, match="No space left"):
        patch.setattr("sgns.model.checkpoint.whole_file", full)
        run(tmp_path / "parts")
    assert broken(tmp_path / "parts") == []
    run(tmp_path / "parts")
    assert same(tmp_path / "whole", tmp_path / "parts")


def test_an_error_of_the_disk_names_the_file(tmp_path) -> None:
    with pytest.raises(OSError) as caught, whole_file(tmp_path / "a"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert caught.value.filename == str(tmp_path / "a") and not list(tmp_path.iterdir())


# --- folders that cannot be written -----------------------------------------------------------------------

ORDINARY = """
import json, sys
from sgns_testing.commands import call
from sgns_testing.permissions import become_ordinary
become_ordinary()
for arguments in json.loads(sys.argv[1]):
    done = call(*arguments)
    print(json.dumps([done.returncode, done.stderr]))
"""
UNWRITABLE = [
    (["simulate", *SMALL, "output={}/run.h5"], "cannot write"),
    (["simulate", *CAMPAIGN, "dataset.path={}/new"], "cannot write"),
    (["train", "dataset.path={}/data", *NETWORK, "output={}/out"], "choose another output"),
]


@pytest.mark.long
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="permissions differ")
def test_folders_that_may_not_be_written(tmp_path) -> None:
    make_dataset(tmp_path / "data")
    before = files(tmp_path)
    tmp_path.chmod(0o555)
    commands = [[word.replace("{}", str(tmp_path)) for word in arguments] for arguments, _ in UNWRITABLE]
    done = python(ORDINARY, json.dumps(commands))
    tmp_path.chmod(0o755)
    for line, (_, words) in zip(done.stdout.splitlines(), UNWRITABLE, strict=True):
        status, said = json.loads(line)
        assert status == 2 and said.count("\n") == 1 and words in said, (words, line)
    assert (done.returncode, done.stderr) == (0, "") and files(tmp_path) == before


# --- the clock --------------------------------------------------------------------------------------------


def train_tiny(folder: Path, output: Path) -> None:
    found = reduce_dataset(Dataset.open(folder / "data"), REDUCTION, progress=False)
    train(found, num_modes=4, model=MODEL, training=TRAINING, output=output, seed=1)


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset, a whole training, and parts of the same that was interrupted."""

    class Interrupted(Exception):
        pass

    def stop(self, trainer, *_) -> None:
        if trainer.global_step == 13:
            raise Interrupted

    folder = tmp_path_factory.mktemp("interrupted")
    make_dataset(folder / "data")
    train_tiny(folder, folder / "whole")
    with pytest.MonkeyPatch.context() as patch, pytest.raises(Interrupted):
        patch.setattr("sgns.train.validation.StepProgress.on_train_batch_end", stop)
        train_tiny(folder, folder / "parts")
    return folder


@pytest.mark.parametrize("days", [-1.0, 1000.0])
def test_a_clock_that_is_set(days, interrupted, tmp_path, monkeypatch) -> None:
    """Between two parts of a training; the files it finds are then of tomorrow, or years old."""
    shutil.copytree(interrupted, tmp_path, dirs_exist_ok=True)
    now = time.time
    monkeypatch.setattr(time, "time", lambda: now() + 86400.0 * days)
    for file in tmp_path.glob("data/**/*"):
        os.utime(file, (now() - 86400.0 * days,) * 2)
    train_tiny(tmp_path, tmp_path / "parts")
    assert same(tmp_path / "whole", tmp_path / "parts")
    for name, points in read_log(tmp_path / "parts" / "tensorboard").items():
        assert (points[1:, 0] > points[:-1, 0]).all(), name


@pytest.mark.parametrize("collected", [True, False])
def test_hidden_files_of_a_killed_process_do_not_stay(collected, tmp_path) -> None:
    """Also not while its number is still taken because nobody has asked for its status."""
    if not collected and not Path("/proc/self/stat").exists():
        pytest.skip("this system does not show the states of processes as files")
    code = "import os, sys; from pathlib import Path; from sgns.data.files import whole_file\n"
    code += "with whole_file(Path(sys.argv[1])) as hidden: hidden.write_text('half'); os.kill(os.getpid(), 9)"
    process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path / "a")])
    os.waitid(os.P_PID, process.pid, os.WEXITED | (0 if collected else os.WNOWAIT))
    assert len(list(tmp_path.iterdir())) == 1
    write_whole(tmp_path / "a", "whole")
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
    process.wait()


# --- a disk that is really full, or only to be read ------------------------------------------------------

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


COMMANDS = {
    "network": ["train", "dataset.path={here}/data", *NETWORK, "output={here}/out"],
    "polynomial": ["train", "dataset.path={here}/data", *POLYNOMIAL, "output={here}/out"],
    "simulate": ["simulate", *SMALL, "output={here}/run.h5"],
    "campaign": ["simulate", *CAMPAIGN, "dataset.path={here}/made"],
    "reduce": ["reduce", "dataset.path={here}/data", *REDUCED, "output={here}/out"],
    "rollout": ["rollout", *SMALL, "checkpoint={network}/out/best.ckpt", "output={here}/run.h5"],
    "rollout of polynomials": [
        "rollout",
        *SMALL,
        "checkpoint={polynomial}/out/best.ckpt",
        "output={here}/run.h5",
    ],
    "evaluate": [
        "evaluate",
        "dataset.path={here}/data",
        "checkpoint={network}/out/best.ckpt",
        "output={here}/out",
    ],
}


class Undisturbed:
    """What commands make of the small dataset undisturbed, each made when first asked for."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.data = folder / "given"
        small_dataset(self.data)

    def __call__(self, name: str) -> Path:
        made = self.folder / name
        if not made.exists():
            shutil.copytree(self.data, made / "data")
            done = call(*placed(name, made, self))
            assert done.returncode == 0, done.stderr
        return made


def placed(name: str, here: Path, undisturbed: Undisturbed) -> list[str]:
    """A command's arguments with their folders."""
    needed = [one for one in ("network", "polynomial") if f"{{{one}}}" in " ".join(COMMANDS[name])]
    places = {"here": here} | {one: undisturbed(one) for one in needed}
    return [argument.format(**places) if "/" in argument else argument for argument in COMMANDS[name]]


@pytest.fixture(autouse=True)
def one_thread() -> None:
    """Whatever tests of other files have left: results are compared to the bit."""
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Undisturbed:
    return Undisturbed(tmp_path_factory.mktemp("undisturbed"))


@pytest.fixture
def no_estimate(monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk was empty enough when the command began: others fill it up."""
    for module in ("command", "workers", "campaign"):
        monkeypatch.setattr(f"sgns.simulate.{module}.require_space", lambda *_: None)


FREE = {
    "simulate": [100_000],
    "reduce": [100_000],
    "rollout": [0],
    "rollout of polynomials": [100_000],
    "polynomial": [210_000],
    "network": [280_000, 400_000],
    "campaign": [250_000],
    "evaluate": [400_000],
}
"""Bytes that each command finds free: it gets into its work, and some of its files are complete."""
if more := os.environ.get("SGNS_FREE"):
    FREE = {name: [int(free) for free in more.split(",")] for name in FREE}
TAKES_LONG = ("network", "campaign", "evaluate")


@pytest.mark.parametrize(
    ("name", "free"),
    [
        pytest.param(name, free, marks=[pytest.mark.long] * (name in TAKES_LONG))
        for name in FREE
        for free in FREE[name]
    ],
)
def test_a_full_disk(name, free, undisturbed, disk, no_estimate, empty_folder) -> None:
    shutil.copytree(undisturbed.data, disk / "data")
    filler = leave(disk, free)
    before = files(disk)
    arguments = placed(name, disk, undisturbed)
    done = call(*arguments)
    if done.returncode == 0:
        assert "SGNS_FREE" in os.environ, "the disk was not full"
        return
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done
    assert "No space left on device" in done.stderr
    assert before.items() <= files(disk).items()
    assert broken(disk) == []
    assert not list(disk.rglob("*.partial"))

    filler.unlink()
    done = call(*arguments)
    assert done.returncode == 0, done.stderr
    if name == "evaluate":  # its tables have times of the clock in them
        assert broken(disk) == [] and (disk / "out" / "report.html").stat().st_size > 0
    else:
        assert same(undisturbed(name), disk)


def test_a_run_that_would_not_fit_is_not_begun(disk, empty_folder) -> None:
    leave(disk, 24 * 4096)
    said = refused("simulate", *SMALL, f"output={disk / 'run.h5'}")
    assert "94 kB are free; free some space" in said  # the lock of the output takes a page
    assert [path.name for path in disk.iterdir()] == ["filler"]


@pytest.mark.parametrize("name", COMMANDS)
def test_a_disk_that_can_only_be_read(name, undisturbed, disk, empty_folder) -> None:
    shutil.copytree(undisturbed.data, disk / "data")
    before = files(disk)
    mount("-o", "remount,ro", str(disk))
    assert "Read-only file system" in refused(*placed(name, disk, undisturbed))
    assert files(disk) == before


def test_data_on_a_disk_that_can_only_be_read(undisturbed, disk, empty_folder) -> None:
    """What is reduced can be trained on and evaluated."""
    shutil.copytree(undisturbed("reduce") / "data", disk / "data")
    mount("-o", "remount,ro", str(disk))
    done = call("train", f"dataset.path={disk / 'data'}", *POLYNOMIAL, f"output={empty_folder / 'out'}")
    assert done.returncode == 0, done.stderr
    assert same(undisturbed("polynomial") / "out", empty_folder / "out")
