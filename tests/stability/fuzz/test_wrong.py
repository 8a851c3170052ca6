"""A few of the wrong inputs that `experiments/stability/wrong_inputs.py` tries."""

from __future__ import annotations

import subprocess
import sys

import pytest

from sgns_testing.commands import environment

TRY = """
import pathlib, sys
from sgns_testing.wrong_inputs import every_case, run_cases
quick = [one for one in every_case() if one.command in ("simulate", "reduce", "check", "advise", "rollout")]
for one in run_cases(quick[::len(quick) // 6], pathlib.Path(sys.argv[1])):
    if one.fault:
        print(one)
"""


@pytest.mark.long
def test_wrong_inputs_are_refused_in_one_line(tmp_path) -> None:
    """In a process that has no threads yet: it forks."""
    done = subprocess.run(
        [sys.executable, "-c", TRY, str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=300,
        env=environment() | {"OMP_NUM_THREADS": "1"},
    )
    assert (done.returncode, done.stdout) == (0, ""), done.stdout + done.stderr
