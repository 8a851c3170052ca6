"""The guide "my own bucket" from the mesh to the report: its own blocks and commands, with few short runs."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from sgns_testing.commands import sgns

PAGE = Path(__file__).resolve().parents[2] / "docs" / "guides" / "own_bucket.md"
COARSE = "scene.bed.spacing=0.04"
SMALL = {
    "simulate": [COARSE, "scene.duration=0.2"],
    "train": [
        *("reduction.max_modes=4", "reduction.num_modes=2", "model.hidden_width=8"),
        *("model.message_passing_steps=1", "training.threads=1", "training.max_steps=4"),
        *("training.validate_every=4", "training.warmup_steps=0"),
    ],
    "rollout": [COARSE, "scene.duration=0.2"],
    "plot": [],
    "evaluate": [],
}


@pytest.mark.timeout(300)
def test_the_guide_from_mesh_to_report(tmp_path, monkeypatch, no_pictures):
    monkeypatch.chdir(tmp_path)
    text = PAGE.read_text(encoding="utf-8")
    done = []
    for block, line in re.findall(r"^```python\n(.*?)^```$|^ {4}sgns (.*?)$", text, re.M | re.S):
        if block:
            small = block.replace("random_paths(60,", "random_paths(4,")
            exec(compile(small, PAGE.name, "exec"), {})
            continue
        command, *rest = shlex.split(line)
        result = sgns(tmp_path, command, *rest, *SMALL[command])
        assert result.returncode == 0, (line, result.stdout, result.stderr)
        done.append(command)
    assert done == ["simulate", "train", "rollout", "plot", "evaluate"]
    assert len((tmp_path / "data" / "own" / "runs.csv").read_text().splitlines()) == 5
    assert (tmp_path / "new.h5").exists() and list((tmp_path / "outputs" / "own_report").glob("*.html"))
