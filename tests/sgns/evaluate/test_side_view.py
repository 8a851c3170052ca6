from types import SimpleNamespace

import numpy as np
import pytest
from synthetic import PLATE, make_run

from mpm_warp.scenes import Wheel, sinkage
from sgns.data.run import Run
from sgns.evaluate.metrics import forward_force, is_wheel
from sgns.evaluate.side_view import body_corners

REST = np.array([[0.3, 0.2, 0.1, 0.0, 0.0, 0.0, 1.0]])


def test_forward_force_follows_the_kind_of_body():
    assert forward_force({"kind": "wheel"}) == ("drawbar pull Fx", 1.0)
    assert forward_force({"blade": {}}) == ("draft −Fx", -1.0)
    assert is_wheel({"kind": "wheel"}) and not is_wheel({"kind": "bed"})


@pytest.mark.parametrize("grousers", [{}, {"grousers": 6, "grouser_height": 0.01, "grouser_thickness": 0.02}])
def test_sinkage_is_that_of_the_scene(grousers):
    scene = Wheel(clearance=0.002, **grousers)
    poses = scene.body_poses()[:5]
    assert sinkage(scene.to_dict(), poses) == pytest.approx(-0.002)
    assert (sinkage(scene.to_dict(), poses) == scene.sinkage(poses)).all()


def test_corners_of_a_wheel_lie_on_its_rims():
    run = SimpleNamespace(scene={"kind": "wheel", "diameter": 0.15, "width": 0.08}, pose=REST)
    corners = body_corners(run, 0) - REST[0, :3]
    assert np.hypot(corners[:, 0], corners[:, 2]) == pytest.approx(0.075)
    assert np.abs(corners[:, 1]) == pytest.approx(0.04)


def test_corners_of_a_blade_are_those_of_its_box(tmp_path):
    with Run(make_run(tmp_path / "run.h5")) as run:
        corners = body_corners(run, 3)
        assert corners.mean(axis=0) == pytest.approx(run.pose[3, :3])
        distance = np.linalg.norm(corners - run.pose[3, :3], axis=1)
        assert distance == pytest.approx(0.5 * np.linalg.norm(PLATE))


def test_other_bodies_are_their_recorded_points():
    points = np.random.default_rng(0).normal(size=(2, 8, 3))
    run = SimpleNamespace(scene={"kind": "body"}, body_points=points, pose=REST, mesh=None)
    assert np.array_equal(body_corners(run, 1), points[1])


def test_corners_of_a_mesh_are_its_vertices():
    vertices = np.random.default_rng(0).normal(size=(20, 3))
    run = SimpleNamespace(scene={"kind": "body"}, pose=REST, mesh=(vertices, None))
    assert body_corners(run, 0) == pytest.approx(vertices + REST[0, :3])
