"""TFRecords of the published data, and their metadata."""

from __future__ import annotations

import json
import struct
from typing import Any

import hypothesis.strategies as st
from hypothesis import given

from sgns.data.published import published_dataset
from sgns_testing.fuzzing import cases, changed, damaged, refused_or_read
from sgns_testing.published import record


def test_published_files(tmp_path) -> None:
    first = [[0.82, 0.30, 0.50], [0.82, 0.4, 0.50], [0.82, 0.3, 0.6], [1.0, 2.0, 3.0]]
    one = record([first] * 4, [3, 3, 3, 6], [[9, 9, 9]] * 4)
    data = struct.pack("<Q", len(one)) + b"crc!" + one + b"crc!"

    @cases(80)
    @given(
        damaged(data) | st.just(data),
        changed({"dataset_split": {"valid": [186]}}) | st.just({"dataset_split": {"valid": [186]}}),
    )
    def check(content: bytes, about: Any) -> None:
        (tmp_path / "valid.tfrecord").write_bytes(content)
        (tmp_path / "metadata.json").write_text(json.dumps(about))
        refused_or_read(lambda: published_dataset({"path": str(tmp_path)}, 1))

    check()
