"""Small files that appear complete or not at all; for runs, which may fill the disk, see `sgns.runs.newfile`."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sgns.leftovers import give_name, hidden_beside, hold, remove_leftovers, require_replaceable

__all__ = ["whole_file", "write_whole"]


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A hidden path beside `path` to write to; it gets its name at the end, or is removed after an exception.

    Raises:
        UserError: `path` is a device, pipe, link or folder.
        OSError: The disk does not take it; the error names `path`.
    """
    require_replaceable(path)
    temporary = hidden_beside(path)
    try:
        remove_leftovers(path)
        with temporary.open("xb") as held:
            hold(held)
            yield temporary
            os.fsync(held.fileno())
        give_name(temporary, path)
    except OSError as error:
        if error.filename in (None, str(temporary)):  # a full disk is reported without a name
            error.filename = str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def write_whole(path: Path, text: str) -> None:
    """Write a text file in UTF-8."""
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
