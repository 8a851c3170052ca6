import pytest

from sgns import config as yaml_text
from sgns.config import differences, flattened, parse_yaml


def test_long_plain_text_is_read_whatever_its_length(monkeypatch) -> None:
    monkeypatch.setattr(yaml_text, "_MOST", 10)
    assert parse_yaml("[" + "1," * 50 + "1]") == [1] * 51


def test_what_aliases_stand_for_is_bounded(monkeypatch) -> None:
    monkeypatch.setattr(yaml_text, "_MOST", 10)
    with pytest.raises(ValueError, match="it stands for more than"):
        parse_yaml("a: &a [1,1,1,1,1,1]\nb: &b [*a,*a,*a,*a]\nc: [*b,*b,*b,*b]")


def test_differences_of_nested_settings():
    a, b = {"x": {"y": 1, "z": [1, 2]}, "w": 0}, {"x": {"y": 2, "z": [1, 2]}, "v": 3}
    assert flattened(a) == {"x.y": 1, "x.z": [1, 2], "w": 0}
    assert differences(a, b) == {"x.y": (1, 2), "w": (0, None), "v": (None, 3)}
    assert differences(a, a) == {}
