"""The scripts of examples/ run in a folder of a user's own, and what they assert holds."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"
AFTER = {
    "best_of_100_paths": "train_and_step",
    "read_a_run": "bucket_on_a_path",
    "open_elsewhere": "bucket_on_a_path",
}
"""What makes the files that an example reads."""
LONG = {"import_runs", "learn_to_dig", "mujoco_bucket", "onnx_run", "open_elsewhere", "ros2_node"}
"""What takes many steps; tests of the package try what they use."""
ELSEWHERE = ("demo", "newton_runs")
"""See test_demo.py; Newton is not installed here and takes minutes."""
NAMES = sorted(file.stem for file in EXAMPLES.glob("*.py") if file.stem not in ELSEWHERE)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("examples")


def run(name: str, folder: Path) -> str:
    script = [sys.executable, str(EXAMPLES / f"{name}.py")]
    found = subprocess.run(script, cwd=folder, capture_output=True, text=True, timeout=110)
    assert found.returncode == 0, found.stdout + found.stderr
    (folder / name).touch()
    return found.stdout


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.long] if name in LONG else [])
        for name in [*(name for name in NAMES if name not in AFTER), *AFTER]
    ],
)
def test_an_example_holds_what_it_asserts(name: str, folder: Path) -> None:
    if name in AFTER and not (folder / AFTER[name]).exists():  # run alone
        run(AFTER[name], folder)
    assert "assert " in (EXAMPLES / f"{name}.py").read_text()
    assert run(name, folder)
