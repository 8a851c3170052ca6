"""Commands that are killed lose nothing: a few of the kills of experiments/stability/kills.py."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("fcntl", reason="needs fork and signals")

KILLS = Path(__file__).parents[2] / "experiments" / "stability" / "kills.py"


@pytest.mark.timeout(600)
def test_killed_commands_go_on_and_end_as_if_nothing_had_happened(tmp_path):
    table = tmp_path / "kills.csv"
    command = [sys.executable, str(KILLS), "--kills", "2", "--seed", "5", "--table", str(table)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=590)
    assert done.returncode == 0, done.stdout + done.stderr
    with table.open(newline="") as file:
        rows = {row["command"]: row for row in csv.DictReader(file)}
    assert set(rows) == {
        *("simulate", "reduce", "train", "train polynomial", "rollout", "rollout polynomial")
    }
    for row in rows.values():
        assert int(row["kills"]) >= 2 and int(row["completed"]) == int(row["equal"]) >= 1, row
        assert row["corrupt"] == row["orphans"] == row["leftovers"] == "0", row
