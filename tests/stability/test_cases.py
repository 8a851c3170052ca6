"""The quick ones of the hard cases; `make stability` runs all of them."""

from __future__ import annotations

import math

import pytest
from areas import AREAS, cases
from case import Case

QUICK = [(area, name) for area in AREAS for name, case in cases(area).items() if case.quick]


@pytest.mark.parametrize(("area", "name"), QUICK)
def test_quick_case(area, name):
    row = cases(area)[name].run(area)
    assert row.passed, f"{row.quantity}: {row.measured:.4g} {row.unit}, limit {row.limit:g}; {row.note}"


def make_case(measure, limit=2.0):
    return Case("a", "b", "c", "d", limit, "m", measure)


@pytest.mark.parametrize(
    ("value", "limit", "passed", "margin"),
    [(1.0, 2.0, True, 0.5), (2.0, 2.0, True, 0.0), (3.0, 2.0, False, -0.5), (0.0, 0.0, True, 0.0)],
)
def test_margin(value, limit, passed, margin):
    row = make_case(lambda: value, limit).run("x")
    assert (row.passed, row.margin) == (passed, margin)


def test_nothing_is_allowed_beyond_a_limit_of_zero():
    row = make_case(lambda: 1, 0.0).run("x")
    assert not row.passed and row.margin == -math.inf


@pytest.mark.parametrize("value", [math.nan, math.inf, -1.0])
def test_what_is_no_measurement_fails(value):
    assert not make_case(lambda: value).run("x").passed


def test_a_measurement_that_breaks_down_fails_and_says_why():
    row = make_case(lambda: [][1]).run("x")
    assert not row.passed
    assert math.isnan(row.measured)
    assert row.note.startswith("IndexError")
