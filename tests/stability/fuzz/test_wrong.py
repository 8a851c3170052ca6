"""Absurd values for every setting of every command, drawn from the definitions: one line each, and nothing costly.

`make stability` draws 800 and prints their kinds, counts and what the worst took.
"""

from __future__ import annotations

import random
import resource
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from sgns.cli import COMMANDS
from sgns.config import flattened
from sgns_testing.commands import SMALL, TRAIN, call, composed

KINDS = {
    "not a number": ["nan", "-inf", "inf", "null", "true"],
    "huge": ["1e300", "-1e300", "1e30", "99999999999999999999999", "1e12", "1000000"],
    "tiny": ["1e-300", "-1e-300", "0", "-1", "0.4999999999", "10.5"],
    "texts": ["abc", "''", "'1'", "meta", "../x"],
    "lists": ["[]", "[1,2,3]", "[a,b,c]", "[nan,0,0]", "[[1],[1,2]]", "[null]", "5", "{}", "{a:1}"],
}
PATHS = ["[[0,1e300,0,0,0,0,0,1]]", "[[0,0.1,0.1,0.1,0,0,0,0]]", "[[0],[1,2]]", "[[[1]]]", "true", "5", "{}"]


def drawn(count: int) -> list[tuple[str, str, list[str]]]:
    """Kind, command and overrides of so many cases, the same every time."""
    chance = random.Random(15)
    found: list[tuple[str, str, list[str]]] = []
    keys: dict[str, list[str]] = {}
    for name in COMMANDS:
        if name not in ("frontier", "check"):
            plain: Any = OmegaConf.to_container(composed(command=name), resolve=False)
            keys[name] = sorted(flattened(plain))
    while len(found) < count:
        name = chance.choice(sorted(keys))
        if chance.random() < 0.05:
            found.append(("paths", "simulate", ["scene=body", f"scene.path={chance.choice(PATHS)}"]))
            continue
        kind = chance.choice(sorted(KINDS))
        found.append((kind, name, [f"{chance.choice(keys[name])}={chance.choice(KINDS[kind])}"]))
    return found


@pytest.mark.parametrize(
    "count", [100, pytest.param(800, marks=[pytest.mark.long, pytest.mark.timeout(3600)])]
)
def test_absurd_values(count: int, good: Path, empty_folder: Path, nothing_long: None) -> None:
    dataset = [f"dataset.path={good / 'data'}"]
    given = {
        "rollout": [*SMALL, f"checkpoint={good / 'out' / 'best.ckpt'}"],
        "train": [*dataset, *TRAIN],
        "reduce": [*dataset, *TRAIN[:2]],
        "evaluate": [*dataset, f"checkpoint={good / 'out' / 'best.ckpt'}"],
    }
    counts, slowest, wrong = Counter[str](), 0.0, []
    for kind, command, overrides in drawn(count):
        small = SMALL if command == "simulate" and kind != "paths" else []
        began = time.monotonic()
        try:
            done = call(command, *given.get(command, small), *overrides)
        except Exception as error:  # what would be a traceback
            wrong.append((command, overrides, repr(error)))
            continue
        took = time.monotonic() - began
        slowest = max(slowest, took)
        counts[f"{kind}, {'accepted' if done.returncode == 0 else 'refused'}"] += 1
        if done.returncode not in (0, 2) or "Traceback" in done.stderr or took > 20:
            wrong.append((command, overrides, f"{done.returncode} {took:.1f} s {done.stderr[-300:]}"))
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(f"\n{dict(sorted(counts.items()))}; at most {slowest:.1f} s and {memory:.2g} GB")
    assert not wrong, "\n".join(map(str, wrong))
    assert memory < 3
