"""Random values, text and bytes: what is good, with something wrong in it."""

from __future__ import annotations

import json
from typing import Any

import hypothesis.strategies as st

__all__ = ["NUMBERS", "TEXTS", "VALUES", "YAML", "changed", "damaged"]

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
                "a: ",
                "- ",
                "&x ",
                "*x",
                "[",
                "]",
                "{",
                "}",
                "\n",
                "  ",
                "!!python/object:os.system ",
                "!!binary ",
                "|\n",
                "<<: ",
                "? ",
                ": ",
                "'",
                '"',
                "# ",
                "%TAG",
                "---\n",
                "1",
                "2001-13-45",
                "split: ",
                "train: ",
                "scenes: ",
                "${oc.env:HOME}",
            ]
        ),
        max_size=25,
    ).map("".join),
    VALUES.map(json.dumps),
    st.integers(1, 30).map(lambda n: "a: &a [x,x]\n" + "b: &a [*a,*a]\n" * n),
    st.sampled_from([1, 90, 110, 5000]).map(lambda n: "[" * n + "]" * n),
)
