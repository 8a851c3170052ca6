"""Numbers of a scene that the dynamics are told."""

from __future__ import annotations

import numpy as np
import pytest

from sgns.errors import UserError
from sgns.learning.context import context_of


@pytest.mark.parametrize("number", [100, 100.0, np.float32(100.0), np.int64(100)])
def test_a_number_is_told_whatever_its_type(number) -> None:
    found = context_of(
        {"load": number, "material": {"friction_angle": 30.0}}, ["load", "material.friction_angle"]
    )
    assert found.dtype == np.float64 and found.tolist() == [100.0, 30.0]


@pytest.mark.parametrize("bad", [np.nan, np.inf, True, "100", None])
def test_what_is_no_finite_number_is_named(bad) -> None:
    with pytest.raises(UserError, match=r"load .*(must be finite|needs)|no number load"):
        context_of({"load": bad}, ["load"])
