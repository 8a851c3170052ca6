"""The error that a person can repair."""

from __future__ import annotations

__all__ = ["UserError"]


class UserError(Exception):
    """Bad input from a person: one line with what, where, what is allowed and what to do."""
