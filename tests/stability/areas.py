"""Where the hard cases are: each area is a module with a list CASES."""

from __future__ import annotations

from importlib import import_module

from case import Case

__all__ = ["AREAS", "cases"]

AREAS = {
    "solver": "solver_cases",
    "reduction": "reduction_cases",
    "training": "training_cases",
    "rollout": "rollout_cases",
}
"""Area -> module beside this one."""


def cases(area: str) -> dict[str, Case]:
    """The cases of an area by name, in order."""
    found: list[Case] = import_module(AREAS[area]).CASES
    named = {case.name: case for case in found}
    if len(named) < len(found):
        raise ValueError(f"two cases of {area} have the same name")
    return named
