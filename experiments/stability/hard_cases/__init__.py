"""The hard cases: each module has a list CASES of what is hard, what must hold, and how it is measured.

They use the small scenes and runs of `support/sgns_testing`, as the tests do.
"""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path

sys.path.insert(1, str(Path(__file__).resolve().parents[3] / "support"))

from .case import Case, Row

__all__ = ["AREAS", "Case", "Row", "cases"]

AREAS = {
    "solver": ("corners", "steps", "soil", "tools", "laws"),
    "reduction": ("reduction",),
    "training": ("training",),
    "rollout": ("rollout",),
}
"""Area -> modules beside this one."""


def cases(area: str) -> dict[str, Case]:
    """The cases of an area by name, in order."""
    found: list[Case] = [
        case for module in AREAS[area] for case in import_module(f"{__name__}.{module}").CASES
    ]
    named = {case.name: case for case in found}
    if len(named) < len(found):
        raise ValueError(f"two cases of {area} have the same name")
    return named
