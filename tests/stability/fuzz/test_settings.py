"""Overrides and files of settings."""

from __future__ import annotations

import json
import string
import subprocess
from typing import Any

import hypothesis.strategies as st
import pytest
from hypothesis import given
from omegaconf import OmegaConf

from sgns.config import flattened
from sgns_testing.commands import SMALL, TRAIN, call, composed
from sgns_testing.fuzzing import NUMBERS, OUTCOMES, VALUES, YAML, cases, changed

SHOWN = st.one_of(
    NUMBERS.map(str),
    VALUES.map(json.dumps),
    st.text(string.printable, max_size=12),
    st.sampled_from("null [] {} ??? ${seed} ${oc.env:HOME} ${x ${scene} [1 ' 1,2 range(3)".split()),
    st.sampled_from([*"{a:1} [1,[2]] true auto nope -0.0 1e400 0x10 é a=b ~".split(), "  "]),
)


def defaults_of(command: str) -> dict[str, Any]:
    """Dotted keys of a command's settings and their values; those of groups have none."""
    values = flattened(OmegaConf.to_container(composed(command=command), resolve=False))
    groups = {key.partition(".")[0] for key in values} | {key.rpartition(".")[0] or key for key in values}
    return dict.fromkeys(sorted(groups - set(values))) | values


DEFAULTS = {
    name: defaults_of(name) for name in ("simulate", "train", "rollout", "reduce", "evaluate", "check")
}
CHANGEABLE = {
    name: [key for key, value in values.items() if value not in (None, [], "???")]
    for name, values in DEFAULTS.items()
}


@st.composite
def plausible(draw: Any, command: str) -> str:
    """A setting as somebody would change it: a number that is somewhat larger or smaller, or what it was."""
    key = draw(st.sampled_from(CHANGEABLE[command]))
    value = DEFAULTS[command][key]
    if type(value) in (int, float):
        value = type(value)(value * draw(st.sampled_from([0.5, 1, 1, 1.1, 2])))
    return f"{key}={json.dumps(value)}"


@st.composite
def anything(draw: Any, command: str) -> str:
    """Any value for any setting, or none."""
    sign = draw(st.sampled_from(["", "", "", "", "+", "++", "~"]))
    return f"{sign}{draw(st.sampled_from(list(DEFAULTS[command])))}={draw(SHOWN)}"


@st.composite
def overrides(draw: Any) -> list[str]:
    """A command with some of its settings changed at random."""
    names = ["simulate", "simulate", "train", "train", "rollout", "reduce", "evaluate", "check"]
    command = draw(st.sampled_from(names))
    good = draw(st.lists(plausible(command), max_size=3)) if CHANGEABLE[command] else []
    return [command, *good, *draw(st.lists(anything(command), min_size=not good, max_size=1))]


def counted(done: subprocess.CompletedProcess[str]) -> None:
    """The command was good enough to begin, or was refused without a traceback."""
    assert done.returncode in (0, 2) and "Traceback" not in done.stderr, done
    OUTCOMES["accepted" if done.returncode == 0 or done.stderr.endswith(": begun\n") else "refused"] += 1


def test_overrides(good, empty_folder, nothing_long) -> None:
    @cases(15)
    @given(overrides())
    def check(arguments: list[str]) -> None:
        command, *rest = arguments
        given_before = {
            "simulate": SMALL,
            "rollout": [*SMALL, f"checkpoint={good / 'out' / 'best.ckpt'}"],
            "train": [f"dataset.path={good / 'data'}", *TRAIN],
            "reduce": [f"dataset.path={good / 'data'}", *TRAIN[:2]],
            "evaluate": [f"dataset.path={good / 'data'}", f"checkpoint={good / 'out' / 'best.ckpt'}"],
            "check": [f"files=[{good / 'run.h5'}]"],
        }[command]
        done = call(command, *given_before, *rest)
        counted(done)
        assert done.returncode == 0 or done.stderr.splitlines()[-1].startswith(f"sgns {command}: "), done

    check()


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
            ["rollout", "checkpoint=a.ckpt", "rate_independent=nope"],
            "rate_independent is 'nope'; allowed: true, false",
        ),
    ],
)
def test_what_was_once_a_traceback_or_taken_for_something_else(arguments, words, empty_folder) -> None:
    (empty_folder / "path.csv").write_text("t,x,y,z,qx,qy,qz,qw\n0,0.1,0.1,0.1,0,0,0,1\n")
    done = call(*arguments)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and words in done.stderr, done.stderr
