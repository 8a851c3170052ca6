"""`dataset.yaml`: random text, and random values."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any

import hypothesis.strategies as st
import pytest
from hypothesis import given

from sgns.config import parse_yaml
from sgns.data.dataset import Dataset
from sgns_testing.fuzzing import YAML, bounded, cases, changed, refused_or_read


@pytest.fixture
def runs(tmp_path: Path) -> None:
    """Files that are looked for, not into."""
    (tmp_path / "runs").mkdir()
    for name in "abc":
        (tmp_path / "runs" / f"{name}.h5").touch()


def test_yaml_of_data(tmp_path, runs) -> None:
    @cases(100)
    @given(YAML, st.booleans())
    def check(text: str, alone: bool) -> None:
        with bounded(), contextlib.suppress(ValueError):
            parse_yaml(text)
        content = text if alone else f"split: {{train: [a], validation: [], test: []}}\n{text}"
        (tmp_path / "dataset.yaml").write_text(content, encoding="utf-8", errors="surrogatepass")
        refused_or_read(lambda: Dataset.open(tmp_path, {"gravity": 9.81} if alone else None))

    check()


def test_dataset_yaml(tmp_path, runs) -> None:
    content = {
        "name": "a",
        "split": {"train": ["a", "b"], "validation": [], "test": ["c"]},
        "scenes": {key: {"gravity": 1.0} for key in "abc"},
    }

    @cases(60)
    @given(changed(content), st.sampled_from([None, {"gravity": 1.0}, {"gravity": [1.0]}]))
    def check(tree: Any, where: Any) -> None:
        (tmp_path / "dataset.yaml").write_text(json.dumps(tree))
        refused_or_read(lambda: Dataset.open(tmp_path, where))

    check()
