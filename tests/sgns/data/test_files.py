"""Files: locked by one process, whole or not there, and read within bounds."""

from __future__ import annotations

import errno
import io
import os
import random
import socket
import stat
import subprocess
import sys
import threading
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest

from sgns.config import UserError
from sgns.data.files import (
    MOST_OF_ARRAYS,
    file_lock,
    only_here,
    read_arrays,
    read_json,
    read_table,
    read_text,
    whole_file,
    write_whole,
)
from sgns_testing.commands import environment
from sgns_testing.runs import make_run, make_writer, random_frame

# --- A lock on a file: one process has it, and it ends with that process --------------------------------

pytest.importorskip("fcntl", reason="this system has no file locks")
# Locks the file named on the command line, says so and waits for a line.
HOLD = """
import sys, pathlib
from sgns.data.files import file_lock
with file_lock(pathlib.Path(sys.argv[1])) as ours:
    print(ours, flush=True)
    sys.stdin.readline()
"""
# Adds 1 to a number in a file whenever it has the lock; a second process in between would lose a count.
COUNT = """
import sys, pathlib
from sgns.data.files import file_lock
path, done = pathlib.Path(sys.argv[1]), 0
while done < 90:
    with file_lock(path) as ours:
        if ours:
            path.write_text(str(int(path.read_text()) + 1))
            done += 1
"""


def start(code, path):
    return subprocess.Popen(
        [sys.executable, "-c", code, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )


def test_who_asks_second_hears_who_is_at_it(tmp_path):
    path = tmp_path / "runs" / "a.h5"
    with start(HOLD, path) as holder:
        assert holder.stdout.readline() == "True\n"
        with file_lock(path) as ours, file_lock(path.with_name("b.h5")) as other:
            assert (ours, other) == (False, True)
        with pytest.raises(UserError) as caught, only_here(path):
            pass
        assert str(caught.value).startswith(f"{path} is being made by process {holder.pid}; wait until")
        holder.kill()  # it leaves its lock file behind with its number, without the lock
    with only_here(path), pytest.raises(UserError, match=f"process {os.getpid()};"), only_here(path):
        pass
    assert list(path.parent.iterdir()) == []


def test_an_error_gives_the_lock_back(tmp_path):
    with pytest.raises(RuntimeError), file_lock(tmp_path / "a.h5"):
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_locks_exclude_each_other(tmp_path):
    path = tmp_path / "count"
    path.write_text("0")
    processes = [start(COUNT, path) for _ in range(2)]
    assert [p.wait(timeout=60) for p in processes] == [0, 0]
    for process in processes:
        process.stdin.close()
        process.stdout.close()
    assert path.read_text() == "180"
    assert [p.name for p in tmp_path.iterdir()] == ["count"]


def test_a_lock_may_be_waited_for(tmp_path):
    held, over = threading.Event(), threading.Event()

    def hold():
        with file_lock(tmp_path / "a"):
            held.set()
            time.sleep(0.2)
            over.set()

    threading.Thread(target=hold).start()
    held.wait()
    with file_lock(tmp_path / "a", wait=True) as ours:
        assert ours and over.is_set()
    assert list(tmp_path.iterdir()) == []


def test_a_file_system_without_locks_gives_everybody_one(tmp_path, monkeypatch):
    def flock(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", flock)
    with file_lock(tmp_path / "a") as ours, file_lock(tmp_path / "a") as theirs:
        assert ours and theirs
    write_whole(tmp_path / "a", "whole")
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


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


# --- A file is replaced whole, and only by a plain file ------------------------------------------------


def test_a_file_is_replaced_whole_or_stays(tmp_path):
    write_whole(tmp_path / "a", "old")
    with pytest.raises(KeyError), whole_file(tmp_path / "a") as hidden:
        hidden.write_text("half")
        raise KeyError
    with whole_file(tmp_path / "a") as hidden:
        hidden.write_text("new")
        assert (tmp_path / "a").read_text() == "old"
    assert (tmp_path / "a").read_text() == "new"
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def a_socket(path):
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(str(path))


def a_device(path):
    try:
        os.mknod(path, 0o600 | 0o020000, os.makedev(1, 3))
    except OSError:
        pytest.skip("may not make devices here")


def a_link_to_a_file(path):
    path.with_name("file").write_text("old")
    path.symlink_to("file")


@pytest.mark.skipif(os.name != "posix", reason="needs pipes and links")
@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda path: os.mkfifo(path), "a pipe"),
        (a_socket, "a socket"),
        (a_device, "a device"),
        (lambda path: path.symlink_to(os.devnull), "a symbolic link"),
        (a_link_to_a_file, "a symbolic link"),
        (os.mkdir, "a folder"),
    ],
)
@pytest.mark.parametrize("when", ["before", "meanwhile"])
def test_only_plain_files_are_replaced(tmp_path, make, words, when):
    path, begun = tmp_path / "a", False
    if when == "before":
        make(path)
    with pytest.raises(UserError, match=f"cannot write .*a: it is {words}"), whole_file(path) as hidden:
        begun = True
        hidden.write_text("new")
        make(path)
    assert begun == (when == "meanwhile")
    assert not stat.S_ISREG(os.lstat(path).st_mode)  # it still is what it was
    assert {p.name for p in tmp_path.iterdir()} <= {"a", "file"}
    if make is a_link_to_a_file:
        assert path.is_symlink() and (tmp_path / "file").read_text() == "old"


# --- A file is complete under its name or not there at all, whatever the disk does ----------------------


def test_places_that_cannot_be_written_are_named(tmp_path):
    (tmp_path / "file").write_text("x")
    for path in (tmp_path, tmp_path / "file" / "a.h5", tmp_path / ("x" * 300), Path("/proc/nowhere/a.h5")):
        with pytest.raises(UserError) as caught:
            make_writer(path)
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)


# Writes a run of 160 kB in the folder named on the command line again and again, with other limits for files.
LIMITED = """
import resource, sys
from pathlib import Path
from sgns_testing.runs import make_run
from sgns.config import UserError
folder, hard = Path(sys.argv[1]), resource.getrlimit(resource.RLIMIT_FSIZE)[1]
for limit in (1, 1_000, 30_000, 145_000, 155_000, 160_000):
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        make_run(folder / "a.h5", frames=30, n=200)
    except UserError as error:
        print(error, len(list(folder.iterdir())))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs resource limits")
def test_a_disk_that_fills_up_at_any_moment(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(tmp_path)], env=environment(), capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")
    said = done.stdout.splitlines()
    assert len(said) == 6 and all("cannot write" in line and line.endswith(" 0") for line in said), said


@pytest.mark.skipif(sys.platform == "win32", reason="needs file locks")
def test_hidden_files_of_killed_processes_go_and_those_of_living_ones_stay(tmp_path):
    with make_writer(tmp_path / "a.h5"):
        (alive,) = tmp_path.iterdir()
        host = alive.name.removeprefix(".a.h5.").rsplit("-", 2)[0]
        dead = subprocess.Popen([sys.executable, "-c", ""])
        dead.wait()
        killed = tmp_path / f".a.h5.{host}-{dead.pid}-00000000.partial"
        elsewhere = tmp_path / f".a.h5.other-{dead.pid}-00000000.partial"
        for hidden in (killed, elsewhere):
            hidden.write_bytes(b"x")
        make_run(tmp_path / "a.h5", frames=2, n=3)
        assert {p.name for p in tmp_path.iterdir()} == {"a.h5", alive.name, elsewhere.name}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes")
def test_a_run_replaces_runs_only(tmp_path):
    """Neither a pipe under its own name, nor what is no stopped run under the name of one."""
    os.mkfifo(tmp_path / "a.h5")
    os.mkfifo(tmp_path / "b.stopped.h5")
    (tmp_path / "c.stopped.h5").write_text("mine")
    make_run(tmp_path / "d.stopped.h5", frames=2, n=3)
    for name, words in (("a", "a pipe"), ("b", "a pipe"), ("c", "no stopped run"), ("d", "no stopped run")):
        with pytest.raises(UserError, match=words):
            make_writer(tmp_path / f"{name}.h5")
    with make_writer(tmp_path / "e.h5") as writer:
        writer.append(**random_frame(0))
        os.mkfifo(tmp_path / "e.h5")
        with pytest.raises(UserError, match=r"e\.h5: it is a pipe"):
            writer.finish(1.0)
    with make_writer(tmp_path / "f.h5") as writer:
        writer.append(**random_frame(0))
        (tmp_path / "f.stopped.h5").write_text("mine")
        writer.finish(1.0)
    assert (tmp_path / "f.stopped.h5").read_text() == "mine"
    names = "a.h5 b.stopped.h5 c.stopped.h5 d.stopped.h5 e.h5 f.h5 f.stopped.h5".split()
    assert sorted(path.name for path in tmp_path.iterdir()) == names


# --- Readers of small files: whatever is there, an answer or one line, at once ---------------------------

READERS = (read_text, read_json, read_table, read_arrays)


def line_of(read, path: Path) -> str:
    """The line with which a reader refuses a file, within two seconds."""
    began = time.monotonic()
    with pytest.raises(UserError) as caught:
        read(path, "no list of tools", "make it again")
    assert time.monotonic() - began < 2.0
    said = str(caught.value)
    assert str(path) in said and said.endswith("; make it again") and "\n" not in said
    return said


@pytest.mark.parametrize("read", READERS)
def test_what_is_no_file_or_never_ends(tmp_path, read) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "device").symlink_to("/dev/zero")
    (tmp_path / "folder").mkdir()
    with (tmp_path / "large").open("wb") as file:
        file.truncate(1 << 40)
    assert "pipe or device" in line_of(read, tmp_path / "pipe")
    assert "pipe or device" in line_of(read, tmp_path / "device")
    assert "is no list of tools (it is larger than" in line_of(read, tmp_path / "large")
    assert "cannot read" in line_of(read, tmp_path / "folder")
    assert "cannot read" in line_of(read, tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("read", "content", "words"),
    [
        (read_text, b"\xff\xfe", "decode"),
        (read_json, b'{"a": ', "Expecting value"),
        (read_json, b"[" * 100_000, "nested too deep"),
        (read_json, b"1" * 5000, "digits"),
        (read_table, b"", "name columns"),
        (read_table, b"a,a\n1,2\n", "each once"),
        (read_table, b"a,b\n1,2\n3\n", "line 3 has 1 values"),
        (read_table, b"a\n" + b"x" * 200_000, "field larger"),
        (read_table, b"a" + b"\n,,,,," * 100_000, "line 2 has 6 values"),
        (read_arrays, b"", "zip"),
    ],
)
def test_damaged_content_is_one_line(tmp_path, read, content, words) -> None:
    (tmp_path / "a").write_bytes(content)
    assert words in line_of(read, tmp_path / "a")


def test_good_files(tmp_path) -> None:
    (tmp_path / "a.csv").write_text('\ufeffa,b\n1,"x\ny"\n\n2,z\n', encoding="utf-8")
    assert read_table(tmp_path / "a.csv", "", "") == [{"a": "1", "b": "x\ny"}, {"a": "2", "b": "z"}]
    (tmp_path / "a.json").write_text('{"a": [1, null]}')
    assert read_json(tmp_path / "a.json", "", "") == {"a": [1, None]}
    np.savez_compressed(tmp_path / "a.npz", x=np.arange(3.0))
    assert read_arrays(tmp_path / "a.npz", "", "")["x"].tolist() == [0.0, 1.0, 2.0]


def test_arrays_that_unfold_to_more_than_fits(tmp_path) -> None:
    zeros = b"\0" * (1 << 20)
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        with archive.open("x.npy", "w", force_zip64=True) as part:
            for _ in range((MOST_OF_ARRAYS >> 20) + 1):
                part.write(zeros)
    assert "unfolds to more than" in line_of(read_arrays, tmp_path / "a.npz")


def test_arrays_whose_headers_are_damaged(tmp_path) -> None:
    """Parts with right check sums and wrong headers."""
    buffer = io.BytesIO()
    np.save(buffer, np.arange(6.0).reshape(2, 3))
    good, rng = buffer.getvalue(), random.Random(0)
    for _ in range(300):
        damaged = bytearray(good)
        for _ in range(rng.choice([1, 1, 3])):
            damaged[rng.randrange(80)] = rng.choice(b"0123456789(){}[]',<>f8O\x00\xff")
        with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
            archive.writestr("x.npy", bytes(damaged))
        try:
            read_arrays(tmp_path / "a.npz", "no list of tools", "make it again")
        except UserError as error:
            assert "\n" not in str(error)


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="there is no /proc")
def test_a_folder_that_takes_no_files() -> None:
    with pytest.raises(UserError, match=r"cannot write /proc/a: .*; choose another output"):
        write_whole(Path("/proc/a"), "text")
