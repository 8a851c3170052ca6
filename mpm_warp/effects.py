"""Which physics a run computes: every effect, and which of them a scene calls for."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import ClassVar, NamedTuple

import numpy as np

from .discretisation import asymmetry, require_symmetry
from .limits import scene_size
from .scene import Companion, Scene
from .scenes import Column, bagnold_speed
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
    cohesion: bool = setting(
        True,
        "soil holds together with material.cohesion (where that is above 0)",
        note="soil without cohesion",
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

    @property
    def can_tear(self) -> bool:
        """Whether soil bears tension until it tears."""
        return self.cohesion and self.separation

    def described(self) -> dict[str, dict[str, bool | str]]:
        """Each effect with its state and the reason, as stored in a run file."""
        found: dict[str, dict[str, bool | str]] = {}
        for one in fields(self):
            on, known = getattr(self, one.name), one.metadata["setting"]
            found[one.name] = {"on": on, "reason": known.help if on else known.note}
        return found


# --- Which of them a scene calls for, decided by dimensionless numbers before anything is computed ------


# --- How soil is expected to flow: an estimate from the scene alone -------------------------------------

_TOP_SHARE = 5.0  # a body's speed is the one it exceeds in this share of its time in the soil [%]


@dataclass(frozen=True)
class Flow:
    """The fastest flow that something in the scene drives."""

    cause: str
    """What drives it."""
    speed: float
    """V [m/s]."""
    thickness: float
    """l: over which the speed falls to zero [m]."""
    inertial_number: float
    """I [-]; infinite where nothing limits the speed."""


def expected_flow(scene: Scene) -> Flow | None:
    """The flow with the largest inertial number; None where the soil stays at rest.

    With the speed V and the thickness l of the flowing layer I = (V / l) d sqrt(rho_s / p) at the pressure
    p = rho g l of soil as deep as the layer, and that of its cohesion.
    """
    every = [_of_body(scene), _of_column(scene), _of_slope(scene), *map(_of_body, scene.companions)]
    found = [flow for flow in every if flow]
    return max(found, key=lambda flow: flow.inertial_number, default=None)


def _sheared(scene: Scene, cause: str, speed: float, thickness: float) -> Flow:
    material = scene.material
    # No layer on a grid is thinner than one spacing.
    thickness = min(max(thickness, scene.bed.spacing), scene.bed.size[2])
    pressure = material.bulk_density * scene.gravity * thickness + material.cohesive_pressure
    inertial = math.inf
    if pressure > 0.0:
        inertial = speed / thickness * material.grain_diameter * math.sqrt(material.grain_density / pressure)
    return Flow(cause, speed, thickness, inertial)


def _of_body(scene: Scene) -> Flow | None:
    """A body shears soil over the depth of its cut; one that rests on it, over a quarter of its smaller side."""
    body = scene.body
    if body is None:
        return None
    quarter = 0.5 * float(body.half_size[:2].min())
    if isinstance(scene, Companion) and scene.free:
        return _sheared(scene, scene.place, scene.impact_speed, quarter) if scene.impact_speed else None
    poses = scene.body_poses()
    depth = -scene.lowest_points(poses)
    way, angle = scene.displacement(scene.times())
    speed = np.maximum(way, angle * body.reach) * scene.frame_rate
    if scene.axle is None:
        speed, thickness = speed[depth[:-1] > 0.0], float(depth.max())
    else:
        thickness = quarter
    moving = speed[speed > 0.0]
    if not len(moving):
        return None
    cause = scene.place if isinstance(scene, Companion) else "the body"
    return _sheared(scene, cause, float(np.percentile(moving, 100.0 - _TOP_SHARE)), thickness)


def _of_column(scene: Scene) -> Flow | None:
    """A column falls by about its height, all of it."""
    if not isinstance(scene, Column) or scene.gravity == 0.0:
        return None
    height = scene.bed.size[2]
    return _sheared(scene, "the column", math.sqrt(scene.gravity * height), height)


def _of_slope(scene: Scene) -> Flow | None:
    """On a slope steeper than atan mu_s the steady flow with mu(I) = tan(slope); there is none beyond atan mu_2.

    Cohesion carries a part of it: at the base tau / (p + p_c) is less than tan(slope).
    """
    material, slope, thickness = scene.material, abs(math.tan(math.radians(scene.tilt))), scene.bed.size[2]
    if slope <= material.static_friction or scene.gravity == 0.0:
        return None
    across = material.bulk_density * scene.gravity * math.cos(math.radians(scene.tilt)) * thickness
    slope *= across / (across + material.cohesive_pressure)
    if slope <= material.static_friction:
        return None
    inertial = material.inertial_number(slope)
    if math.isinf(inertial):  # what accelerates for ever is taken as fast as free fall through the layer
        speed = math.sqrt(2.0 * scene.gravity * thickness)
    else:
        speed = float(bagnold_speed(scene, inertial, np.asarray(thickness)))
    return Flow("the slope", speed, thickness, inertial)


# --- Which effects a scene calls for, by named dimensionless numbers ------------------------------------

EFFECTS = (*(f.name for f in fields(Effects)), "free_body")
"""What can be asked for: the switches of `Effects`, and whether a body, or its height, is free."""


@settings
class Tolerances(Settings):
    """How little an effect may do before it is left out."""

    group: ClassVar[str] = "effects.tolerance"
    friction: float = setting(
        0.005, "rate_dependence: what mu(I) adds to the friction, as a share of mu_s", ge=0
    )
    grid: float = setting(0.03, "nonlocality: A d, as a share of the grid spacing", ge=0)
    reach: float = setting(0.02, "nonlocality: cooperativity length, as a share of the flowing layer", ge=0)


class Decision(NamedTuple):
    """On or off, why, and the number that decided it."""

    on: bool
    reason: str
    number: float | None = None


def _settled(auto: Decision, asked: bool | str) -> Decision:
    """The decision that stands: auto's own, or what was asked for."""
    if isinstance(asked, str):
        return auto
    would = "so would auto" if asked == auto.on else f"auto would turn it {'on' if auto.on else 'off'}"
    return Decision(asked, f"asked for; {would}: {auto.reason}", auto.number)


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
    flow, asymmetric = expected_flow(scene), asymmetry(scene)
    auto = {
        "yielding": Decision(True, "granular soil flows when shear exceeds friction"),
        "rate_dependence": _rate_dependence(scene, flow, tolerances),
        "fluidity": _fluidity(scene, flow),
        "nonlocality": _nonlocality(scene, flow, tolerances),
        "separation": Decision(True, "the surface is free: soil near it can come apart"),
        "cohesion": _cohesion(scene),
        "symmetry": Decision(
            asymmetric is None,
            asymmetric or "bed, body and motion are their own mirror image about mid-width",
        ),
        "torque": Decision(
            scene.body is not None or bool(scene.others),
            "the body turns soil" if scene.body or scene.others else "there is no body",
        ),
        "free_body": _free_body(scene),
    }
    missing = "yielding" if asked["yielding"] is False else "rate_dependence"
    if asked[missing] is False:
        without = Decision(False, f"it needs effects.{missing}, which is off")
        auto |= {"fluidity": without, "nonlocality": without}
        if missing == "yielding":
            auto["rate_dependence"] = without
    else:
        rate = auto["rate_dependence"]
        needing = [n for n in ("fluidity", "nonlocality") if (auto[n].on if asked[n] == "auto" else asked[n])]
        if needing and not rate.on:
            reason = f"effects.{needing[0]} needs it; by itself: {rate.reason}"
            auto["rate_dependence"] = Decision(True, reason, rate.number)
    _require_possible(scene, asked)
    found = {name: _settled(auto[name], asked[name]) for name in EFFECTS}
    return Effects(**{f.name: found[f.name].on for f in fields(Effects)}), found


def _rate_dependence(scene: Scene, flow: Flow | None, tolerances: Tolerances) -> Decision:
    """By the friction that the inertial number adds."""
    if flow is None:
        return Decision(False, "nothing drives a flow", 0.0)
    material = scene.material
    added = material.friction_at(flow.inertial_number) / material.static_friction - 1.0
    words = (
        f"{flow.cause} moves soil at {flow.speed:.2g} m/s over {1e3 * flow.thickness:.2g} mm, "
        f"inertial number {flow.inertial_number:.2g}: it adds {_percent(added)} to mu_s"
    )
    return _against("tolerance.friction", added, tolerances.friction, words)


def _fluidity(scene: Scene, flow: Flow | None) -> Decision:
    """Never on by itself: see docs/solver.md."""
    always = "its dynamics overshoot, so auto leaves it to those who compare with the released solver"
    if flow is None:
        return Decision(False, always)
    material = scene.material
    above = material.friction_at(flow.inertial_number) - material.static_friction
    rate = flow.speed / flow.thickness
    ratio = material.fluidity_time / above * rate if above > 0.0 else math.inf
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


def _cohesion(scene: Scene) -> Decision:
    cohesion = scene.material.cohesion
    return Decision(cohesion > 0.0, f"material.cohesion is {cohesion:g} Pa", cohesion)


def _free_body(scene: Scene) -> Decision:
    for one in scene.companions:
        if one.free:
            return Decision(True, f"{one.place} is free in six degrees of freedom")
    for one in scene.companions:
        if one.axle is not None:
            return Decision(
                True, f"the height of {one.place} is free; it carries {one.axle.mass * scene.gravity:.4g} N"
            )
    if scene.axle is not None:
        return Decision(
            True, f"the body's height is free; it carries {scene.axle.mass * scene.gravity:.4g} N"
        )
    return Decision(False, "the body's motion is prescribed" if scene.body else "there is no body")


def _require_possible(scene: Scene, asked: Mapping[str, bool | str]) -> None:
    if asked["symmetry"] is True:
        require_symmetry(scene)
    if asked["cohesion"] is True and scene.material.cohesion == 0.0:
        raise SceneError("effects.cohesion needs material.cohesion above 0 Pa; or set effects.cohesion=auto")
    if asked["torque"] is True and scene.body is None and not scene.others:
        raise SceneError("effects.torque needs a body and this scene has none; set effects.torque=auto")
    free = next((one for one in scene.companions if one.free or one.axle), None)
    if asked["free_body"] is True and scene.axle is None and free is None:
        raise SceneError(
            "effects.free_body needs a body whose height is free, as in scene=wheel, or one in scene.others; set "
            "effects.free_body=auto"
        )
    if asked["free_body"] is False and free is not None:
        raise SceneError(f"effects.free_body is false, but {free.place} is free; set effects.free_body=auto")
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


def _percent(share: float) -> str:
    return f"{100.0 * share:.2g} %"
