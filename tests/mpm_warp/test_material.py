"""Soil parameters: friction maps, their limits, cooperativity length."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from mpm_warp import Material, SceneError
from mpm_warp.material import static_friction
from sgns_testing.scenes import cut


def cone_ratio(stress):
    """Shear stress over pressure as the friction cone measures them."""
    pressure = -np.trace(stress) / 3.0
    return np.linalg.norm(stress + pressure * np.eye(3)) / math.sqrt(2.0) / pressure


@pytest.mark.parametrize("angle", [20.0, 37.2, 45.0])
def test_maps_match_mohr_coulomb_in_their_kind_of_loading(angle):
    """At Mohr-Coulomb failure the three stress states reach the cone of their map."""
    sine = math.sin(math.radians(angle))
    minor, major = -(1.0 - sine), -(1.0 + sine)  # principal stresses, tension positive
    compression = np.diag([major, minor, minor])
    assert static_friction(angle, "triaxial") == pytest.approx(cone_ratio(compression))
    plane_strain = np.diag([major, 0.5 * (major + minor), minor])  # no plastic strain along y in this cone
    assert static_friction(angle, "sin") == pytest.approx(cone_ratio(plane_strain))
    # Simple shear: the plane that slides carries tau = tan(phi) times a normal stress equal to the pressure.
    tangent = math.tan(math.radians(angle))
    sliding = -np.eye(3) + tangent * np.array([[0, 0, 1], [0, 0, 0], [1, 0, 0]])
    assert static_friction(angle, "tan") == pytest.approx(cone_ratio(sliding))


def test_angle_becomes_the_static_friction():
    soil = Material(friction_angle=30.0)
    assert soil.static_friction == pytest.approx(math.tan(math.pi / 6))
    assert soil.limit_friction == 0.9616
    assert not any("friction_angle" in w for w in soil.warnings())
    assert Material(friction_angle=30.0, friction_map="sin").static_friction == pytest.approx(0.5)
    assert replace(soil, friction_angle=37.0).static_friction == pytest.approx(math.tan(math.radians(37.0)))


@pytest.mark.parametrize(("angle", "name"), [(44.0, "tan"), (50.0, "triaxial")])
def test_limit_friction_is_raised_above_the_static_one(angle, name):
    soil = Material(friction_angle=angle, friction_map=name)
    assert soil.limit_friction == pytest.approx(soil.static_friction + 0.9616 - 0.76)
    (warning,) = soil.warnings()
    assert "the limit is raised to" in warning
    assert cut(material=soil).warnings() == [warning]


@pytest.mark.parametrize("angle", [20.0, 37.2, 45.0])
@pytest.mark.parametrize("name", ["tan", "sin", "triaxial"])
def test_cohesive_pressure_is_c_cot_phi(angle, name):
    """Where the cone ends: in every map the pressure that would give dry soil the strength c."""
    soil = Material(friction_angle=angle, friction_map=name, cohesion=500.0)
    assert soil.cohesive_pressure == pytest.approx(500.0 / math.tan(math.radians(angle)))
    alike = Material(
        static_friction=soil.static_friction, limit_friction=2.0, friction_map=name, cohesion=500.0
    )
    assert alike.cohesive_pressure == pytest.approx(soil.cohesive_pressure)
    assert Material(friction_angle=angle, friction_map=name).cohesive_pressure == 0.0


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"cohesion": -1.0}, "material.cohesion is -1"),
        ({"cohesion": 1e5}, "raise material.youngs_modulus to 3.16e+06 Pa or more"),
        (
            {"cohesion": 1.0, "static_friction": 1.1, "limit_friction": 1.3, "friction_map": "sin"},
            "no angle has a static friction of 1.1",
        ),
    ],
)
def test_cohesion_that_cannot_be_is_refused(values, words):
    with pytest.raises(SceneError, match=re.escape(words)):
        Material(**values)


def test_a_friction_that_is_not_used_is_named():
    (warning,) = Material(friction_angle=40.0, static_friction=0.6).warnings()
    assert "material.static_friction 0.6 is not used" in warning


def test_cooperativity_length():
    """A d over the root of m |mu - mu_s|: the stopping heights of glass beads are (pi / 2) xi(tan theta)."""
    beads = Material(
        static_friction=0.3819, limit_friction=0.6435, reference_inertial_number=0.278, grain_diameter=1.0
    )
    heights = {22.78: (3.863, 3.570), 24.23: (2.889, 2.485), 26.57: (2.194, 1.625), 28.81: (1.839, 1.099)}
    for degrees, (linear, saturating) in heights.items():
        mu = math.tan(math.radians(degrees))
        for law, expected in (("linear", linear), ("saturating", saturating)):
            found = 0.5 * math.pi * replace(beads, rate_law=law).cooperativity_length(mu)
            assert found == pytest.approx(expected, rel=2e-3)
    assert beads.cooperativity_length(0.3819) == math.inf
