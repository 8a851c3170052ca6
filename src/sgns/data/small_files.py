"""Small files that anybody may have written: JSON, CSV, YAML, NPZ, read whole within bounds.

What cannot be read is a `UserError` of one line with the file, what is wrong and what to do. Pipes and devices are
refused without waiting for them, larger files than asked for before they are read.
"""

from __future__ import annotations

import csv
import io
import json
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from mpm_warp import inputs
from sgns.config import UserError

MOST_BYTES = 1 << 22
"""Of text; a thousand times what this package writes of most."""
MOST_OF_ARRAYS = 1 << 27
"""Of an NPZ file, also after unpacking."""


def read_bytes(path: Path, wrong: str, advice: str, most: int = MOST_BYTES) -> bytes:
    """Content of a file.

    Args:
        path: the file.
        wrong: what it is where it is damaged, as in "no table of points"; for the message.
        advice: what a person can do then, the end of the message.
        most: largest size [bytes].

    Raises:
        UserError: it cannot be read, is larger, or is a pipe or device.
    """
    with _readable(path, wrong, advice):
        return inputs.read_bytes(path, most)


def read_text(path: Path, wrong: str, advice: str, most: int = MOST_BYTES) -> str:
    """Content of a text file in UTF-8; arguments and errors as `read_bytes`."""
    with _readable(path, wrong, advice):
        return inputs.read_text(path, most)


def read_json(path: Path, wrong: str, advice: str, most: int = MOST_BYTES) -> Any:
    """Data of a JSON file; arguments and errors as `read_bytes`."""
    with _readable(path, wrong, advice):
        return parse_json(inputs.read_text(path, most))


def parse_json(text: str | bytes) -> Any:
    """Data of JSON text.

    Raises:
        ValueError: it is none, or nested deeper than Python can follow.
    """
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("it is nested too deep") from error


def read_table(path: Path, wrong: str, advice: str, most: int = 1 << 24) -> list[dict[str, str]]:
    """Rows of a CSV file by the names in its first line; arguments and errors as `read_bytes`."""
    with _readable(path, wrong, advice):
        lines = csv.reader(io.StringIO(inputs.read_text(path, most), newline=""))
        columns = next(lines, [])
        if len(set(columns)) < len(columns) or not columns:
            raise ValueError("its first line does not name columns, each once")
        rows = []
        for values in lines:
            if values and len(values) != len(columns):
                raise ValueError(
                    f"line {lines.line_num} has {len(values)} values, the first line {len(columns)}"
                )
            if values:
                rows.append(dict(zip(columns, values, strict=True)))
        return rows


def read_arrays(path: Path, wrong: str, advice: str, most: int = MOST_OF_ARRAYS) -> dict[str, np.ndarray]:
    """Arrays of an NPZ file by name, without Python objects; arguments and errors as `read_bytes`.

    What compressed parts unfold to counts as the size of the file does.
    """
    with _readable(path, wrong, advice):
        packed = io.BytesIO(inputs.read_bytes(path, most))
        with zipfile.ZipFile(packed) as archive:
            if sum(part.file_size for part in archive.infolist()) > most:
                raise ValueError(f"it unfolds to more than {most / 1e6:.0f} MB")
        packed.seek(0)
        with np.load(packed, allow_pickle=False) as content:
            return dict(content)


@contextmanager
def _readable(path: Path, wrong: str, advice: str) -> Iterator[None]:
    try:
        yield
    except Exception as error:  # numpy, zipfile and csv raise almost anything on damaged bytes
        reason = " ".join(str(error).split()) or type(error).__name__
        if isinstance(error, OSError) and error.strerror:
            raise UserError(f"cannot read {path}: {error.strerror}; {advice}") from error
        raise UserError(f"{path} is {wrong} ({reason}); {advice}") from error
