"""The terminal: how log lines look, and what becomes of text that cannot be written."""

from __future__ import annotations

import logging
import os
import sys
from typing import TextIO

from sgns.errors import UserError

__all__ = ["LineFormatter", "open_closed_streams", "write_error", "write_output"]


class LineFormatter(logging.Formatter):
    """Plain text for information, the level's name first for warnings and errors."""

    def format(self, record: logging.LogRecord) -> str:
        line = super().format(record)
        return f"{record.levelname.lower()}: {line}" if record.levelno >= logging.WARNING else line


def open_closed_streams() -> None:
    """Let standard streams that were closed (`2>&-`) lead nowhere.

    Otherwise the next file that is opened gets the stream's number, and messages of libraries are written into it.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            nowhere = os.open(os.devnull, os.O_RDWR)  # the lowest number that is free
            os.set_inheritable(nowhere, True)
            stream = open(nowhere, "r" if number == 0 else "w", encoding="utf-8", closefd=False)
            setattr(sys, name, stream)


def write_output(text: str) -> None:
    """Write to standard output all that was and is to be written; what nobody reads any more is dropped.

    Raises:
        UserError: It cannot be written, for example since the disk is full.
    """
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except OSError as error:
        _lead_nowhere(sys.stdout)
        if not isinstance(error, BrokenPipeError):
            raise UserError(f"cannot write to standard output: {error.strerror}") from None


def write_error(line: str) -> None:
    """Write a line to standard error, if that is possible."""
    try:
        sys.stderr.write(f"{line}\n")
        sys.stderr.flush()
    except OSError:
        _lead_nowhere(sys.stderr)


def _lead_nowhere(stream: TextIO) -> None:
    """What is left in the stream's buffer would else fail once more when Python ends."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)
