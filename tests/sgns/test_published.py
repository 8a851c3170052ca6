"""Reader of the authors' files, on records written here."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest

from sgns.errors import UserError
from sgns.published import excavation_case, read_published

BIN = (0.8, 0.6, 0.15)


def varint(n):
    out = b""
    while n > 127:
        out += bytes([n & 127 | 128])
        n >>= 7
    return out + bytes([n])


def field(number, content):
    return varint(number << 3 | 2) + varint(len(content)) + content


def feature(raw):
    return field(1, field(1, raw))


def record(frames, types, force):
    entry = lambda key, value: field(1, field(1, key.encode()) + field(2, value))  # noqa: E731
    context = entry("particle_type", feature(np.asarray(types, "<i8").tobytes())) + entry(
        "key", field(3, field(1, b""))
    )
    series = lambda rows: b"".join(field(1, feature(np.asarray(r, "<f4").tobytes())) for r in rows)  # noqa: E731
    return field(1, context) + field(2, entry("position", series(frames)) + entry("force", series(force)))


def write(folder, records, cases):
    (folder / "metadata.json").write_text(json.dumps({"dataset_split": {"valid": cases}}))
    data = b"".join(struct.pack("<Q", len(r)) + b"crc!" + r + b"crc!" for r in records)
    (folder / "valid.tfrecord").write_bytes(data)


def test_axes_signs_and_the_doubled_first_frame(tmp_path):
    # One body node, one mode; there: y up, x backwards, the bin from 0.1 on.
    first = [[0.82, 0.30, 0.50], [1.0, 2.0, 3.0]]
    frames = [first, first, [[0.72, 0.20, 0.55], [4.0, 5.0, 6.0]]]
    write(tmp_path, [record(frames, [3, 6], [[9, 9, 9], [10, 20, 30], [11, 21, 31]])], [186])
    (run,) = read_published(tmp_path, BIN)
    assert run.case == 186
    np.testing.assert_allclose(run.body_points[:, 0], [[0.08, 0.40, 0.05], [0.18, 0.45, -0.05]], atol=1e-6)
    np.testing.assert_allclose(run.latent[:, 0], [[1, 2, 3], [4, 5, 6]])
    # A force that resists the blade is positive there and negative here.
    np.testing.assert_allclose(run.force, [[-10, 30, 20], [-11, 31, 21]])


def test_case_numbers():
    assert excavation_case(186) == {"depth": 0.08, "speed": 0.10, "rake": 10.0, "motion": "curved"}
    assert excavation_case(1) == {"depth": 0.02, "speed": 0.01, "rake": 0.0, "motion": "ramp"}
    with pytest.raises(UserError, match="1 to 250"):
        excavation_case(251)


@pytest.mark.parametrize("damage", ["missing", "short", "foreign", "count"])
def test_what_is_not_published_data_is_refused(tmp_path, damage):
    good = record([[[0.0] * 3] * 2] * 3, [3, 6], [[0.0] * 3] * 3)
    write(tmp_path, [b"not a message" if damage == "foreign" else good], [1, 2] if damage == "count" else [1])
    if damage == "missing":
        (tmp_path / "metadata.json").unlink()
    if damage == "short":
        (tmp_path / "valid.tfrecord").write_bytes((tmp_path / "valid.tfrecord").read_bytes()[:-9])
    with pytest.raises(UserError):
        read_published(tmp_path, BIN)
