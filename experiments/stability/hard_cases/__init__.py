"""The hard cases: what is hard, what must hold and the limit stand in cases.csv, how it is measured here.

Each module has a table MEASURES: name of the case -> what measures it, a quantity of 0 or more, the smaller the better,
with a note if there is more to say. They use the small scenes and runs of `support/sgns_testing`, as the tests do.
"""

from __future__ import annotations

import csv
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[1:1] = [str(HERE.parents[1]), str(HERE.parents[2] / "support")]


AREAS = {
    "solver": ("corners", "steps", "soil", "tools", "laws"),
    "reduction": ("reduction",),
    "training": ("training",),
    "rollout": ("rollout",),
}
"""Area -> modules beside this one."""


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
    """A line of cases.csv: what is hard, what must hold, and the quantity that is measured for it."""

    name: str
    hard: str
    must: str
    quantity: str
    limit: float
    """Of the quantity, from physics or from what a user can bear, chosen before measuring; 0 allows nothing at all."""
    unit: str
    measure: Callable[[], float | tuple[float, str]] = field(repr=False)
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
        passed = bool(0.0 <= measured <= self.limit)  # false for a NaN
        beyond = 0.0 if passed else -math.inf
        margin = 1.0 - measured / self.limit if self.limit > 0.0 else beyond
        return Row(
            area, self.name, self.hard, self.must, self.quantity, float(measured), self.limit, self.unit,
            float(margin), "pass" if passed else "fail", self.quick, seconds, note,
        )  # fmt: skip


def cases(area: str) -> dict[str, Case]:
    """The cases of an area by name, in order."""
    measures: dict[str, Callable[[], float | tuple[float, str]]] = {}
    for module in AREAS[area]:
        measures |= import_module(f"{__name__}.{module}").MEASURES
    with (HERE.parent / "cases.csv").open(newline="", encoding="utf-8") as stream:
        rows = [row for row in csv.DictReader(stream) if row.pop("area") == area]
    if unlike := measures.keys() ^ {row["name"] for row in rows}:
        raise ValueError(f"cases.csv and the modules do not name the same cases: {sorted(unlike)}")
    return {
        row["name"]: Case(
            **row | {"limit": float(row["limit"]), "quick": row["quick"] == "yes"},
            measure=measures[row["name"]],
        )
        for row in rows
    }
