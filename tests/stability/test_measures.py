"""What the hard cases measure."""

from __future__ import annotations

import math

import numpy as np
import pytest
from beds import cut
from measures import blade_force, energies, refused, shares, stopped_with, volume_gain, work_on_soil

from mpm_warp import Bed, Frame, Scene, SceneError


def frame(position, velocity=None, x=0.0, force=(0.0, 0.0, 0.0)) -> Frame:
    soil = np.asarray(position, dtype=np.float32)
    moving = np.zeros_like(soil) if velocity is None else np.asarray(velocity, dtype=np.float32)
    return Frame(
        index=0, time=0.0, position=soil, velocity=moving, body_pose=np.array([x, 0, 0, 0, 0, 0, 1.0]),
        body_points=np.zeros((0, 3)), force=np.array(force), torque=np.zeros(3),
    )  # fmt: skip


@pytest.mark.parametrize("count", [1.0, 8.0])
def test_volume_gain(count):
    """A full bed has gained nothing; one with a tenth of its particles taken out has gained a ninth."""
    scene = Scene(bed=Bed(size=(0.4, 0.4, 0.24), spacing=0.02, particles_per_cell=count))
    soil = scene.initial_positions()
    assert volume_gain(scene, soil) == 0.0
    kept = np.random.default_rng(0).random(len(soil)) > 0.1
    assert volume_gain(scene, soil[kept]) == pytest.approx(1 / 9, abs=0.03)
    doubled = np.concatenate([soil, soil])
    assert volume_gain(scene, doubled) == pytest.approx(-0.5)


def test_volume_gain_needs_soil():
    with pytest.raises(ValueError, match="surrounded"):
        volume_gain(Scene(bed=Bed(size=(0.4, 0.4, 0.24), spacing=0.02)), np.zeros((1, 3)))


def test_energies_and_work():
    """A particle that falls from the surface to the floor keeps its energy."""
    scene = Scene(bed=Bed(size=(0.4, 0.4, 0.2), spacing=0.02))
    speed = math.sqrt(2.0 * scene.gravity * 0.2)
    found = energies(scene, [frame([[0, 0, 0.0]]), frame([[0, 0, -0.2]], [[0, 0, -speed]])])
    assert found[0] > 0.0
    assert found[1] == pytest.approx(found[0], rel=1e-5)
    # The soil pushes back with 2 N over 3 m.
    work = work_on_soil([frame([[0, 0, 0]]), frame([[0, 0, 0]], x=3.0, force=(-2.0, 5.0, 0.0))])
    np.testing.assert_allclose(work, [0.0, 6.0])


def test_shares():
    value, words = shares({"force": (3.0, 4.0, "N"), "leak": (-1.0, 2.0, "%")})
    assert value == 0.75
    assert words == "force 3 of 4 N; leak -1 of 2 %"
    assert math.isnan(shares({"force": (math.nan, 4.0, "N"), "leak": (1.0, 2.0, "%")})[0])


def test_blade_force_grows_with_depth():
    scene = cut()
    deep, deeper = (blade_force(scene, [lowered(height)]) for height in (0.06, 0.04))
    assert 0.0 < deep < deeper


def lowered(height: float) -> Frame:
    found = frame([[0, 0, 0]])
    found.body_pose[2] = height
    return found


def test_refused_and_stopped():
    def refuse():
        raise SceneError("too small")

    assert refused(refuse, "small") == (0.0, "too small")
    assert refused(refuse, "large")[0] == 1.0
    assert refused(lambda: None, "small")[0] == 1.0
    assert stopped_with(cut(duration=0.05), "anything") == (1.0, "it went on to the end")
