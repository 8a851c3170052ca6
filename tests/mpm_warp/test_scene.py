"""Scenes: what they hold, what they refuse."""

import json
import math

import numpy as np
import pytest
import warp as wp

from mpm_warp import (
    Bed,
    Body,
    Column,
    Cylinder,
    Effects,
    Excavation,
    Incline,
    Material,
    Plate,
    Scene,
    SceneError,
    Solver,
    Walls,
    Wheel,
    effects_for,
)
from mpm_warp import limits as size_module
from mpm_warp.limits import scene_size
from mpm_warp.poses import rotate
from sgns_testing.scenes import cut


@pytest.mark.parametrize(
    "scene",
    [
        cut(motion="path", path=((0.0, 0.2, 0.2, 0.2, 0, 0, 0, 1), (1.0, 0.25, 0.2, 0.2, 0, 0, 0, 1))),
        cut(bed=Bed(size=(0.48, 0.4, 0.16), spacing=0.02, walls=Walls("slip", 0.3, 0.5))),
        cut(material=Material(friction_angle=44.0, friction_map="triaxial")),
        Incline(),
        Column(shape="slab"),
        Body(
            tool=Cylinder(grousers=5, grouser_height=0.01, grouser_thickness=0.01),
            path=((0.0, 0.2, 0.2, 0.2, 0, 0, 0, 1),),
        ),
    ],
    ids=["path", "walls", "friction angle", "incline", "slab", "body"],
)
def test_a_scene_survives_json(scene):
    again = Scene.from_dict(json.loads(json.dumps(scene.to_dict())))
    assert again == scene
    assert again.to_dict() == scene.to_dict()


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
    whole = Scene(bed=Bed(spacing=0.02))
    count = len(whole.filled[0])
    assert (whole.stored == np.arange(count)).all()
    thinned, again = (Scene(bed=Bed(spacing=0.02, store_every=8)) for _ in range(2))
    assert (thinned.stored // 8 == np.arange(-(-count // 8))).all()
    assert (again.stored == thinned.stored).all()
    # The bed is 8 layers deep: a fixed step of 8 would leave a single layer.
    depth = thinned.filled[0][thinned.stored, 2]
    share = np.unique(np.round(depth, 6), return_counts=True)[1] / len(depth)
    np.testing.assert_allclose(share, 1 / 8, atol=0.05)
    assert len(share) == 8


def from_data(**data) -> Scene:
    return Scene.from_dict(data)


REFUSED = {
    cut: [
        ({"depth": 0.3}, r"leaves the bin at .* z = .*; change scene.depth"),
        ({"speed": 3.0, "duration": 1.0}, "leaves the bin"),
        ({"speed": 0.0}, "scene.speed is 0.0 m/s; allowed: above 0, at most 10000"),
        ({"motion": "path"}, "needs scene.path"),
        ({"path": ((0.0,) * 8,)}, "use scene.motion=path"),
        ({"gravity": 1e300}, r"scene.gravity is 1e\+300 m/s\^2; allowed: 0 to 100000"),
        ({"duration": 0.0}, "scene.duration is 0.0 s; it must last at least one frame"),
        ({"duration": 1e5}, r"duration is 100000.0 s at .* 60.0 Hz: 6e\+06 frames; at most 1e\+06"),
        ({"courant": 1.0}, "scene.courant is 1.0; allowed: 0.0001 to 0.8: with longer steps elastic waves"),
        ({"remap_time": -1.0}, r"scene.remap_time is -1.0 s; it must be 0 \(every step\) or more"),
        ({"body_grid": (0, 5)}, r"scene.body_grid is \(0, 5\); it needs two counts from 1 to 100"),
        (
            {"blade": Plate(length=0.2, width=0.193, thickness=0.012), "contact_margin": -1.0},
            "too thin for a grid of 0.02 m",
        ),
        (
            {
                "blade": Plate(length=0.2, width=0.193, thickness=0.018, edge="square"),
                "contact": "nodes",
                "contact_margin": 0.0,
            },
            "too thin for a grid of 0.02 m",
        ),
        (
            {"blade": Plate(length=0.2, width=0.193, thickness=0.044, edge="bevel"), "contact": "nodes"},
            "scene.contact is 'nodes' and blade.edge 'bevel'; it is for a square end",
        ),
    ],
    Wheel: [
        ({"load": 0.0}, "scene.load is 0.0 N; a wheel needs more than 0"),
        ({"load": "much"}, "scene.load is 'much' N; .* or rows of a time"),
        ({"load": []}, "scene.load is empty; it must be a number above 0 N, or rows"),
        ({"load": [1.0, 2.0]}, r"row 1 of scene.load is 1; it needs a time \[s\] and a load"),
        ({"load": [[0.0, "a"]]}, r"row 1 of scene.load is .*; it needs a time"),
        ({"load": [[0.0, 1.0], [1.0, 0.0]]}, "row 2 of scene.load is .*; a wheel needs more than 0 N"),
        ({"load": [[0.0, 1.0], [0.0, 2.0]]}, "row 2 of scene.load .*; times increase"),
        ({"rim_speed": 0.0}, "scene.rim_speed is 0.0 m/s; a wheel needs more than 0, or scene.travel_speed"),
        ({"rim_speed": -1.0}, "scene.rim_speed is -1.0 m/s; it must be 0 or more"),
        ({"travel_speed": -1.0}, "scene.travel_speed is -1.0 m/s; it must be 0 or more"),
        ({"slip_angle": 91.0}, "scene.slip_angle is 91.0 degrees; allowed: -90 to 90"),
        ({"slip_angle": 60.0, "diameter": 0.19}, "206 m wide across its travel, but the bin is only 0.19 m"),
        ({"load": 1e-12}, r"a wheel of 1.02e-13 kg; allowed: 1e-09 to 1e\+09 kg"),
        ({"gravity": 0.0}, "scene.gravity is 0.0 m/s.* a wheel needs more than 0"),
        ({"settle": -1.0, "duration": 1.0}, "scene.settle"),
        ({"grousers": 4}, "scene.grouser_height is 0.0; it must be above 0 m"),
        ({"width": 0.3}, "only 0.19 m wide"),
        ({"friction_angle": 95.0}, "friction_angle is 95.0"),
        ({"start": 0.9, "duration": 9.0}, "the axle moves from"),
        ({"clearance": 0.2}, "below bed.headroom"),
    ],
    Column: [
        ({"radius": 0.4}, "scene.radius is 0.4 m; allowed: .* half the bin"),
        ({"shape": "cone"}, "scene.shape is 'cone'; allowed: cylinder, slab"),
    ],
    Incline: [
        ({"flowing": 1}, "scene.flowing is 1; allowed: true, false"),
        ({"tilt": 20.0}, r"flows steadily between 20.90 and 32.76 degrees.*scene.flowing=false"),
        ({"tilt": 95.0}, "scene.tilt is 95.0 degrees; allowed"),
    ],
    Body: [
        ({}, "scene.path is missing"),
        ({"path": ((0.0, 0.2, 0.2, -0.2, 0, 0, 0, 1),)}, "the body leaves the bin at 0.000 s: z = "),
    ],
    Bed: [
        ({"size": (0.8, 0.6)}, "three lengths"),
        ({"spacing": 0.2}, "half the bin"),
        ({"spacing": 1e-4}, "particles; at most"),
        ({"spacing": 1e-320}, "inf particles; at most"),
        ({"headroom": 1e14}, r"bed.headroom is 10{14}.0 m .* at most 2e\+08 are allowed: lower bed.headroom"),
        ({"headroom": math.inf}, "bed.headroom is inf m"),
        ({"spacing": 2e-4, "particles_per_cell": 1e-4}, "nodes; .* larger bed.spacing"),
        ({"seed": -1}, "bed.seed is -1; allowed: 0 to"),
        ({"particles_per_cell": 1e-300}, "bed.particles_per_cell is 1e-300; it must be 1e-15 to"),
        ({"store_every": 2.5}, "bed.store_every is 2.5; it must be a whole number"),
        (
            {"size": (0.15, 0.2, 0.1), "spacing": 0.02, "walls": Walls(x="periodic")},
            "bed.walls.x is periodic but .* 7.500 grid spacings",
        ),
    ],
    Walls: [
        ({"x": "sticky"}, "bed.walls.x is 'sticky'; allowed: no_slip, slip, periodic or a friction"),
        ({"floor": "periodic"}, "bed.walls.floor is 'periodic'; allowed: no_slip, slip or a friction"),
        ({"y": True}, "bed.walls.y is True; allowed"),
    ],
    Plate: [({"width": float("nan")}, "blade.width is nan; it must be above 0 m and at most 1000 m")],
    Cylinder: [
        ({"grousers": 3}, "tool.grouser_height"),
        ({"grouser_height": 0.01}, "need tool.grousers above 0"),
        ({"grousers": 30, "grouser_height": 0.01, "grouser_thickness": 0.02}, "make them thinner or fewer"),
    ],
    Material: [
        ({"poissons_ratio": 0.5}, "poissons_ratio is 0.5; allowed: 0 to 0.499: soil that keeps"),
        ({"limit_friction": 0.5}, "must be above material.static_friction"),
        ({"friction_angle": 0.0}, "friction_angle is 0.0; allowed: above 0 and below 90 degrees"),
        ({"rate_law": "cubic"}, "rate_law is 'cubic'; allowed: saturating, linear"),
    ],
    Effects: [
        ({"yielding": False}, "effects.rate_dependence needs effects.yielding"),
        ({"rate_dependence": False, "nonlocality": True}, "nonlocality needs effects.rate_dependence"),
    ],
    from_data: [
        ({"kind": "cube"}, "scene.kind is 'cube'; allowed: bed, "),
        ({"kind": "excavation", "dept": 0.1}, "scene has no key 'dept'; allowed: .*depth"),
        ({"bed": {"spacing": "fine"}}, "scene.bed.spacing is 'fine'; it must be a finite number"),
        ({"bed": {"seed": 1.5}}, "scene.bed.seed is 1.5; it must be a whole number"),
        ({"kind": "excavation", "blade": 3}, "scene.blade is 3; it must be a group"),
        ({"kind": "body", "tool": {}}, "scene.tool.shape is .*; allowed: box, cylinder, mesh"),
    ],
}


@pytest.mark.parametrize(
    ("make", "values", "words"), [(make, *case) for make, cases in REFUSED.items() for case in cases]
)
def test_what_is_refused(make, values, words):
    with pytest.raises(SceneError, match=words):
        make(**values)


def test_warnings_name_thin_plates_and_weak_soil():
    thin = cut(blade=Plate(length=0.2, width=0.19, thickness=0.026))
    assert any("1.3 grid spacings thick" in w for w in thin.warnings()) and "coarse" not in thin.remarks()[0]
    coarse = cut(blade=Plate(length=0.2, width=0.19, thickness=0.03))  # about as the default: by choice
    assert coarse.warnings() == [] and "a coarse grid: the plate is 1.5 grid spacings" in coarse.remarks()[0]
    weak = cut(material=Material(static_friction=0.4))
    assert any("K0" in w for w in weak.warnings())
    assert cut().warnings() == []


@pytest.mark.parametrize(
    ("scene", "words"),
    [
        (
            Wheel(bed=Bed(), load=1e-6),
            r"[78]\.\d+e\+08 substeps of .* at most 1e\+06 .* mass of 1.02e-07 kg .*: raise scene.load",
        ),
        (Scene(material=Material(youngs_modulus=1e12, grain_density=1e-6)), "raise material.grain_density"),
        (
            Scene(courant=1e-4, material=Material(youngs_modulus=1e12)),
            "1e.06 are allowed: raise scene.courant",
        ),
        (Scene(frame_rate=1e-3, duration=1e4, courant=0.1), "allowed: raise scene.frame_rate"),
        (
            Scene(courant=0.02, duration=1e4),
            r"the run would take .* lower scene.duration \(10000 s\), or raise scene.cou",
        ),
        (Wheel(rim_speed=1e9, slip=1.0), "the body moves at up to .* scene.rim_speed slower"),
    ],
    ids=["mass", "density", "courant", "rate", "duration", "speed"],
)
def test_too_many_substeps_are_refused_before_anything_is_there(scene, words, monkeypatch):
    """With the key that asks for them. Particles are never made."""
    monkeypatch.setattr(Bed, "filled", property(lambda self: pytest.fail("particles were made")))
    for refusing in (Solver, effects_for, scene_size):
        with pytest.raises(SceneError, match=words) as caught:
            refusing(scene)
        assert "\n" not in str(caught.value)


def test_large_scenes_are_no_problem():
    """Ten million particles, and a hundred thousand substeps in a frame."""
    size = scene_size(Scene(bed=Bed(size=(2.0, 1.0, 0.5), spacing=0.0046)))
    assert 1e7 < size.particles < size.nodes < 3e7
    assert 4e9 < size.memory < 1e10
    assert scene_size(Wheel(bed=Bed(), load=0.01)).substeps > 7e4


@pytest.mark.parametrize("arrangement", ["lattice", "jittered", "poisson"])
def test_the_size_is_that_of_the_solver(arrangement):
    bed = Bed(size=(0.4, 0.3, 0.1), spacing=0.02, arrangement=arrangement)
    scene = Scene(bed=bed, duration=0.5)
    solver, size = Solver(scene), scene_size(scene)
    assert solver.particle_count == pytest.approx(size.particles, rel=0.3 if arrangement == "poisson" else 0)
    assert (size.substeps, size.steps) == (solver.substeps_per_frame, 30 * solver.substeps_per_frame)
    assert size.nodes == len(solver._inverse_mass)
    assert bed.particle_volume == bed.filled[1]
    held = [*vars(solver).values(), *vars(solver.particles).values(), *solver._memory._good.values()]
    arrays = [a for a in held if isinstance(a, wp.array)]
    assert sum(a.size * wp.types.type_size_in_bytes(a.dtype) for a in arrays) < size.memory


def test_a_scene_that_memory_does_not_hold_is_refused(monkeypatch):
    monkeypatch.setattr(size_module, "_memory", lambda device: 5e6)
    with pytest.raises(
        SceneError, match=r"needs about .* GB of memory and cpu has 0.005 GB: 2.97e\+04 particles"
    ):
        Solver(Scene())


@pytest.mark.parametrize(
    "row", [1, None, [], [1, 2], [0, 0, 0, 0, 0, 0, 0, None], list("abcdefgh"), [1e300] * 8]
)
def test_a_path_that_is_no_table_of_eight_numbers(row) -> None:
    with pytest.raises(SceneError, match=r"row 1 of the path "):
        Scene.from_dict({"kind": "excavation", "motion": "path", "path": [row]})
