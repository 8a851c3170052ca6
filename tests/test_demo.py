"""The demo: commands a user could type, in order, stopping at the first that fails."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from omegaconf import OmegaConf

from sgns.cli.commands import COMMANDS
from sgns.simulate.campaign import plan
from sgns.simulate.scene import scene_from_config
from sgns_testing.commands import composed, environment

SCRIPT = Path(__file__).resolve().parent.parent / "examples" / "demo.py"
SPEC = importlib.util.spec_from_file_location("demo", SCRIPT)
demo = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(demo)


@pytest.fixture
def calls(monkeypatch, empty_folder):
    """Commands the demo would run; `status` says how each ends."""
    made = SimpleNamespace(commands=[], status={})

    def run(arguments, check):
        command = arguments[3]
        made.commands.append(command)
        if command == "train" and not made.status.get(command):
            demo.CHECKPOINT.parent.mkdir(parents=True, exist_ok=True)
            demo.CHECKPOINT.touch()
        if command == "evaluate":
            demo.REPORT.parent.mkdir(parents=True, exist_ok=True)
            demo.REPORT.touch()
            later = demo.CHECKPOINT.stat().st_mtime + 1
            os.utime(demo.REPORT, (later, later))
        return SimpleNamespace(returncode=made.status.get(command, 0))

    monkeypatch.setattr(demo.subprocess, "run", run)
    return made


def test_steps_in_order_and_the_report_is_named(calls, capsys):
    assert demo.main() == 0
    assert calls.commands == ["simulate", "train", "rollout", "evaluate"]
    assert set(calls.commands) <= set(COMMANDS)
    assert str(demo.REPORT.resolve()) in capsys.readouterr().out


def test_a_report_newer_than_its_checkpoint_is_kept(calls):
    demo.main()
    demo.main()
    assert calls.commands.count("evaluate") == 1


def test_it_stops_at_the_first_failure(calls):
    calls.status["train"] = 2
    assert demo.main() == 2
    assert calls.commands == ["simulate", "train"]


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="has no groups of processes")
def test_ctrl_c_ends_the_command_and_the_demo_in_one_line(tmp_path):
    command, heed = (
        [sys.executable, str(SCRIPT)],
        "import signal; signal.signal(2, signal.default_int_handler)",
    )
    command = [sys.executable, "-c", f"{heed}; import os; os.execv({sys.executable!r}, {command!r})"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    process = subprocess.Popen(command, cwd=tmp_path, env=environment(), **pipes)
    assert process.stdout is not None
    while not process.stdout.readline().startswith("dataset in "):
        assert process.poll() is None, process.communicate()
    os.killpg(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=100)
    assert process.returncode == 130
    kept = "what is complete is kept, and the same command goes on from there"
    assert said == f"sgns simulate: interrupted; {kept}\n"


def test_the_new_path_is_in_no_run():
    asked = composed("scene=quick_excavation", "checkpoint=x", *demo.NEW_SCENE, command="rollout")
    new, base = scene_from_config(asked), composed("scene=quick_excavation", "dataset=quick")
    campaign = plan(OmegaConf.to_container(base.dataset), scene_from_config(base).to_dict(), {}, "float32", 0)
    assert len(campaign.scenes) >= 16
    for scene in campaign.scenes.values():
        assert scene.arrangement_hash == new.arrangement_hash
        assert (scene.rake, scene.depth, scene.speed) != (new.rake, new.depth, new.speed)
        assert scene.blade.thickness >= 2 * scene.bed.spacing
