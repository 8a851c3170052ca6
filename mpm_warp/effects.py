"""Which physics a run computes."""

from __future__ import annotations

from dataclasses import fields
from typing import ClassVar

from .settings import Settings, setting, settings
from .state import SceneError

_REASONS = {
    "yielding": ("soil flows when shear exceeds friction", "purely elastic soil was asked for"),
    "rate_dependence": (
        "friction rises with the inertial number, mu(I)",
        "friction is the constant mu_s (Drucker-Prager)",
    ),
    "fluidity": (
        "the fluidity follows its own dynamics with the time t_0",
        "the fluidity takes its steady value at once",
    ),
    "nonlocality": (
        "flow spreads over a few grain diameters",
        "flow depends on the stress at the same place only",
    ),
    "separation": ("soil below its critical density carries no stress", "soil may carry tension"),
    "symmetry": ("half the bed is computed and mirrored", "the whole bed is computed"),
    "torque": ("the torque on the body is recorded", "no torque is recorded"),
}


@settings
class Effects(Settings):
    """Physics that can be left out; the kernels are compiled without what is off."""

    group: ClassVar[str] = "effects"

    yielding: bool = setting(True, "frictional yield; off: elastic soil")
    rate_dependence: bool = setting(True, "mu(I); off: a constant mu_s; needs yielding")
    fluidity: bool = setting(False, "the fluidity has its own dynamics; needs rate_dependence")
    nonlocality: bool = setting(
        False, "cooperative flow, the Laplacian of the fluidity; needs rate_dependence"
    )
    separation: bool = setting(True, "no stress below the critical density; off: soil can carry tension")
    symmetry: bool = setting(
        False,
        "half the bed is computed and mirrored; needs a scene that is mirror symmetric about y = Ly / 2",
    )
    torque: bool = setting(True, "the torque on a body is added up; off: it is recorded as 0")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.rate_dependence and not self.yielding:
            raise SceneError(
                "effects.rate_dependence needs effects.yielding: soil that does not yield has no friction that could "
                "depend on the rate; set effects.rate_dependence=false"
            )
        for name in ("fluidity", "nonlocality"):
            if getattr(self, name) and not self.rate_dependence:
                raise SceneError(
                    f"effects.{name} needs effects.rate_dependence: the fluidity is what the rate law mu(I) leads to; "
                    f"set effects.rate_dependence=true or effects.{name}=false"
                )

    def described(self) -> dict[str, dict[str, bool | str]]:
        """Each effect with its state and the reason, as stored in a run file."""
        return {
            f.name: {
                "on": getattr(self, f.name),
                "reason": _REASONS[f.name][0 if getattr(self, f.name) else 1],
            }
            for f in fields(self)
        }
