from dataclasses import dataclass

import pytest

from sgns import config as yaml_text
from sgns.config import UserError, check_fields, differences, flattened, parse_yaml

# ---  ---------------------------------------------------------------------------------------------------


def test_long_plain_text_is_read_whatever_its_length(monkeypatch) -> None:
    monkeypatch.setattr(yaml_text, "_MOST", 10)
    assert parse_yaml("[" + "1," * 50 + "1]") == [1] * 51


def test_what_aliases_stand_for_is_bounded(monkeypatch) -> None:
    monkeypatch.setattr(yaml_text, "_MOST", 10)
    with pytest.raises(ValueError, match="it stands for more than"):
        parse_yaml("a: &a [1,1,1,1,1,1]\nb: &b [*a,*a,*a,*a]\nc: [*b,*b,*b,*b]")


# ---  ---------------------------------------------------------------------------------------------------


@dataclass
class Some:
    """One field of every kind."""

    count: int
    rate: float
    limit: float | None
    mode: str
    on: bool
    weights: dict[str, float]


GOOD = {"count": 1, "rate": 1, "limit": None, "mode": "a", "on": False, "weights": {}}


def test_good_values_pass():
    check_fields(Some, GOOD, "some")


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"count": 1.0}, "some.count is 1.0; it must be a whole number"),
        ({"count": True}, "some.count is True; it must be a whole number"),
        ({"rate": "x"}, "some.rate is 'x'; it must be a finite number"),
        ({"rate": float("inf")}, "some.rate is inf; it must be a finite number"),
        ({"limit": "x"}, "some.limit is 'x'; it must be a finite number or null"),
        ({"mode": None}, "some.mode is None; it must be text"),
        ({"on": 1}, "some.on is 1; it must be true or false"),
        ({"extra": 1}, "some.extra is unknown; keys: count, limit"),
    ],
)
def test_bad_values_name_their_key(change, line):
    with pytest.raises(UserError, match=line):
        check_fields(Some, GOOD | change, "some")


def test_missing_key_is_named():
    with pytest.raises(UserError, match=r"some\.count is missing"):
        check_fields(Some, {k: v for k, v in GOOD.items() if k != "count"}, "some")


def test_differences_of_nested_settings():
    a, b = {"x": {"y": 1, "z": [1, 2]}, "w": 0}, {"x": {"y": 2, "z": [1, 2]}, "v": 3}
    assert flattened(a) == {"x.y": 1, "x.z": [1, 2], "w": 0}
    assert differences(a, b) == {"x.y": (1, 2), "w": (0, None), "v": (None, 3)}
    assert differences(a, a) == {}
