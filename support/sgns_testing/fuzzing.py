"""Random cases within bounds: bad input ends in one line and never in a traceback, a hang, or memory without end.

The cases follow from a fixed seed; `SGNS_FUZZ=20` makes twenty times as many from random seeds.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any

import hypothesis.strategies as st
from hypothesis import HealthCheck, Phase, settings

from mpm_warp import SceneError
from sgns.config import UserError

MORE = int(os.environ.get("SGNS_FUZZ", "1"))
SECONDS = 10
"""Of computing time, that a case may take."""
MEMORY = 2 << 30
"""Bytes of address space that a case may take beside what the tests have."""
OUTCOMES: Counter[str] = Counter()


def cases(count: int) -> Any:
    """Decorator's settings: so many cases, the same every time."""
    return settings(
        max_examples=count * MORE,
        derandomize=MORE == 1,
        database=None,
        deadline=None,
        phases=[Phase.generate],  # looking for smaller examples takes minutes
        suppress_health_check=list(HealthCheck),
    )


@contextlib.contextmanager
def bounded() -> Any:
    """Time and memory that a case may take."""

    def too_slow(number: int, frame: FrameType | None) -> None:
        raise AssertionError(f"more than {SECONDS} s of computing")

    limits = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = signal.signal(signal.SIGPROF, too_slow)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def refused_or_read(action: Any) -> None:
    """The action does its work, or says in one line why not."""
    with bounded():
        try:
            action()
            OUTCOMES["accepted"] += 1
        except (UserError, SceneError) as error:
            OUTCOMES["refused"] += 1
            assert str(error).strip() and len(str(error)) < 5000, error


# --- random values, text and bytes: what is good, with something wrong in it ------------------------------

NUMBERS = st.sampled_from(
    [0, -1, 1, 2, 3, 7, 1e-300, -1e300, 1e300, 10**20, -(10**20), 10**6, float("nan"), float("inf"), 0.5, 1e9]
)
TEXTS = st.text(max_size=12) | st.sampled_from(
    ["", "a", "..", "/", "\x00", "no such file", "../../x", "nan", "1"]
)
VALUES = st.recursive(
    NUMBERS | TEXTS | st.none() | st.booleans(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXTS, inner, max_size=3),
    max_leaves=5,
)


@st.composite
def changed(draw: Any, tree: Any) -> Any:
    """Nested data in which a few values are other ones, missing or new."""
    if isinstance(tree, dict) and tree and draw(st.integers(0, 3)):
        key = draw(st.sampled_from(sorted(tree, key=str)))
        kept = {k: v for k, v in tree.items() if k != key}
        action = draw(st.integers(0, 5))
        if action == 0:
            return kept
        if action == 1:
            return tree | {draw(TEXTS): draw(VALUES)}
        return tree | {key: draw(changed(tree[key]))}
    if isinstance(tree, list) and tree and draw(st.booleans()):
        index = draw(st.integers(0, len(tree) - 1))
        return [*tree[:index], draw(changed(tree[index])), *tree[index + 1 :]]
    return draw(VALUES)


class File(bytes):
    """Bytes that are not shown in full when a case fails."""

    def __repr__(self) -> str:
        return f"<{len(self)} bytes>"


def damaged(content: bytes) -> st.SearchStrategy[bytes]:
    """A file that was cut short, or in which bytes were changed, doubled or inserted."""
    return _damaged(File(content))


@st.composite
def _damaged(draw: Any, content: bytes) -> bytes:
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, max(0, len(content) - 1)))
        action = draw(st.integers(0, 4))
        if action == 0:
            content = content[:at]
        elif action == 1:
            content = content[:at] + draw(st.binary(min_size=1, max_size=8)) + content[at + 8 :]
        elif action == 2:
            content = content[:at] + draw(st.binary(min_size=1, max_size=20)) + content[at:]
        elif action == 3:
            content = (
                content[:at]
                + bytes([content[at] ^ 1 << draw(st.integers(0, 7))] if content else [])
                + content[at + 1 :]
            )
        else:
            content = content[:at] + b"\xff" * 8 + content[at + 8 :]
    return content


YAML = st.one_of(
    st.text(max_size=40),
    st.lists(
        st.sampled_from(
            [
                *("a: ", "- ", "&x ", "*x", "[", "]", "{", "}", "\n", "  ", "!!python/object:os.system "),
                *("!!binary ", "|\n", "<<: ", "? ", ": ", "'", '"', "# ", "%TAG", "---\n", "1", "2001-13-45"),
                *("split: ", "train: ", "scenes: ", "${oc.env:HOME}"),
            ]
        ),
        max_size=25,
    ).map("".join),
    VALUES.map(json.dumps),
    st.integers(1, 30).map(lambda n: "a: &a [x,x]\n" + "b: &a [*a,*a]\n" * n),
    st.sampled_from([1, 90, 110, 5000]).map(lambda n: "[" * n + "]" * n),
)
