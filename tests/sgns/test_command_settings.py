"""Keys of commands: the classes and `conf` agree, and what is not allowed is refused."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import pytest
from omegaconf import OmegaConf

import sgns.command_settings as typed
from sgns.cli import COMMANDS
from sgns.config import UserError
from sgns.settings import Group
from sgns_testing import commands


@pytest.mark.parametrize("name", typed.COMMANDS)
def test_a_command_has_the_keys_of_its_class_with_their_defaults(name: str) -> None:
    cls = typed.COMMANDS[name]
    found: Any = OmegaConf.to_container(commands.composed(command=name))
    groups = {"dataset", "reduction", "model", "training", "preset", "scene", "material", "effects", "solver"}
    assert set(found) - groups - {"study", "numerics"} == {one.name for one in fields(cls)}
    for key, default in cls().to_dict().items():
        place = key == "output" and name not in ("simulate", "rollout")  # with the date
        plain = list(default) if isinstance(default, tuple) else default  # as YAML has it
        assert place or found[key] in ("???", plain), key
    assert ("output" in found) == (COMMANDS[name].output is not None)


@pytest.mark.parametrize(
    ("cls", "values", "line"),
    [
        (typed.Simulate, {"seed": -1}, "seed is -1; it must be a whole number, 0 or more"),
        (typed.Evaluate, {"new_rollouts": 5}, "new_rollouts is 5; it must be a list of run files"),
        (
            typed.Advise,
            {"error": 5},
            "error is 5; it must be a group of keys: give error.force, error.position, ",
        ),
        (
            typed.Advise,
            {"error": {"force": 30}},
            "error.force is 30.0; it must be a number above 0, at most 1, a share: for 30 % give 0.3",
        ),
        (typed.Advise, {"error": {"force": "x"}}, "error.force is 'x'; it must be a finite number"),
    ],
)
def test_a_value_that_is_not_allowed(cls: type[Group], values: dict[str, Any], line: str) -> None:
    with pytest.raises(UserError) as error:
        cls.from_dict(values)
    assert str(error.value).startswith(line)
