"""Readers of small files: whatever is there, an answer or one line, at once."""

from __future__ import annotations

import io
import os
import random
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest

from sgns.config import UserError
from sgns.data.small_files import MOST_OF_ARRAYS, read_arrays, read_bytes, read_json, read_table, read_text

READERS = (read_bytes, read_text, read_json, read_table, read_arrays)


def line_of(read, path: Path) -> str:
    """The line with which a reader refuses a file, within two seconds."""
    began = time.monotonic()
    with pytest.raises(UserError) as caught:
        read(path, "no list of tools", "make it again")
    assert time.monotonic() - began < 2.0
    said = str(caught.value)
    assert str(path) in said and said.endswith("; make it again") and "\n" not in said
    return said


@pytest.mark.parametrize("read", READERS)
def test_what_is_no_file_or_never_ends(tmp_path, read) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "device").symlink_to("/dev/zero")
    (tmp_path / "folder").mkdir()
    with (tmp_path / "large").open("wb") as file:
        file.truncate(1 << 40)
    assert "pipe or device" in line_of(read, tmp_path / "pipe")
    assert "pipe or device" in line_of(read, tmp_path / "device")
    assert "is no list of tools (it is larger than" in line_of(read, tmp_path / "large")
    assert "cannot read" in line_of(read, tmp_path / "folder")
    assert "cannot read" in line_of(read, tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("read", "content", "words"),
    [
        (read_text, b"\xff\xfe", "decode"),
        (read_json, b"", "Expecting value"),
        (read_json, b'{"a": ', "Expecting value"),
        (read_json, b"[" * 100_000, "nested too deep"),
        (read_json, b"1" * 5000, "digits"),
        (read_table, b"", "name columns"),
        (read_table, b"a,a\n1,2\n", "each once"),
        (read_table, b"a,b\n1,2\n3\n", "line 3 has 1 values"),
        (read_table, b"a\n" + b"x" * 200_000, "field larger"),
        (read_table, b"a" + b"\n,,,,," * 100_000, "line 2 has 6 values"),
        (read_arrays, b"", "zip"),
        (read_arrays, b"PK\x03\x04", "zip"),
    ],
)
def test_damaged_content_is_one_line(tmp_path, read, content, words) -> None:
    (tmp_path / "a").write_bytes(content)
    assert words in line_of(read, tmp_path / "a")


def test_good_files(tmp_path) -> None:
    (tmp_path / "a.csv").write_text('\ufeffa,b\n1,"x\ny"\n\n2,z\n', encoding="utf-8")
    assert read_table(tmp_path / "a.csv", "", "") == [{"a": "1", "b": "x\ny"}, {"a": "2", "b": "z"}]
    (tmp_path / "a.json").write_text('{"a": [1, null]}')
    assert read_json(tmp_path / "a.json", "", "") == {"a": [1, None]}
    np.savez_compressed(tmp_path / "a.npz", x=np.arange(3.0))
    assert read_arrays(tmp_path / "a.npz", "", "")["x"].tolist() == [0.0, 1.0, 2.0]


def test_arrays_that_unfold_to_more_than_fits(tmp_path) -> None:
    zeros = b"\0" * (1 << 20)
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        with archive.open("x.npy", "w", force_zip64=True) as part:
            for _ in range((MOST_OF_ARRAYS >> 20) + 1):
                part.write(zeros)
    assert "unfolds to more than" in line_of(read_arrays, tmp_path / "a.npz")


def test_arrays_whose_headers_are_damaged(tmp_path) -> None:
    """Parts with right check sums and wrong headers."""
    buffer = io.BytesIO()
    np.save(buffer, np.arange(6.0).reshape(2, 3))
    good, rng = buffer.getvalue(), random.Random(0)
    for _ in range(300):
        damaged = bytearray(good)
        for _ in range(rng.choice([1, 1, 3])):
            damaged[rng.randrange(80)] = rng.choice(b"0123456789(){}[]',<>f8O\x00\xff")
        with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
            archive.writestr("x.npy", bytes(damaged))
        try:
            read_arrays(tmp_path / "a.npz", "no list of tools", "make it again")
        except UserError as error:
            assert "\n" not in str(error)
