"""Files of settings, and overrides that once were a traceback."""

from __future__ import annotations

import json
import subprocess

import pytest
from hypothesis import given

from sgns_testing.commands import SMALL, call
from sgns_testing.fuzzing import OUTCOMES, YAML, cases, changed


def counted(done: subprocess.CompletedProcess[str]) -> None:
    """The command was good enough to begin, or was refused without a traceback."""
    assert done.returncode in (0, 2) and "Traceback" not in done.stderr, done
    OUTCOMES["accepted" if done.returncode == 0 or done.stderr.endswith(": begun\n") else "refused"] += 1


def test_yaml_of_settings(empty_folder, good, nothing_long) -> None:
    (empty_folder / "conf" / "experiment").mkdir(parents=True)

    scene = {"kind": "excavation", "duration": 0.2, "speed": 0.05, "bed": {"size": [0.4, 0.2, 0.16]}}
    settings = {"scene": scene, "seed": 1, "hydra": {"verbose": True}, "defaults": ["_self_"]}

    @cases(8)
    @given(YAML | changed(settings).map(json.dumps))
    def check(text: str) -> None:
        file = empty_folder / "conf" / "experiment" / "x.yaml"
        file.write_text("# @package _global_\n" + text, encoding="utf-8", errors="surrogatepass")
        done = call("simulate", "--config-dir", str(empty_folder / "conf"), *SMALL, "experiment=x")
        counted(done)

    check()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["simulate", "dataset={}"], "dataset.name is missing"),
        (["simulate", "scene.kind=[]"], "scene.kind is []; allowed"),
        (
            ["simulate", "scene=body", "scene.path=path.csv", "scene.tool.shape={}"],
            "tool.shape is {}; allowed",
        ),
        (["simulate", "scene=body", "scene.path=[1,2,3]"], "row 1 of the path is 1; it needs 8 numbers"),
        (["simulate", "scene=body", "scene.path=[[0,0,0,0,0,0,0,a]]"], "row 1 of the path holds 'a'"),
        (["simulate", "scene=body", "scene.path=[[0,1e300,0,0,0,0,0,1]]"], "row 1 of the path holds 1e+300"),
        (["simulate", "scene.depth=1e300"], "scene.depth is 1e+300 m; allowed: 0 to 1000"),
        (["train", "model.hidden_width=10000", "model.hidden_layers=100"], "about 6e+10 weights; at most"),
        (["train", "device=meta"], "device is 'meta', which holds no numbers"),
        (
            ["rollout", "checkpoint=a.ckpt", "scene=excavation", "rate_independent=nope"],
            "rate_independent is 'nope'; allowed: true, false",
        ),
    ],
)
def test_what_was_once_a_traceback_or_taken_for_something_else(arguments, words, empty_folder) -> None:
    (empty_folder / "path.csv").write_text("t,x,y,z,qx,qy,qz,qw\n0,0.1,0.1,0.1,0,0,0,1\n")
    done = call(*arguments)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and words in done.stderr, done.stderr
