"""What soil may do at the floor and the walls of its bin."""

from __future__ import annotations

import math
from dataclasses import dataclass

from .errors import SceneError

__all__ = ["Walls"]

KINDS = ("no_slip", "slip", "periodic")


@dataclass(frozen=True)
class Walls:
    """Condition at each pair of walls and at the floor.

    - `no_slip`: soil sticks, also where it would move away.
    - `slip`: soil moves along the wall freely, but neither into it nor away from it.
    - a number, 0 or more: Coulomb friction with that coefficient; soil may move away.
    - `periodic` (x or y): no walls; what leaves at one end comes in at the other.
    """

    x: str | float = "no_slip"
    """The walls at x = 0 and x = Lx."""
    y: str | float = "no_slip"
    """The walls at y = 0 and y = Ly."""
    floor: str | float = "no_slip"
    """The floor at z = -Lz."""

    def __post_init__(self) -> None:
        for name in ("x", "y", "floor"):
            value = getattr(self, name)
            kinds = KINDS if name != "floor" else KINDS[:2]
            friction = isinstance(value, (int, float)) and not isinstance(value, bool)
            if friction and math.isfinite(value) and value >= 0:
                object.__setattr__(self, name, float(value))
            elif friction or value not in kinds:
                raise SceneError(
                    f"bed.walls.{name} is {value!r}; allowed: {', '.join(kinds)} or a friction coefficient of 0 or more"
                )

    @property
    def kinds(self) -> tuple[str, str, str]:
        """`no_slip`, `slip`, `friction` or `periodic` for x, y and the floor: what the kernels are compiled for."""
        return tuple(v if isinstance(v, str) else "friction" for v in (self.x, self.y, self.floor))

    @property
    def friction(self) -> tuple[float, float, float]:
        """Coulomb coefficients for x, y and the floor, 0 where there is no friction [-]."""
        return tuple(0.0 if isinstance(v, str) else v for v in (self.x, self.y, self.floor))
