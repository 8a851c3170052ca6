"""Measured times, which may be divided by."""

from __future__ import annotations

LEAST_TIME = 1.0e-9
"""[s]; the clocks count in such steps."""


def elapsed(began: float, now: float) -> float:
    """Time between two readings of a clock [s], above 0.

    The clock of a virtual machine that was paused may stand still or go back.
    """
    return max(now - began, LEAST_TIME)
