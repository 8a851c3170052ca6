"""Scenes: what they hold, what they refuse."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from beds import cut

from mpm_warp import Bed, Excavation, Material, Plate, Scene, SceneError
from mpm_warp.rotation import rotate


def test_a_scene_survives_json():
    scene = cut(motion="path", path=((0.0, 0.2, 0.2, 0.2, 0, 0, 0, 1), (1.0, 0.25, 0.2, 0.2, 0, 0, 0, 1)))
    again = Scene.from_dict(json.loads(json.dumps(scene.to_dict())))
    assert again == scene
    assert again.to_dict() == scene.to_dict()


def test_frames_include_the_initial_state():
    scene = cut(duration=1.0, frame_rate=60.0)
    assert scene.frame_count == 61
    np.testing.assert_allclose(scene.times()[[0, -1]], [0.0, 1.0])
    assert scene.body_poses().shape == (61, 7)


def test_blade_starts_above_the_surface_with_its_tip_leading():
    scene = Excavation(rake=30.0, depth=0.05)
    pose = scene.body_poses()[0]
    tip = rotate(pose[3:], scene.blade.tip) + pose[:3]
    np.testing.assert_allclose(tip, [0.1 * 0.8, 0.3, 0.00665], atol=1e-12)
    assert pose[0] < tip[0]  # the top trails
    up = rotate(pose[3:], np.array([0.0, 0.0, 1.0]))
    assert math.degrees(math.atan2(-up[0], up[2])) == pytest.approx(30.0)
    front = rotate(pose[3:], np.array([1.0, 0.0, 0.0]))
    assert front[2] > 0  # a raked blade's front face looks up


def test_body_points_lie_on_the_front_face():
    plate = Plate()
    points = plate.points(3, 5)
    assert points.shape == (15, 3)
    np.testing.assert_allclose(points[:, 0], plate.thickness / 2)
    np.testing.assert_allclose(np.ptp(points, axis=0), [0.0, plate.width, plate.length])


def test_arrangement_hash_names_the_start():
    assert cut().arrangement_hash == cut(depth=0.02, rake=30.0).arrangement_hash
    assert Bed().arrangement_hash == Bed(seed=5).arrangement_hash  # a lattice knows no chance
    assert (
        Bed(arrangement="jittered").arrangement_hash != Bed(arrangement="jittered", seed=5).arrangement_hash
    )
    assert Bed().arrangement_hash != Bed(spacing=0.02).arrangement_hash
    assert len({Bed(store_every=k).arrangement_hash for k in (1, 2, 5)}) == 3


def test_recorded_particles_are_one_of_every_few():
    bed = Bed(spacing=0.02)
    assert (bed.stored == np.arange(len(bed.filled[0]))).all()
    thinned = Bed(spacing=0.02, store_every=8)
    count = len(thinned.filled[0])
    assert (thinned.stored // 8 == np.arange(-(-count // 8))).all()
    assert (Bed(spacing=0.02, store_every=8).stored == thinned.stored).all()
    # The bed is 8 layers deep: a fixed step of 8 would leave a single layer.
    depth = thinned.filled[0][thinned.stored, 2]
    share = np.unique(np.round(depth, 6), return_counts=True)[1] / len(depth)
    np.testing.assert_allclose(share, 1 / 8, atol=0.05)
    assert len(share) == 8


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"depth": 0.3}, r"leaves the bin at .* z = .*; change scene.depth"),
        ({"speed": 3.0, "duration": 1.0}, "leaves the bin"),
        ({"depth": float("nan")}, "scene.depth is nan"),
        ({"speed": 0.0}, "scene.speed is 0.0 m/s; it must be above 0"),
        ({"rake": 80.0}, "scene.rake is 80.0 degrees; allowed"),
        ({"motion": "zigzag"}, "allowed: curved, ramp, rest, path"),
        ({"motion": "path"}, "needs scene.path"),
        ({"path": ((0.0,) * 8,)}, "use scene.motion=path"),
        ({"gravity": -1.0}, "scene.gravity"),
        ({"duration": 0.0}, "scene.duration"),
        ({"courant": 1.5}, "scene.courant is 1.5; allowed"),
        ({"elastic_damping": -0.1}, "scene.elastic_damping is -0.1; allowed"),
        ({"volume_averaging": 1.5}, "scene.volume_averaging is 1.5; allowed"),
        ({"remap_time": -1.0}, "scene.remap_time is -1.0 s"),
        ({"remap_distance": 0.0}, "scene.remap_distance is 0.0 grid spacings; allowed"),
        ({"velocity_memory": 0.0}, "scene.velocity_memory is 0.0 s"),
        ({"body_grid": (0, 5)}, "scene.body_grid"),
        ({"contact_margin": 2.0}, "scene.contact_margin"),
        (
            {"blade": Plate(length=0.2, width=0.193, thickness=0.012), "contact_margin": -1.0},
            "too thin for a grid of 0.02 m",
        ),
    ],
)
def test_what_a_scene_refuses(change, words):
    with pytest.raises(SceneError, match=words):
        cut(**change)


@pytest.mark.parametrize(
    ("cls", "values", "words"),
    [
        (Bed, {"size": (0.8, 0.6)}, "three lengths"),
        (Bed, {"spacing": 0.2}, "half the bin"),
        (Bed, {"spacing": 1e-4}, "particles; at most"),
        (Bed, {"arrangement": "heap"}, "allowed: lattice, jittered, poisson"),
        (Bed, {"store_every": 0}, "bed.store_every is 0; it must be a whole number"),
        (Bed, {"store_every": 2.5}, "bed.store_every is 2.5; it must be a whole number"),
        (Bed, {"initial_stress": "some"}, "allowed: geostatic, k0, none"),
        (Plate, {"thickness": 0.0}, "blade.thickness"),
        (Plate, {"friction": -1.0}, "blade.friction"),
        (Material, {"poissons_ratio": 0.5}, "poissons_ratio"),
        (Material, {"limit_friction": 0.5}, "must be above material.static_friction"),
        (Material, {"youngs_modulus": float("inf")}, "youngs_modulus"),
    ],
)
def test_what_its_parts_refuse(cls, values, words):
    with pytest.raises(SceneError, match=words):
        cls(**values)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ({"kind": "cube"}, "scene.kind is 'cube'; allowed: bed, "),
        ({"kind": "excavation", "dept": 0.1}, "scene has no key 'dept'; allowed: .*depth"),
        (
            {"kind": "excavation", "bed": {"spacing": "fine"}},
            "scene.bed.spacing is 'fine'; it must be a finite number",
        ),
        ({"kind": "excavation", "bed": {"seed": 1.5}}, "scene.bed.seed is 1.5; it must be a whole number"),
        ({"kind": "excavation", "blade": 3}, "scene.blade is 3; it must be a group"),
    ],
)
def test_what_nested_data_may_not_say(data, words):
    with pytest.raises(SceneError, match=words):
        Scene.from_dict(data)


def test_warnings_name_thin_plates_and_weak_soil():
    thin = cut(blade=Plate(length=0.2, width=0.19, thickness=0.03))
    assert any("1.5 grid spacings thick" in w for w in thin.warnings())
    weak = cut(material=Material(static_friction=0.4))
    assert any("K0" in w for w in weak.warnings())
    assert cut().warnings() == []
