"""How log lines look on the terminal."""

from __future__ import annotations

import logging

__all__ = ["LineFormatter"]


class LineFormatter(logging.Formatter):
    """Plain text for information, the level's name first for warnings and errors."""

    def format(self, record: logging.LogRecord) -> str:
        line = super().format(record)
        return f"{record.levelname.lower()}: {line}" if record.levelno >= logging.WARNING else line
