"""A hard case: what is hard, what must hold all the same, and by how much it holds."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

__all__ = ["Case", "Row"]


@dataclass(frozen=True)
class Row:
    """A line of the table."""

    area: str
    name: str
    hard: str
    must: str
    quantity: str
    measured: float
    """NaN where the measurement itself broke down."""
    limit: float
    unit: str
    margin: float
    """Share of the limit that is left [-]: 1 - measured / limit, negative beyond it."""
    result: str
    """pass | fail"""
    quick: bool
    seconds: float
    note: str = ""
    """What the measurement says besides, or what broke."""

    @property
    def passed(self) -> bool:
        return self.result == "pass"


@dataclass(frozen=True)
class Case:
    """One hard case. Its quantity is 0 or more and the smaller the better; a limit of 0 allows nothing at all."""

    name: str
    """In words, unique within its area."""
    hard: str
    """What is hard about it."""
    must: str
    """The property that must hold."""
    quantity: str
    """What is measured for it."""
    limit: float
    """Of the quantity, from physics or from what a user can bear, chosen before measuring."""
    unit: str
    measure: Callable[[], float | tuple[float, str]] = field(repr=False)
    """Computes the case and returns the quantity, with a note if there is more to say."""
    quick: bool = False
    """Whether `make test` has it, too: a few seconds at most."""

    def run(self, area: str) -> Row:
        """Measure it. A measurement that raises has failed, and its row says why."""
        start = time.perf_counter()
        try:
            found = self.measure()
        except Exception as error:
            found = math.nan, f"{type(error).__name__}: {' '.join(str(error).split())}"
        return self.row(area, found, time.perf_counter() - start)

    def row(self, area: str, found: float | tuple[float, str], seconds: float) -> Row:
        """The line of the table for what was measured."""
        measured, note = found if isinstance(found, tuple) else (found, "")
        passed = 0.0 <= measured <= self.limit  # false for a NaN
        if self.limit > 0.0:
            margin = 1.0 - measured / self.limit
        else:
            margin = 0.0 if passed else -math.inf
        return Row(
            area=area,
            name=self.name,
            hard=self.hard,
            must=self.must,
            quantity=self.quantity,
            measured=float(measured),
            limit=self.limit,
            unit=self.unit,
            margin=float(margin),
            result="pass" if passed else "fail",
            quick=self.quick,
            seconds=seconds,
            note=note,
        )
