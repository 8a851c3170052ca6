"""Which physics a run computes."""

from __future__ import annotations

from dataclasses import fields
from typing import ClassVar

from .settings import Settings, setting, settings
from .state import SceneError


@settings
class Effects(Settings):
    """Physics that can be left out; the kernels are compiled without what is off."""

    group: ClassVar[str] = "effects"

    # The help says why a run has an effect, the note why it does not, in run files too.
    yielding: bool = setting(
        True, "soil flows when shear exceeds friction", note="purely elastic soil was asked for"
    )
    rate_dependence: bool = setting(
        True,
        "friction rises with the inertial number, mu(I)",
        note="friction is the constant mu_s (Drucker-Prager)",
    )
    fluidity: bool = setting(
        False,
        "the fluidity follows its own dynamics with the time t_0",
        note="the fluidity takes its steady value at once",
    )
    nonlocality: bool = setting(
        False,
        "flow spreads over a few grain diameters",
        note="flow depends on the stress at the same place only",
    )
    separation: bool = setting(
        True, "soil below its critical density carries no stress", note="soil may carry tension"
    )
    symmetry: bool = setting(False, "half the bed is computed and mirrored", note="the whole bed is computed")
    torque: bool = setting(True, "the torque on the body is recorded", note="no torque is recorded")

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
        found: dict[str, dict[str, bool | str]] = {}
        for one in fields(self):
            on, known = getattr(self, one.name), one.metadata["setting"]
            found[one.name] = {"on": on, "reason": known.help if on else known.note}
        return found
