"""Commands that are killed lose nothing, and two processes or users that share a campaign make every run once."""

import csv
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml
from kills import COMMANDS, broken, same

from sgns.data.files import file_lock
from sgns.simulate.workers import simulate_campaign
from sgns_testing.campaigns import campaign
from sgns_testing.commands import environment
from sgns_testing.tiny import make_dataset

pytest.importorskip("fcntl", reason="needs fork, signals and file locks")

KILLS = Path(__file__).parents[2] / "experiments" / "stability" / "kills.py"


def killed_often(table: Path, *arguments: str) -> dict[str, dict[str, str]]:
    """The rows of the experiment's table by command, when nothing was lost."""
    command = [sys.executable, str(KILLS), "--seed", "5", "--table", str(table), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=590)
    assert done.returncode == 0, done.stdout + done.stderr
    with table.open(newline="") as file:
        rows = {row["command"]: row for row in csv.DictReader(file)}
    for row in rows.values():
        assert int(row["kills"]) >= 1 and int(row["completed"]) == int(row["equal"]) >= 1, row
        assert row["corrupt"] == row["orphans"] == row["leftovers"] == "0", row
    return rows


@pytest.mark.long
@pytest.mark.timeout(600)
def test_a_killed_training_goes_on_and_ends_as_if_nothing_had_happened(tmp_path):
    make_dataset(tmp_path / "data", frames=40)
    rows = killed_often(tmp_path / "kills.csv", "--kills", "1", "--data", str(tmp_path / "data"), "train")
    assert list(rows) == ["train"]


@pytest.mark.long
@pytest.mark.timeout(600)
def test_killed_commands_go_on_and_end_as_if_nothing_had_happened(tmp_path):
    rows = killed_often(tmp_path / "kills.csv", "--kills", "2")
    assert list(rows) == list(COMMANDS)
    assert all(int(row["kills"]) >= 2 for row in rows.values())


# --- two processes, one campaign --------------------------------------------------------------------------

NOBODY = 65534
LOCK = """
import sys
from pathlib import Path
from sgns_testing.permissions import become_ordinary
from sgns.data.files import file_lock
become_ordinary()
with file_lock(Path(sys.argv[1])) as ours:
    print(ours)
"""
DRAW = {"depth": [0.02, 0.03, 0.04, 0.05], "duration": [0.5]}
MAKE = f"""
import sys, pathlib
from sgns_testing.campaigns import campaign
from sgns.simulate.workers import simulate_campaign
made = campaign(pathlib.Path(sys.argv[1]), runs=4, draw={DRAW})
simulate_campaign(made, device="cpu", workers=1)
"""
RECORD = """
import os, sys
from pathlib import Path
from sgns_testing.campaigns import campaign
from sgns.config import UserError
made = campaign(Path(sys.argv[1]), seed=int(sys.argv[2]), runs=4)
print("ready", flush=True)
sys.stdin.readline()
try:
    made.record()
except UserError as error:
    sys.exit(str(error))
"""


def begin(code: str, *arguments: str) -> subprocess.Popen[str]:
    """Another process."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen([sys.executable, "-c", code, *arguments], text=True, env=environment(), **pipes)


@pytest.mark.long
def test_two_processes_one_of_them_killed_and_repeated(tmp_path) -> None:
    alone = campaign(tmp_path / "alone", runs=4, draw=DRAW)
    simulate_campaign(alone, device="cpu", workers=1)
    one, two = begin(MAKE, str(tmp_path / "shared")), begin(MAKE, str(tmp_path / "shared"))
    deadline = time.monotonic() + 60.0
    while not list(tmp_path.glob("shared/tiny/runs/*.h5")) and time.monotonic() < deadline:
        time.sleep(0.02)
    one.kill()
    one.communicate()
    for process in (two, None):  # another makes or clears away what the killed one had begun
        process = process or begin(MAKE, str(tmp_path / "shared"))
        said = process.communicate(timeout=100)
        assert process.returncode == 0, said
    assert broken(tmp_path / "shared") == []
    assert same(tmp_path / "alone", tmp_path / "shared")
    assert not [path for path in (tmp_path / "shared").rglob("*") if path.name.endswith(".partial")]


def test_of_two_campaigns_with_other_settings_the_second_is_refused(tmp_path) -> None:
    processes = [begin(RECORD, str(tmp_path), seed) for seed in ("0", "1")]
    for process in processes:
        assert process.stdout.readline() == "ready\n"
    for process in processes:
        process.stdin.write("\n")
        process.stdin.flush()
    said = [process.communicate(timeout=100)[1] for process in processes]
    assert sorted(process.returncode for process in processes) == [0, 1], said
    assert sum("made with other settings" in words for words in said) == 1
    winner = [process.returncode for process in processes].index(0)
    recorded = yaml.safe_load((tmp_path / "tiny" / "dataset.yaml").read_text())
    assert recorded == campaign(tmp_path, seed=winner, runs=4).describe()
    assert sorted(path.name for path in (tmp_path / "tiny").iterdir()) == ["dataset.yaml", "runs.csv"]


@pytest.mark.parametrize("umask", [0o022, 0o077])
def test_another_user_sees_a_lock_whatever_the_umask(tmp_path, umask) -> None:
    before = os.umask(umask)
    try:
        with file_lock(tmp_path / "a.h5") as ours:
            assert ours
            (lock,) = tmp_path.iterdir()
            if os.geteuid() == 0:
                os.chown(lock, NOBODY, NOBODY)  # as if the other one had made it
            assert lock.stat().st_mode & 0o006 == 0o006
            assert begin(LOCK, str(tmp_path / "a.h5")).communicate(timeout=100)[:2] == ("False\n", "")
    finally:
        os.umask(before)


def test_a_lock_left_by_another_user_in_a_shared_folder_is_taken_over(tmp_path) -> None:
    if os.geteuid() != 0:
        pytest.skip("needs files of another user")
    with file_lock(tmp_path / "a.h5"):
        (lock,) = tmp_path.iterdir()
        lock.rename(tmp_path / "kept")
    (tmp_path / "kept").rename(lock)  # as after a kill
    os.chown(lock, NOBODY, NOBODY)
    os.chown(tmp_path, NOBODY, NOBODY)
    tmp_path.chmod(0o1777)  # sticky: nobody may remove another user's file
    assert begin(LOCK, str(tmp_path / "a.h5")).communicate(timeout=100)[:2] == ("True\n", "")
