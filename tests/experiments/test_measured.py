"""The theories that stand beside our solver in experiments/measured, against known answers, and how all are judged."""

import math
from dataclasses import replace

import bekker
import campaign
import judge
import numpy as np
import pytest
import resistive_force
from conditions import (
    FIXES,
    QUANTITIES,
    RIM_SPEEDS,
    SLIPS,
    SMALL,
    Condition,
    Forces,
    Soil,
    cmu,
    ding,
    errors,
    steady,
)

DOWN = np.array([[0.0, 0.0, -1.0]])
GIVEN = bekker.Parameters(3e6, 0.3, 0.4, 0.5)


def condition(slip_angle: float = 0.0, slip: float = 0.2) -> Condition:
    return Condition("cmu", SMALL, Soil(1330.0, 30.0), slip_angle, slip, 20.0, {}, {})


def push(c: Condition, depth: float = 0.03) -> Forces:
    return resistive_force.forces(c, depth, 1e6, 0.4)


def roll(c: Condition, depth: float = 0.03) -> Forces:
    return bekker.forces(c, depth, GIVEN)


# --- what was measured ---------------------------------------------------------------------------------


def test_trials_become_63_conditions_of_which_three_fix_parameters() -> None:
    conditions = cmu()
    assert len({c.key for c in conditions}) == 63
    assert [c.slip for c in conditions if c.fixed] == list(FIXES)
    locked = next(c for c in conditions if c.slip_angle == 0.0 and c.slip == -1.0)
    assert locked.measured["fx"] == pytest.approx(-38.845, abs=1e-3)
    assert locked.measured["sinkage"] == pytest.approx(0.050314, abs=1e-5)
    assert locked.load == pytest.approx(19.502, abs=1e-3)
    assert locked.scatter["fx"] == pytest.approx(0.570, abs=1e-3)
    assert sorted({c.rim_speed for c in conditions}) == pytest.approx(RIM_SPEEDS, rel=2e-3)


def test_the_larger_wheel_is_judged_in_all_of_its_six_points() -> None:
    assert len(ding()) == 6
    assert not any(c.fixed for c in ding())
    assert ding()[3].measured == {"fx": 15.0, "sinkage": 0.010, "torque": 4.8}


def test_an_error_is_a_share_of_the_largest_measured_value_and_only_of_judged_conditions() -> None:
    conditions = cmu()
    answers = {c.key: dict(c.measured, fx=c.measured["fx"] + 1.0) for c in conditions[:30]}
    found = errors(conditions, answers)
    largest = max(abs(c.measured["fx"]) for c in conditions)
    assert found["fx"] == pytest.approx(np.full(27, 1.0 / largest))
    assert found["sinkage"] == pytest.approx(np.zeros(27))
    assert "torque" not in found


def test_a_wheel_rests_where_its_load_is_carried() -> None:
    c = condition()
    answer = steady(lambda depth: Forces(1.0, 2.0, 1000.0 * depth, 3.0), c)
    assert answer["sinkage"] == pytest.approx(0.02)
    assert answer["fz"] == pytest.approx(c.load)


def test_a_wheel_without_support_counts_as_sunk() -> None:
    assert steady(lambda depth: Forces(0.0, 0.0, 0.0, 0.0), condition())["sinkage"] == pytest.approx(
        1.9 * 0.058
    )


# --- resistive force -----------------------------------------------------------------------------------


def test_a_level_plate_pressed_down_feels_the_sum_of_the_coefficients() -> None:
    assert resistive_force.stress(DOWN, DOWN, math.inf) == pytest.approx(
        np.array([[0.0, 0.0, 1.05614]]), abs=1e-4
    )


def test_stress_follows_the_published_angles() -> None:
    """The paper's form: plate angle beta, motion gamma below level, plate turned by psi out of the motion's plane."""
    beta, gamma, psi = math.radians(40.0), math.radians(25.0), math.radians(35.0)
    normal = np.array([[math.sin(beta) * math.cos(psi), math.sin(beta) * math.sin(psi), -math.cos(beta)]])
    velocity = np.array([[math.cos(gamma), 0.0, -math.sin(gamma)]])
    x = (
        math.sin(gamma),
        math.cos(beta),
        math.cos(psi) * math.cos(gamma) * math.sin(beta) + math.sin(gamma) * math.cos(beta),
    )
    f1, f2, f3 = resistive_force.COEFFICIENTS @ [
        math.prod(v**p for v, p in zip(x, powers, strict=True)) for powers in resistive_force.POWERS
    ]
    expected = [
        f1 * math.sin(beta) * math.cos(psi) + f2 * math.cos(gamma),
        f1 * math.sin(beta) * math.sin(psi),
        -f1 * math.cos(beta) - f2 * math.sin(gamma) - f3,
    ]
    assert resistive_force.stress(normal, velocity, math.inf)[0] == pytest.approx(expected)


def test_no_plate_pressed_down_resists_more_than_a_level_one() -> None:
    """Another transcription of the coefficients has 6 % more at 30 degrees than level."""
    beta = np.radians(np.arange(0.0, 91.0, 5.0))
    normals = np.stack([np.sin(beta), 0.0 * beta, -np.cos(beta)], axis=1)
    upwards = resistive_force.stress(normals, np.tile(DOWN, (len(beta), 1)), math.inf)[:, 2]
    assert upwards.max() < 1.01 * upwards[0]
    assert np.all(np.diff(upwards)[4:-1] < 0.0)


@pytest.mark.parametrize(
    "turn", [np.diag([1.0, -1.0, 1.0]), np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]])]
)
def test_stress_mirrors_and_turns_with_the_scene(turn: np.ndarray) -> None:
    random = np.random.default_rng(0)
    normals, velocities = random.normal(size=(2, 200, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    stress = resistive_force.stress(normals, velocities, 0.3)
    turned = resistive_force.stress(normals @ turn.T, velocities @ turn.T, 0.3)
    assert turned == pytest.approx(stress @ turn.T)


def test_soil_presses_and_rubs_no_more_than_friction_allows() -> None:
    random = np.random.default_rng(1)
    normals, velocities = random.normal(size=(2, 500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    stress = resistive_force.stress(normals, velocities, 0.3)
    pressure = -np.sum(stress * normals, axis=1)
    assert np.all(pressure >= 0.0)
    assert np.all(np.linalg.norm(stress + pressure[:, None] * normals, axis=1) <= 0.3 * pressure + 1e-12)
    assert not np.any(stress[np.sum(normals * velocities, axis=1) < -1e-6])


def test_the_soils_scale_follows_from_density_and_friction() -> None:
    mu = math.tan(math.radians(29.0))
    expected = 1330.0 * 9.81 * mu * (89.0 - mu * (386.0 - 894.0 * mu))
    assert resistive_force.scale_of(Soil(1330.0, 29.0)) == pytest.approx(expected)


def test_a_locked_wheel_pushed_sideways_has_no_pull_in_resistive_force() -> None:
    forces = push(condition(90.0, -1.0))
    assert forces.fx == pytest.approx(0.0, abs=1e-9)
    assert forces.fy > 1.0
    assert forces.torque == pytest.approx(0.0, abs=1e-9)


# --- Bekker, Wong, Reece -------------------------------------------------------------------------------


def test_shear_is_nothing_where_soil_enters_and_everything_under_a_locked_wheel() -> None:
    entry = 1.0
    theta = np.array([entry - 1e-9, 0.5, 0.1])
    _, along, across = bekker.rim_stress(condition(20.0), entry, theta, GIVEN)
    assert math.hypot(along[0], across[0]) < 1e-6
    pressure, along, across = bekker.rim_stress(condition(20.0, -1.0), entry, theta, GIVEN)
    assert np.hypot(along, across)[1:] == pytest.approx(0.5 * pressure[1:])
    assert np.all(along[1:] < 0.0)
    assert np.all(across[1:] > 0.0)


def test_shear_builds_up_after_janosi_and_hanamoto() -> None:
    """Sideways the rim has slid by radius x angle, and the axle's way meanwhile."""
    c, entry, theta = condition(90.0, 0.5), 0.8, np.array([0.3])
    pressure, along, across = bekker.rim_stress(c, entry, theta, GIVEN)
    slid, aside = 0.5 * c.wheel.radius, 0.5 * c.wheel.radius * 0.5
    built = 1.0 - math.exp(-math.hypot(slid, aside) / bekker.SHEAR_LENGTH)
    assert math.hypot(along[0], across[0]) == pytest.approx(0.5 * pressure[0] * built)
    assert across[0] / along[0] == pytest.approx(aside / slid)


def test_pressure_follows_depth_to_its_peak_and_falls_to_nothing_behind() -> None:
    entry, peak = 1.0, 0.4 + 0.15 * 0.2
    pressure = bekker.rim_stress(condition(), entry, np.array([0.0, peak, 0.7, entry]), GIVEN)[0]
    exponent = bekker.EXPONENT + 0.3 * 0.2
    depths = 0.058 * (np.cos([peak, 0.7]) - math.cos(entry))
    assert pressure[1:3] == pytest.approx(3e6 * depths**exponent)
    assert pressure[[0, 3]] == pytest.approx(0.0, abs=1e-6)


def test_without_friction_a_wheel_is_only_resisted() -> None:
    forces = bekker.forces(condition(), 0.02, GIVEN._replace(friction=0.0))
    assert forces.torque == 0.0
    assert forces.fx < 0.0


def test_the_pushed_soil_at_the_side_follows_hegedus() -> None:
    """At 30 degrees the passive factor is 12: 12 x 1/2 density gravity depth^2 on each length of the face."""
    c, depth = condition(90.0), 0.02
    half = math.sqrt(2.0 * c.wheel.radius * depth - depth**2)
    x = np.linspace(-half, half, 20001)
    below = np.sqrt(c.wheel.radius**2 - x**2) - (c.wheel.radius - depth)
    expected = 12.0 * 0.5 * 1330.0 * 9.81 * np.mean(below**2) * 2.0 * half
    entry = math.acos(1.0 - depth / c.wheel.radius)
    assert bekker.side_force(c, entry) == pytest.approx(expected, rel=1e-3)
    assert bekker.side_force(condition(30.0), entry) == pytest.approx(0.5 * expected, rel=1e-3)


# --- both ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("theory", [push, roll])
@pytest.mark.parametrize("slip", [-1.0, -0.5, 0.0, 0.5])
def test_a_wheel_rolling_straight_has_no_lateral_force_and_carries_its_load(theory, slip: float) -> None:
    c = condition(0.0, slip)
    answer = steady(lambda depth: theory(c, depth), c)
    assert answer["fy"] == pytest.approx(0.0, abs=1e-9)
    assert answer["fz"] == pytest.approx(c.load)


@pytest.mark.parametrize("theory", [push, roll])
def test_a_mirrored_slip_angle_mirrors_the_lateral_force(theory) -> None:
    right, left = (theory(condition(angle)) for angle in (35.0, -35.0))
    assert left == pytest.approx(right._replace(fy=-right.fy))
    assert right.fy > 0.0


@pytest.mark.parametrize("theory", [push, roll])
def test_braking_pulls_back_and_driving_takes_torque(theory) -> None:
    conditions = [condition(0.0, slip) for slip in (-0.9, 0.0, 0.5)]
    braked, rolling, driven = (steady(lambda depth, c=c: theory(c, depth), c) for c in conditions)
    assert braked["fx"] < rolling["fx"]
    assert driven["torque"] > 0.0 > braked["torque"]


# --- judging -------------------------------------------------------------------------------------------


def test_rivals_are_compared_on_the_conditions_that_we_have() -> None:
    conditions = [c for c in cmu() if not c.fixed][:10]
    perfect = {c.key: c.measured for c in conditions}
    half_wrong = {
        c.key: dict(c.measured, fx=c.measured["fx"] + 1.0) if i >= 4 else c.measured
        for i, c in enumerate(conditions)
    }
    ours = {c.key: c.measured for c in conditions[:4]}
    rows = judge.table(conditions, {"ours": ours, "rival": half_wrong, "perfect": perfect})
    pull = {row["model"]: row for row in rows if row["quantity"] == "fx"}
    assert pull["ours"]["conditions"] == pull["rival"]["conditions"] == 4
    assert pull["rival"]["median"] == 0.0 < pull["rival"]["median_all"]


def test_ours_are_read_from_the_campaigns_own_setting(tmp_path) -> None:
    file = tmp_path / "ours.csv"
    file.write_text(
        "study,source,slip_angle,slip,fx,fy,sinkage,torque,grid\n"
        "judged,cmu,30,-0.5,-1,2,0.01,0.1,0.008\n"
        "larger,ding,0,0.1,9,0,0.02,3,0.006\n"
        "larger_grid,ding,0,0.1,8,0,0.02,3,0.012\n"
        "grid,cmu,30,-0.5,-3,2,0.01,0.1,0.006\n"
    )
    assert judge.ours(file) == {
        ("cmu", 30.0, -0.5): {"fx": -1.0, "fy": 2.0, "sinkage": 0.01, "torque": 0.1},
        ("ding", 0.0, 0.1): {"fx": 9.0, "fy": 0.0, "sinkage": 0.02, "torque": 3.0},
    }
    assert judge.ours(tmp_path / "none.csv") == {}


def test_fitting_finds_parameters_that_answers_were_made_with(monkeypatch) -> None:
    made = [c for c in cmu() if c.fixed]

    def force(c: Condition, depth: float, given) -> Forces:
        return Forces(-given[1] * depth * 1e3, 0.0, given[0] * depth, 0.0)

    measured = [steady(lambda h, c=c: force(c, h, (800.0, 0.3)), c) for c in made]
    monkeypatch.setattr(
        judge, "cmu", lambda: [replace(c, measured=m) for c, m in zip(made, measured, strict=True)]
    )
    assert judge.fitted(force, (1500.0, 0.2)) == pytest.approx([800.0, 0.3], rel=1e-3)


def test_the_committed_table_has_every_quantity_of_both_wheels() -> None:
    rows = judge.read_rows(judge.HERE / "table.csv")
    assert {(row["source"], row["quantity"]) for row in rows} == {
        *(("cmu", name) for name in QUANTITIES if name != "torque"),
        *(("ding", name) for name in QUANTITIES if name != "fy"),
    }


# --- the campaign --------------------------------------------------------------------------------------


def test_the_campaign_begins_with_every_slip_angle_and_rim_speed() -> None:
    first = campaign.chosen("judged")[:32]
    assert len({c.slip_angle for c in first}) == 7
    assert {c.slip for c in first} == set(SLIPS)
    assert sum(c.fixed for c in first) == 3
    assert len(campaign.chosen("judged")) == len({c.key for c in campaign.chosen("judged")}) == 63
    assert [c.slip for c in campaign.chosen("fix")] == list(FIXES)


def test_the_solver_gets_the_wheel_the_soil_and_both_speeds() -> None:
    c = next(c for c in cmu() if c.slip_angle == 75.0 and c.slip == 0.5)
    scene, _ = campaign.scene_for(c, campaign.Setting(grid=0.016, speed=0.02))
    assert scene.load == pytest.approx(c.load)
    assert (scene.speed, scene.rim_speed, scene.slip_angle) == pytest.approx((0.02, 0.04, 75.0))
    assert scene.material.bulk_density == pytest.approx(1330.0)
    assert scene.bed.spacing == pytest.approx(0.016)


def test_the_fastest_rim_travels_slower_and_the_larger_wheel_has_as_many_cells() -> None:
    fast = next(c for c in cmu() if c.slip_angle == 0.0 and c.slip == 0.9)
    small, large = (campaign.scene_for(c, campaign.Setting())[0] for c in (fast, ding()[0]))
    assert (small.rim_speed, small.slip) == pytest.approx((0.3, 0.9))
    assert large.bed.spacing / large.diameter == pytest.approx(small.bed.spacing / small.diameter)


def test_the_larger_wheel_gets_a_finer_grid_in_a_smaller_bin_and_its_own_friction() -> None:
    c = campaign.chosen("larger")[0]
    own, usual = (campaign.scene_for(c, setting)[0] for setting in (campaign.LARGER, campaign.Setting()))
    assert own.bed.spacing == pytest.approx(usual.bed.spacing / 3.0)
    beside, room = (0.5 * (scene.bed.size[1] - scene.width) for scene in (own, usual))
    assert beside == pytest.approx(0.3 * room, rel=0.1)
    assert own.start * own.bed.size[0] == pytest.approx(0.3 * 2.5 * c.wheel.radius, rel=0.02)
    assert (own.friction_angle, usual.friction_angle) == pytest.approx((31.9, 33.9))
    assert own.friction == pytest.approx(math.tan(math.radians(31.9 * 2.0 / 3.0)), abs=0.002)


def test_one_condition_of_the_larger_wheel_is_tried_with_the_soils_cohesion() -> None:
    (c,) = campaign.chosen("larger_soil")
    scenes = [campaign.scene_for(c, setting)[0] for setting in campaign.STUDIES["larger_soil"]]
    assert [scene.material.cohesion for scene in scenes] == [0.0, 250.0]


def test_the_solver_has_the_tables_signs() -> None:
    """Locked at a slip angle: pulled back, pushed along the axle, turned by the soil; coarse and short."""
    c = next(c for c in cmu() if c.slip_angle == 45.0 and c.slip == -1.0)
    found = campaign.solved(c, campaign.Setting(grid=0.016, per_cell=1.0, speed=0.2, travel=0.1))
    assert found["fx"] < -2.0
    assert found["fy"] > 2.0
    assert found["torque"] < 0.0
    assert 0.0 < found["sinkage"] < 0.08


def test_a_campaign_goes_on_where_it_stopped(tmp_path) -> None:
    file, settings = tmp_path / "ours.csv", campaign.STUDIES["speed"]
    asked = campaign.missing("speed", settings, file)
    assert len(asked) == 4
    for name, _, _ in asked[:3]:
        campaign.append(name | campaign.written({"fx": 1.0, "seconds": 60.0}), file)
    assert campaign.missing("speed", settings, file) == asked[3:]
    assert len(campaign.missing("grid", campaign.STUDIES["grid"], file)) == 6
