"""Effects decided from the scene: by which numbers, what may be asked for, and that what is left out is not missed."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mpm_warp import (
    Bed,
    Column,
    Effects,
    Excavation,
    Incline,
    Material,
    Plate,
    Scene,
    SceneError,
    Solver,
    Tolerances,
    Wheel,
    effects_for,
)
from mpm_warp.effects import EFFECTS, expected_flow
from mpm_warp.poses import rotate
from sgns_testing.scenes import UNDAMPED, cut
from sgns_testing.solvers import compiled_source, launches

BEADS = Incline().material
SLOPE = replace(Incline().bed, particles_per_cell=1.0)
WHEEL = Wheel(
    bed=Bed(size=(0.4, 0.2, 0.08), spacing=0.02, headroom=0.1),
    duration=0.3,
    settle=0.1,
    rim_speed=0.06,
    **UNDAMPED,
)
COLUMN = Column(bed=Bed(size=(0.3, 0.3, 0.06), spacing=0.015, headroom=0.03), radius=0.06, duration=0.3)
FINE_COLUMN = replace(COLUMN, material=replace(COLUMN.material, grain_diameter=2e-4))


def slope(tilt: float = 26.0, **kw) -> Incline:
    return Incline(bed=SLOPE, tilt=tilt, **({"flowing": False} | kw))


# --- the flow that a scene is expected to have ---------------------------------------------------------------


def along(height: float, quaternion=(0.0, 0.0, 0.0, 1.0)) -> Excavation:
    """A blade that is moved straight on at 0.2 m/s."""
    path = [(t, 0.1 + 0.2 * t, 0.2, height, *quaternion) for t in (0.0, 1.0)]
    return cut(motion="path", path=path)


def test_inertial_number_of_a_cut():
    """I = (V / l) d sqrt(rho_s / (rho g l)), here for a path at constant speed and depth."""
    flow = expected_flow(along(0.04))  # tip at -0.06 m
    assert (flow.speed, flow.thickness) == pytest.approx((0.2, 0.06))
    expected = 0.2 / 0.06 * 3e-4 * np.sqrt(2583.0 / (2583.0 * 0.67 * 9.81 * 0.06))
    assert flow.inertial_number == pytest.approx(expected)


def test_depth_of_a_turned_plate():
    """A plate of 0.2 x 0.044 m that leans by 30 degrees about y and by 20 about x, deepest with one corner."""
    q = Rotation.from_euler("xy", [20.0, 30.0], degrees=True).as_quat()
    scene = along(0.05, q)
    deepest = rotate(q, scene.blade.outline())[:, 2].min() + 0.05
    assert expected_flow(scene).thickness == pytest.approx(-deepest)


def test_a_body_above_the_soil_drives_nothing():
    assert expected_flow(cut(motion="rest")) is None
    assert expected_flow(along(0.11)) is None


def test_a_column_falls_at_the_speed_of_its_height():
    flow = expected_flow(COLUMN)
    assert (flow.speed, flow.thickness) == pytest.approx((np.sqrt(9.81 * 0.06), 0.06))


@pytest.mark.parametrize(("law", "expected"), [("saturating", 0.1889), ("linear", 0.1125)])
def test_a_slope_flows_at_bagnolds_inertial_number(law, expected):
    scene = replace(slope(), material=replace(BEADS, rate_law=law))
    flow = expected_flow(scene)
    assert flow.inertial_number == pytest.approx(expected, rel=1e-3)
    if law == "saturating":
        assert flow.speed == pytest.approx(0.5017, rel=1e-3)  # at the surface
    assert scene.material.friction_at(flow.inertial_number) == pytest.approx(np.tan(np.radians(26.0)))


def test_slopes_that_rest_and_that_accelerate():
    assert expected_flow(slope(20.0)) is None
    assert expected_flow(slope(40.0)).inertial_number == np.inf
    _, decisions = effects_for(slope(40.0))
    assert decisions["rate_dependence"].on
    assert decisions["rate_dependence"].number == pytest.approx(0.6435 / 0.3819 - 1.0)
    assert not decisions["nonlocality"].on  # xi vanishes at mu_2


# --- what auto decides ------------------------------------------------------------------------------------------


def test_a_cut_in_the_papers_sand():
    effects, decisions = effects_for(cut(duration=0.5))
    assert effects == Effects(rate_dependence=False, cohesion=False, symmetry=True)
    assert list(decisions) == list(EFFECTS)
    assert decisions["nonlocality"].number == pytest.approx(0.48 * 3e-4 / 0.02)
    assert "A d is 0.0072 grid spacings, below tolerance.grid 3 %" in decisions["nonlocality"].reason
    assert 0.0 < decisions["rate_dependence"].number < Tolerances().friction
    assert 0.1 < decisions["fluidity"].number < 1.0
    assert not decisions["free_body"].on


def test_a_cut_that_rests():
    _, decisions = effects_for(cut(motion="rest"))
    assert not any(decisions[name].on for name in ("rate_dependence", "fluidity", "nonlocality"))
    assert decisions["nonlocality"] == (False, "nothing drives a flow", 0.0)


def test_grains_so_fine_that_the_rate_adds_nothing():
    _, decisions = effects_for(cut(material=Material(grain_diameter=1e-15)))
    assert decisions["rate_dependence"].number < 1e-12 and not decisions["rate_dependence"].on
    assert decisions["fluidity"].number > 1e6 and not decisions["fluidity"].on


def test_scenes_that_call_for_more():
    effects, decisions = effects_for(slope())
    assert effects.rate_dependence and effects.nonlocality and not effects.symmetry and not effects.torque
    assert decisions["nonlocality"].number == pytest.approx(0.1139, rel=1e-3)  # xi / thickness
    assert decisions["symmetry"].reason == "the bed is periodic in y (bed.walls.y)"
    effects, decisions = effects_for(WHEEL)
    assert decisions["free_body"].on and "100 N" in decisions["free_body"].reason
    assert effects.torque and effects.symmetry
    assert effects_for(cut(speed=2.0, duration=0.05))[0].rate_dependence


def test_tolerances_decide():
    scene = slope()
    assert not effects_for(scene, tolerances=Tolerances(grid=1.0))[0].nonlocality
    assert not effects_for(scene, tolerances=Tolerances(reach=0.2))[0].nonlocality
    assert not effects_for(scene, tolerances=Tolerances(reach=0.2, friction=0.5))[0].rate_dependence
    none = Tolerances(friction=0.0, grid=0.0, reach=0.0)
    assert effects_for(cut(duration=0.5), tolerances=none)[0].nonlocality
    with pytest.raises(SceneError, match=r"effects.tolerance.grid is -1.0; it must be 0 or more"):
        Tolerances(grid=-1)


def test_what_needs_another_brings_it_or_goes_with_it():
    effects, decisions = effects_for(cut(duration=0.5), {"nonlocality": True})
    assert effects.rate_dependence
    assert decisions["rate_dependence"].reason.startswith("effects.nonlocality needs it")
    effects, decisions = effects_for(slope(), {"rate_dependence": False})
    assert not effects.nonlocality
    assert decisions["nonlocality"].reason == "it needs effects.rate_dependence, which is off"
    assert effects_for(slope(), {"yielding": False})[0] == Effects(
        yielding=False, rate_dependence=False, cohesion=False, torque=False
    )


def test_what_is_asked_for_is_done_and_says_what_auto_would_do():
    effects, decisions = effects_for(cut(duration=0.5), {"rate_dependence": True, "symmetry": True})
    assert effects.rate_dependence
    assert decisions["rate_dependence"].reason.startswith("asked for; auto would turn it off: ")
    assert decisions["symmetry"].reason.startswith("asked for; so would auto: ")


@pytest.mark.parametrize(
    ("scene", "asked", "words"),
    [
        (slope(), {"symmetry": True}, "effects.symmetry needs .*periodic in y"),
        (COLUMN, {"torque": True}, "effects.torque needs a body"),
        (COLUMN, {"cohesion": True}, "effects.cohesion needs material.cohesion above 0 Pa"),
        (
            cut(),
            {"free_body": True},
            "effects.free_body needs a body whose height is free, as in scene=wheel",
        ),
        (WHEEL, {"free_body": False}, "kind wheel is always free"),
        (cut(), {"rate_dependence": False, "fluidity": True}, "fluidity needs effects.rate_dependence"),
        (cut(), {"gravity": True}, "effects has no key 'gravity'; allowed: yielding, "),
        (cut(), {"symmetry": "yes"}, "effects.symmetry is 'yes'; allowed: auto, true, false"),
    ],
)
def test_what_a_scene_cannot_have_is_refused(scene, asked, words):
    with pytest.raises(SceneError, match=words):
        effects_for(scene, asked)


def test_cohesion_is_on_where_the_soil_has_some():
    """And holds a slope that is steeper than its friction: nothing flows there."""
    damp = replace(COLUMN, material=replace(COLUMN.material, cohesion=500.0))
    effects, decisions = effects_for(damp)
    assert effects.cohesion and decisions["cohesion"].reason == "material.cohesion is 500 Pa"
    assert not effects_for(COLUMN)[0].cohesion
    assert not effects_for(damp, {"cohesion": False})[0].cohesion
    dry, held = (expected_flow(slope(material=replace(BEADS, cohesion=c))) for c in (0.0, 500.0))
    assert dry is not None and held is None
    assert expected_flow(damp).inertial_number < expected_flow(COLUMN).inertial_number


# --- what is off costs nothing ----------------------------------------------------------------------------------

SHEARED = cut(duration=0.05)
DAMP = replace(SHEARED, material=Material(cohesion=500.0))


def source(effects: Effects, kernel: str) -> str:
    found = next(k for k in launches(Solver(DAMP, effects)) if k.kernel.name == kernel)
    return compiled_source(found)


@pytest.mark.parametrize(
    ("on", "off", "kernel", "function"),
    [
        (Effects(rate_dependence=False), Effects(False, False), "material", "yield_stress"),
        (Effects(), Effects(rate_dependence=False), "material", "sqrt"),
        (Effects(fluidity=True), Effects(), "material", "fluidity_step"),
        (Effects(nonlocality=True), Effects(), "material", "friction_with_excess"),
        (Effects(), Effects(separation=False), "material", "where"),
        (Effects(), Effects(cohesion=False), "material", "holds"),
        (Effects(), Effects(torque=False), "scatter", "cross"),
    ],
)
def test_no_instruction_of_what_is_off(on, off, kernel, function):
    """A kernel without an effect calls that effect's function less often: never, unless others call it, too."""
    with_it, without = (source(effects, kernel) for effects in (on, off))
    calls = [text.count(f"{function}(") + text.count(f"{function}_0(") for text in (with_it, without)]
    assert calls[1] < calls[0]
    assert without.count("\n") < with_it.count("\n")
    if function not in ("sqrt", "where", "cross"):
        assert calls[1] == 0


def test_no_array_of_what_is_off():
    """Sizes of what the solver allocates for each effect, and the kernels it launches, on and off."""
    plain, halved, driven = Solver(SHEARED), Solver(SHEARED, Effects(symmetry=True)), Solver(WHEEL)
    silent = Solver(SHEARED, Effects(torque=False))
    assert (len(plain.body.data.impulse), len(silent.body.data.impulse)) == (2, 1)
    assert plain.body._axle is None and len(driven.body._axle) == 3
    assert (len(halved.particles.position), len(plain.particles.position)) == (1920, 3840)
    fluid = Solver(SHEARED, Effects(fluidity=True))
    assert (len(plain.particles.fluidity), len(fluid.particles.fluidity)) == (0, 3840)
    assert [k.kernel.name for k in launches(plain)] == [
        "to_grid", "begin", "scatter", "step", "gather", "material", "from_grid"
    ]  # fmt: skip
    assert {"fold", "unfold"} <= {k.kernel.name for k in launches(halved)}
    damp = Solver(DAMP)
    assert (len(plain.particles.bond), len(damp.particles.bond)) == (0, 3840)
    assert len(Solver(DAMP, Effects(cohesion=False)).particles.bond) == 0
    column = Solver(COLUMN, effects_for(COLUMN)[0])
    assert column.body is None


def test_without_torque_zeros_are_recorded_and_the_force_is_the_same():
    scene = cut(duration=0.1, clearance=0.0)
    plain, silent = (list(Solver(scene, Effects(torque=on)).frames()) for on in (True, False))
    assert np.abs(plain[-1].torque).max() > 0.1
    assert all(not frame.torque.any() for frame in silent)
    np.testing.assert_array_equal([f.force for f in silent], [f.force for f in plain])


# --- what auto leaves out is not missed -------------------------------------------------------------------------

STATED = 0.03
"""Change of force and displacement below which an effect is meant to be left out (docs/solver.md)."""


def changes_with(scene: Scene, effect: str) -> tuple[float, float]:
    """RMS change of the force over frames and of the last positions with an effect, as shares."""
    chosen = replace(effects_for(scene)[0], rate_dependence=True, nonlocality=False)
    one, two = (list(Solver(scene, replace(chosen, **{effect: on})).frames()) for on in (False, True))
    force, other = (np.array([frame.force for frame in run]) for run in (one, two))
    moved = np.linalg.norm(one[-1].position - one[0].position)
    share = np.linalg.norm(other - force) / np.linalg.norm(force) if scene.body else 0.0
    return share, np.linalg.norm(two[-1].position - one[-1].position) / moved


@pytest.mark.parametrize("effect", ["rate_dependence", "nonlocality"])
@pytest.mark.parametrize("scene", [cut(duration=0.3, clearance=0.0), WHEEL, FINE_COLUMN])
def test_what_auto_leaves_out_changes_less_than_stated(scene, effect):
    assert not effects_for(scene)[1][effect].on
    force, displacement = changes_with(scene, effect)
    assert 0.0 < displacement < STATED
    assert force < STATED


@pytest.mark.parametrize("effect", ["rate_dependence", "nonlocality"])
def test_what_auto_turns_on_changes_more(effect):
    scene = slope(flowing=True, duration=0.1)
    assert effects_for(scene)[1][effect].on
    assert changes_with(scene, effect)[1] > STATED


def changes(scene: Scene, *chosen: Effects) -> tuple[float, float]:
    """RMS change of the force over frames and of the last positions from one choice to the other, as shares."""
    one, two = (list(Solver(scene, effects).frames()) for effects in chosen)
    force, other = (np.array([frame.force for frame in run]) for run in (one, two))
    moved = np.linalg.norm(one[-1].position - one[0].position)
    share = np.linalg.norm(other - force) / np.linalg.norm(force) if scene.body else 0.0
    return share, np.linalg.norm(two[-1].position - one[-1].position) / moved


def test_a_cut_of_coarse_sand_is_not_left_without_what_it_feels():
    """Grains of 1 mm in the quick cut, which answers to friction sharply: without both effects soil goes another way
    by 3 % in this time and by 6 % later."""
    scene = Excavation(
        bed=Bed(spacing=0.02, particles_per_cell=2.3703703704, headroom=0.12),
        blade=Plate(thickness=0.042),
        material=Material(grain_diameter=1e-3),
        clearance=0.01,
        duration=0.3,
    )
    chosen = effects_for(scene)[0]
    assert not chosen.nonlocality
    force, displacement = changes(scene, replace(chosen, rate_dependence=True, nonlocality=True), chosen)
    assert 0.0 < displacement < 0.5 * STATED
    assert force < 0.5 * STATED
