"""Which effects a scene calls for, decided from the scene alone by named dimensionless numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import NamedTuple

from .effects import Effects
from .errors import SceneError
from .expected_flow import Flow, expected_flow
from .scene import Scene
from .size import scene_size
from .symmetry import asymmetry, require_symmetry

__all__ = ["EFFECTS", "Decision", "Tolerances", "effects_for"]

EFFECTS = (*(f.name for f in fields(Effects)), "free_body")
"""What can be asked for: the switches of `Effects`, and whether the body's height is free."""


@dataclass(frozen=True)
class Tolerances:
    """How little an effect may do before it is left out."""

    friction: float = 0.005
    """Rate dependence: what mu(I) adds to the friction, as a share of mu_s [-]."""
    grid: float = 0.03
    """Nonlocality: A d, as a share of the grid spacing [-]."""
    reach: float = 0.02
    """Nonlocality: the cooperativity length, as a share of the thickness of the flowing layer [-]."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            number = isinstance(value, (int, float)) and not isinstance(value, bool)
            if not (number and math.isfinite(value) and value >= 0.0):
                raise SceneError(
                    f"effects.tolerance.{field.name} is {value!r}; it must be a number, 0 or more"
                )


class Decision(NamedTuple):
    """On or off, why, and the number that decided it."""

    on: bool
    reason: str
    number: float | None = None


def effects_for(
    scene: Scene,
    asked: Mapping[str, bool | str] | None = None,
    tolerances: Tolerances | None = None,
) -> tuple[Effects, dict[str, Decision]]:
    """The effects to compute a scene with.

    Args:
        scene: what will be computed.
        asked: effect → True, False or "auto"; what is not in it is "auto".
        tolerances: for "auto".

    Returns:
        The effects, and the decision about each name in `EFFECTS`.

    Raises:
        SceneError: something unknown was asked for, or what this scene cannot have; or the scene is too large.
    """
    asked = _checked(asked or {})
    scene_size(scene)  # what follows looks at all particles
    tolerances = tolerances or Tolerances()
    flow = expected_flow(scene)
    found: dict[str, Decision] = {}

    def settle(name: str, auto: Decision) -> None:
        wanted = asked[name]
        if wanted == "auto":
            found[name] = auto
        elif wanted == auto.on:
            found[name] = Decision(wanted, f"asked for; so would auto: {auto.reason}", auto.number)
        else:
            against = f"asked for; auto would turn it {'on' if auto.on else 'off'}: {auto.reason}"
            found[name] = Decision(wanted, against, auto.number)

    settle("yielding", Decision(True, "granular soil flows when shear exceeds friction"))
    rate = _rate_dependence(scene, flow, tolerances)
    missing = "yielding" if asked["yielding"] is False else "rate_dependence"
    if asked[missing] is False:
        without = Decision(False, f"it needs effects.{missing}, which is off")
        for name in ("fluidity", "nonlocality"):
            settle(name, without)
        settle("rate_dependence", without if missing == "yielding" else rate)
    else:
        settle("fluidity", _fluidity(scene, flow))
        settle("nonlocality", _nonlocality(scene, flow, tolerances))
        needing = [name for name in ("fluidity", "nonlocality") if found[name].on]
        if needing and not rate.on:
            rate = Decision(True, f"effects.{needing[0]} needs it; by itself: {rate.reason}", rate.number)
        settle("rate_dependence", rate)
    settle("separation", Decision(True, "the surface is free: soil near it can come apart"))
    settle("symmetry", _symmetry(scene))
    settle("torque", _torque(scene))
    settle("free_body", _free_body(scene))
    _require_possible(scene, asked)
    effects = Effects(**{f.name: found[f.name].on for f in fields(Effects)})
    return effects, {name: found[name] for name in EFFECTS}


def _rate_dependence(scene: Scene, flow: Flow | None, tolerances: Tolerances) -> Decision:
    """By the friction that the inertial number adds."""
    if flow is None:
        return Decision(False, "nothing drives a flow", 0.0)
    material = scene.material
    added = material.friction_at(flow.inertial_number) / material.static_friction - 1.0
    words = f"{_moves(flow)}, inertial number {flow.inertial_number:.2g}: it adds {_percent(added)} to mu_s"
    return _against("tolerance.friction", added, tolerances.friction, words)


def _fluidity(scene: Scene, flow: Flow | None) -> Decision:
    """Never on by itself: see docs/solver.md."""
    always = "its dynamics overshoot, so auto leaves it to those who compare with the released solver"
    if flow is None:
        return Decision(False, always)
    material = scene.material
    above = material.friction_at(flow.inertial_number) - material.static_friction
    ratio = material.fluidity_time / above * flow.rate
    return Decision(False, f"{always}; its relaxation time is {ratio:.2g} of the time of deformation", ratio)


def _nonlocality(scene: Scene, flow: Flow | None, tolerances: Tolerances) -> Decision:
    """By A d against the grid spacing, then by the cooperativity length against the flowing layer."""
    if flow is None:
        return Decision(False, "nothing drives a flow", 0.0)
    material = scene.material
    resolved = material.nonlocal_amplitude * material.grain_diameter / scene.bed.spacing
    words = f"A d is {resolved:.2g} grid spacings"
    if resolved < tolerances.grid:
        return _against("tolerance.grid", resolved, tolerances.grid, words)
    length = material.cooperativity_length(material.friction_at(flow.inertial_number))
    reach = length / flow.thickness
    words += (
        f" and the cooperativity length {1e3 * length:.2g} mm {_percent(reach)} of the flowing layer, "
        f"{1e3 * flow.thickness:.2g} mm"
    )
    return _against("tolerance.reach", reach, tolerances.reach, words)


def _symmetry(scene: Scene) -> Decision:
    reason = asymmetry(scene)
    if reason is None:
        return Decision(True, "bed, body and motion are their own mirror image about mid-width")
    return Decision(False, reason)


def _torque(scene: Scene) -> Decision:
    return Decision(True, "the body turns soil") if scene.body else Decision(False, "there is no body")


def _free_body(scene: Scene) -> Decision:
    if scene.axle is not None:
        return Decision(
            True, f"the body's height is free; it carries {scene.axle.mass * scene.gravity:.4g} N"
        )
    return Decision(False, "the body's motion is prescribed" if scene.body else "there is no body")


def _require_possible(scene: Scene, asked: Mapping[str, bool | str]) -> None:
    if asked["symmetry"] is True:
        require_symmetry(scene)
    if asked["torque"] is True and scene.body is None:
        raise SceneError("effects.torque needs a body and this scene has none; set effects.torque=auto")
    if asked["free_body"] is True and scene.axle is None:
        raise SceneError(
            "effects.free_body needs a body whose height is free, as in scene=wheel; set effects.free_body=auto"
        )
    if asked["free_body"] is False and scene.axle is not None:
        raise SceneError(
            f"effects.free_body is false, but the height of the body in a scene of kind {scene.kind} is always free; "
            "set effects.free_body=auto"
        )


def _checked(asked: Mapping[str, bool | str]) -> dict[str, bool | str]:
    for name, value in asked.items():
        if name not in EFFECTS:
            raise SceneError(f"effects has no key {name!r}; allowed: {', '.join(EFFECTS)}")
        if not isinstance(value, bool) and value != "auto":
            raise SceneError(f"effects.{name} is {value!r}; allowed: auto, true, false")
    return {name: asked.get(name, "auto") for name in EFFECTS}


def _against(name: str, number: float, tolerance: float, words: str) -> Decision:
    on = number >= tolerance
    return Decision(on, f"{words}, {'not below' if on else 'below'} {name} {_percent(tolerance)}", number)


def _moves(flow: Flow) -> str:
    return f"{flow.cause} moves soil at {flow.speed:.2g} m/s over {1e3 * flow.thickness:.2g} mm"


def _percent(share: float) -> str:
    return f"{100.0 * share:.2g} %"
