"""A claim on a file: one process has it, and it ends with that process."""

from __future__ import annotations

import os
import subprocess
import sys
import threading

import pytest

pytest.importorskip("fcntl", reason="this system has no file locks")

from sgns.claim import claimed, claimed_in_turn, only_here
from sgns.errors import UserError

# Claims the file named on the command line, says so and waits for a line.
HOLD = """
import sys, pathlib
from sgns.claim import claimed
with claimed(pathlib.Path(sys.argv[1])) as ours:
    print(ours, flush=True)
    sys.stdin.readline()
"""
# Adds 1 to a number in a file whenever it has the claim; a second process in between would lose a count.
COUNT = """
import sys, pathlib
from sgns.claim import claimed
path, done = pathlib.Path(sys.argv[1]), 0
while done < 200:
    with claimed(path) as ours:
        if ours:
            path.write_text(str(int(path.read_text()) + 1))
            done += 1
"""


def start(code, path):
    return subprocess.Popen(
        [sys.executable, "-c", code, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )


def test_another_process_cannot_claim_until_the_first_ends(tmp_path):
    path = tmp_path / "runs" / "a.h5"
    with start(HOLD, path) as holder:
        assert holder.stdout.readline() == "True\n"
        with claimed(path) as ours:
            assert not ours
        with claimed(path.with_name("b.h5")) as ours:
            assert ours
        holder.kill()  # it leaves its lock file behind, without the lock
    with claimed(path) as ours:
        assert ours
    assert list(path.parent.iterdir()) == []


def test_an_error_gives_the_claim_back(tmp_path):
    with pytest.raises(RuntimeError), claimed(tmp_path / "a.h5"):
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_claims_exclude_each_other(tmp_path):
    path = tmp_path / "count"
    path.write_text("0")
    processes = [start(COUNT, path) for _ in range(3)]
    assert [p.wait(timeout=60) for p in processes] == [0, 0, 0]
    for process in processes:
        process.stdin.close()
        process.stdout.close()
    assert path.read_text() == "600"
    assert [p.name for p in tmp_path.iterdir()] == ["count"]


def test_who_asks_second_hears_who_is_at_it(tmp_path):
    path = tmp_path / "a.h5"
    with start(HOLD, path) as holder:
        assert holder.stdout.readline() == "True\n"
        with pytest.raises(UserError) as caught, only_here(path):
            pass
        assert str(caught.value).startswith(f"{path} is being made by process {holder.pid}; wait until")
        holder.kill()
    with only_here(path), pytest.raises(UserError, match=f"process {os.getpid()};"), only_here(path):
        pass  # the killed one left its number in the lock file
    assert list(tmp_path.iterdir()) == []


def test_a_claim_in_turn_waits(tmp_path):
    path = tmp_path / "a"
    with start(HOLD, path) as holder:
        assert holder.stdout.readline() == "True\n"
        threading.Timer(0.3, holder.stdin.close).start()
        with claimed_in_turn(path):
            assert holder.stdin.closed
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: os.symlink("file", path)])
def test_what_is_no_lock_file_is_not_used_as_one(tmp_path, make):
    (tmp_path / "file").write_text("mine")
    make(tmp_path / ".a.lock")
    with pytest.raises(UserError, match=r"\.a\.lock: it is a"), only_here(tmp_path / "a"):
        pass
    with pytest.raises(UserError, match="file: File exists; choose"), only_here(tmp_path / "file" / "a"):
        pass
    assert sorted(path.name for path in tmp_path.iterdir()) == [".a.lock", "file"]
    assert (tmp_path / "file").read_text() == "mine"
