"""How log lines look on the terminal."""

from __future__ import annotations

import logging

__all__ = ["LineFormatter", "quiet_libraries"]


class LineFormatter(logging.Formatter):
    """Plain text for information, the level's name first for warnings and errors."""

    def format(self, record: logging.LogRecord) -> str:
        line = super().format(record)
        return f"{record.levelname.lower()}: {line}" if record.levelno >= logging.WARNING else line


def quiet_libraries() -> None:
    """Leave only warnings of the libraries that set their own log level when they are imported."""
    for name in ("lightning", "lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
