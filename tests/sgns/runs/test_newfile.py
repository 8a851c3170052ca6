"""A file is complete under its name or not there at all, whatever the disk does."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from synthetic import make_run, make_writer, random_frame

from sgns.errors import UserError


def test_places_that_cannot_be_written_are_named(tmp_path):
    (tmp_path / "file").write_text("x")
    for path in (tmp_path, tmp_path / "file" / "a.h5", tmp_path / ("x" * 300), Path("/proc/nowhere/a.h5")):
        with pytest.raises(UserError) as caught:
            make_writer(path)
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_permission_is_named(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(UserError, match="Permission denied"):
        make_writer(tmp_path / "a.h5")
    tmp_path.chmod(0o700)


LIMITED = """
import resource, sys
from pathlib import Path
from synthetic import make_run
from sgns.errors import UserError
folder, limit = Path(sys.argv[1]), int(sys.argv[2])
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
try:
    make_run(folder / "a.h5", frames=30, n=200)
except UserError as error:
    print(error)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs resource limits")
@pytest.mark.parametrize("limit", [1, 1_000, 30_000, 145_000, 155_000, 160_000])
def test_a_disk_that_fills_up_at_any_moment(tmp_path, limit):
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(tmp_path), str(limit)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == "" and done.stdout.count("\n") == 1 and "cannot write" in done.stdout
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(sys.platform == "win32", reason="needs file locks")
def test_leftovers_of_killed_processes_go_and_those_of_living_ones_stay(tmp_path):
    with make_writer(tmp_path / "a.h5"):
        (alive,) = tmp_path.iterdir()
        host = alive.name.removeprefix(".a.h5.").rsplit("-", 2)[0]
        dead = subprocess.Popen([sys.executable, "-c", ""])
        dead.wait()
        killed = tmp_path / f".a.h5.{host}-{dead.pid}-00000000.partial"
        elsewhere = tmp_path / f".a.h5.other-{dead.pid}-00000000.partial"
        for leftover in (killed, elsewhere):
            leftover.write_bytes(b"x")
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
