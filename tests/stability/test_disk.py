"""A full disk, a folder that cannot be written, a clock that goes back: one clear line, and what was there stays.

The limit on file sizes stands for the full disk: a write stops in the middle as it does there, with another error. A
disk that is really full is in `test_full_disk.py`: it must be mounted, which not every machine permits.
"""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from kills import broken, same
from small import SMALL, TRAIN
from tiny import MODEL, REDUCTION, TRAINING, make_dataset, reduced

from sgns.data.files import whole_file, write_whole
from sgns.evaluate.figures import read_log
from sgns.reduction.reduce import reduce_dataset
from sgns.train.command import train

resource = pytest.importorskip("resource", reason="needs limits on a process")

LIMITED = """
import resource, sys
limit = int(sys.argv.pop(1))
import sgns.cli, sgns.simulate.command, sgns.train.command, sgns.rollout, sgns.reduction.command
sys.argv[0] = "sgns"
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
sys.exit(sgns.cli.main())
"""
TRAINING_STEPS = ["training.max_steps=20", "training.validate_every=10"]
CAMPAIGN = ["dataset=quick", "dataset.draw=[{rake:[0.0,10.0,20.0]}]", "dataset.runs=3", *SMALL]


def limited(limit: int, *arguments: str) -> str:
    """The line with which a command ends when no file can be larger than `limit` bytes."""
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(limit), *arguments], capture_output=True, text=True, timeout=100
    )
    assert done.returncode == 2, (done.returncode, done.stdout, done.stderr)
    assert "Traceback" not in done.stderr and "Logging error" not in done.stderr, done.stderr
    return done.stderr.splitlines()[-1]


def files(folder: Path) -> dict[str, bytes]:
    """Everything in a folder, the records that commands write about themselves left out."""
    kept = (path for path in folder.rglob("*") if path.is_file() and path.parent.name != "tensorboard")
    return {
        str(p.relative_to(folder)): p.read_bytes()
        for p in kept
        if p.suffix != ".log" and ".hydra" not in p.parts
    }


def test_simulate(tmp_path) -> None:
    (tmp_path / "run.h5").write_bytes(b"earlier")
    line = limited(20_000, "simulate", *SMALL, f"output={tmp_path / 'run.h5'}")
    assert "cannot write" in line and "File too large" in line
    assert files(tmp_path) == {"run.h5": b"earlier"}


def test_a_campaign(tmp_path) -> None:
    arguments = ["simulate", f"dataset.path={tmp_path / 'a'}", *CAMPAIGN]
    assert "3 of 3 runs could not be made" in limited(20_000, *arguments)
    assert broken(tmp_path) == [] and [p.name for p in (tmp_path / "a").iterdir()] == ["dataset.yaml", "runs"]
    assert not any((tmp_path / "a" / "runs").iterdir())


@pytest.mark.parametrize("limit", [0, 15_000])
def test_reduce_and_train(tmp_path, limit) -> None:
    make_dataset(tmp_path / "data")
    before = files(tmp_path)
    arguments = [f"dataset.path={tmp_path / 'data'}", *TRAIN, *TRAINING_STEPS, f"output={tmp_path / 'out'}"]
    limited(limit, "train", *arguments)
    assert broken(tmp_path) == []
    assert {name: before[name] for name in before} == {
        k: v for k, v in files(tmp_path).items() if k in before
    }
    assert not (tmp_path / "out" / "training.json").exists()
    assert not [path for path in tmp_path.rglob("*") if path.name.endswith(".partial")]


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
import sys
from ordinary import become_ordinary
from sgns.cli import main
become_ordinary()
sys.exit(main())
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="permissions differ")
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["simulate", *SMALL, "output={}/run.h5"], "cannot write"),
        (["simulate", *CAMPAIGN, "dataset.path={}/new"], "cannot write"),
        (
            ["train", "dataset.path={}/data", *TRAIN, *TRAINING_STEPS, "output={}/out"],
            "choose another output",
        ),
    ],
)
def test_folders_that_may_not_be_written(arguments, words, tmp_path) -> None:
    make_dataset(tmp_path / "data")
    before = files(tmp_path)
    command = [sys.executable, "-c", ORDINARY, *(a.replace("{}", str(tmp_path)) for a in arguments)]
    tmp_path.chmod(0o555)
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, env=with_path())
    tmp_path.chmod(0o755)
    assert done.returncode == 2 and done.stderr.count("\n") == 1, (done.returncode, done.stdout, done.stderr)
    assert words in done.stderr and files(tmp_path) == before


def with_path() -> dict[str, str]:
    """The environment of a process that finds the tests' modules."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


# --- the clock --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("days", [-1.0, 1000.0])
def test_a_clock_that_is_set(days, tmp_path, monkeypatch) -> None:
    """Between two parts of a training; the files it finds are then of tomorrow, or years old."""
    data = make_dataset(tmp_path / "data")

    def run(output: Path, **changes) -> None:
        found = reduce_dataset(data, REDUCTION, progress=False)
        train(found, num_modes=4, model=MODEL, training=TRAINING | changes, output=output, seed=1)

    class Interrupted(Exception):
        pass

    def stop(self, trainer, *_) -> None:
        if trainer.global_step == 13:
            raise Interrupted

    run(tmp_path / "whole")
    with monkeypatch.context() as patch, pytest.raises(Interrupted):
        patch.setattr("sgns.train.callbacks.StepProgress.on_train_batch_end", stop)
        run(tmp_path / "parts")
    now = time.time
    monkeypatch.setattr(time, "time", lambda: now() + 86400.0 * days)
    for file in tmp_path.glob("data/**/*"):
        os.utime(file, (now() - 86400.0 * days,) * 2)
    run(tmp_path / "parts")
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


def test_a_disk_that_is_full_for_the_basis_leaves_the_earlier_one(tmp_path) -> None:
    folder = reduced(tmp_path).folder
    before = files(folder)
    code = "import resource, sys, torch; from sgns.reduction import Basis\n"
    code += "from sgns.config import UserError\nbasis = Basis.load(sys.argv[1])\n"
    code += "resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))\n"
    code += "try: basis.save(sys.argv[1])\nexcept UserError as error: sys.exit(str(error))"
    done = subprocess.run(
        [sys.executable, "-c", code, str(folder / "basis.h5")], capture_output=True, text=True, timeout=100
    )
    assert done.returncode == 1 and "cannot write" in done.stderr and "Traceback" not in done.stderr
    assert files(folder) == before
