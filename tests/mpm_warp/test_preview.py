"""What is known of a scene before it runs: where its tool is and gets to, units, and what would come to nothing."""

import re

import numpy as np
import pytest

from mpm_warp import (
    Bed,
    Body,
    Box,
    Column,
    Excavation,
    Material,
    MeshBody,
    Plate,
    Preview,
    Scene,
    SceneError,
    Walls,
    Wheel,
)
from mpm_warp.kernels.signed_distance import wall_kernel
from mpm_warp.preview import afterwards
from sgns_testing.meshes import box_corners, box_triangles
from sgns_testing.scenes import cut

BED = Bed(size=(0.8, 0.6, 0.15), spacing=0.02)
ROWS = np.array([(0.0, 0.2, 0.3, 0.12), (0.5, 0.2, 0.3, 0.03), (2.0, 0.5, 0.3, 0.03)])
"""t [s], x, y, z [m]: half a second down, then forward."""


def body(rows=ROWS, **kw) -> Body:
    path = tuple((*row, 0, 0, 0, 1) for row in np.asarray(rows, dtype=float).tolist())
    return Body(**({"bed": BED, "tool": Box(size=(0.08, 0.2, 0.1)), "path": path} | kw))


def mesh(scale: float) -> MeshBody:
    size = scale * np.array((0.05, 0.2, 0.1))
    return MeshBody.of_mesh(box_corners(size, -0.5 * size), box_triangles())


def test_where_a_tool_is_and_gets_to():
    """The box's lowest point is 5 cm below its centre, which falls by 18 cm a second."""
    found = Preview.of(body())
    assert found.lowest == pytest.approx(-0.02)
    assert found.lowest_at == pytest.approx(0.5)
    assert found.first_touch == pytest.approx(0.07 / 0.18, abs=0.02)
    np.testing.assert_allclose(found.reach, [[-0.04, -0.1, -0.05], [0.04, 0.1, 0.05]])
    assert found.displaced == 0 and found.warnings == ()
    origin, particles, way = found.lines
    assert particles.startswith("one particle per cell: forces may be wrong by tens of per cent; ")
    assert particles.endswith("scene.bed.particles_per_cell=4 takes 4 times as long")
    finer = Bed(size=(0.8, 0.6, 0.15), spacing=0.02, particles_per_cell=2.0)
    assert Preview.of(body(bed=finer)).lines == (origin, way)
    assert "from -40 to 40 mm along x, -100 to 100 mm along y, -50 to 50 mm along z" in origin
    assert way == "its lowest point gets 20 mm deep (at 0.50 s); it first touches soil at 0.40 s"


def test_a_path_that_does_not_end_with_the_run_is_told():
    (cut_off,) = Preview.of(body(duration=1.0)).warnings
    assert "the run ends at 1 s and the path goes on to 2 s" in cut_off and "scene.duration=2" in cut_off
    longer = Preview.of(body(duration=3.0))
    assert longer.warnings == () and "the path ends at 2 s; the tool rests there until 3 s" in longer.lines


def test_scenes_that_come_to_something_say_no_more_than_before():
    for scene in (cut(), Excavation(), Wheel(), Column(), body(tool=mesh(1.0))):
        assert list(Preview.of(scene).warnings) == scene.warnings()
    assert Preview.of(Column()).lowest is None
    assert Preview.of(Wheel()).lines == ()  # its height is free


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (ROWS * [1, 1000, 1000, 1000], "never touches soil: .* stays 29.9 m above .* look like millimetres"),
        (ROWS * [1, 100, 100, 100], "never touches soil: .* look like centimetres"),
        (ROWS * [1000, 1, 1, 1], r"times are 0 to 2000, .* 0\.1 % is used; they look like milliseconds"),
        (np.add(ROWS, [1.7e9, 0, 0, 0]), "look like those of a clock; subtract the first"),
        (np.add(ROWS, [1.7e12, 0, 0, 0]), "look like those of a clock; subtract the first"),
        (np.add(ROWS, [5, 0, 0, 0]), "times are 5 to 7, the run's 0 to 2 s: the tool does not move"),
        (ROWS * [1000, 1, 1, 1] + [3000, 0, 0, 0], "the tool does not move; they look like milliseconds"),
        (ROWS / [60, 1, 1, 1], "rests for nearly all of it; are the times in seconds"),
        (np.add(ROWS, [0, 0, 0, 0.2]), "stays 180 mm above .*; z = 0 is the surface and below it .* neg"),
        (ROWS[:, [0, 1, 3, 2]], "never touches soil: its lowest point stays 250 mm above"),
        (ROWS[[0, 0, 0]] * [0, 1, 1, 1] + [[t, 0, 0, 0] for t in (0, 1, 2)], "the tool does not move"),
    ],
)  # fmt: skip
def test_one_line_names_what_comes_to_nothing(rows, words):
    (found,) = Preview.of(body(rows)).warnings
    assert re.search(words, found), found
    # Commands refuse what another unit explains.
    sure = "look like" in words
    assert Preview.of(body(rows)).not_meant == ((found,) if sure else ())


def test_a_tool_that_starts_in_the_soil_is_told():
    scene = body(ROWS[1:] - [0.5, 0, 0, 0.05])
    (found,) = Preview.of(scene).warnings
    assert f"in the soil at the start, 70 mm deep: {len(scene.displaced)} particles" in found
    assert Preview.of(scene).lines[2].endswith("it is in the soil from the start")


@pytest.mark.parametrize(
    ("scale", "words", "sure"),
    [
        (0.001, "0.0002 m long, less than 1/50 of the bin .* a thousand times too small", True),
        (8.0, "1.6 m long, longer", False),  # it may have a long handle
        (200.0, "40 m long, longer than the bin .* look like millimetres", True),
    ],
)
def test_the_size_of_a_tool_is_looked_at(scale, words, sure):
    rows = np.add(ROWS, [0, 0, 0, 0.15 * scale])
    preview = Preview.of(body(rows, tool=mesh(scale)))
    found = preview.warnings[0]
    assert re.search(words, found), found
    assert preview.not_meant[:1] == ((found,) if sure else ())


def test_a_channel_may_be_narrower_than_the_tool():
    narrow = Bed(size=(0.8, 0.08, 0.15), spacing=0.02, walls=Walls(y="periodic"))
    assert (
        Preview.of(body(ROWS - [0, 0, 0.26, 0], bed=narrow, tool=Box(size=(0.08, 1.0, 0.1)))).warnings == ()
    )


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (
            lambda: body(ROWS * [1, 1000, 1000, 1000] - [0, 0, 0, 100]),
            "leaves the bin .* look like millimetres",
        ),
        (lambda: body(tool=mesh(1000.0)), "leaves the bin .* 200 m long, .* look like millimetres"),
        (
            lambda: body(tool=Box(size=(5e-5, 2e-4, 1e-4)), bed=Bed(particles_per_cell=8.0)),
            "too thin .* thousand times too small",
        ),
    ],
)
def test_what_is_refused_for_its_unit_names_it(make, words):
    with pytest.raises(SceneError, match=words):
        make()


def test_walls_are_measured_once(monkeypatch):
    """Rays through a mesh of many triangles take a while, and several ask."""
    asked = []
    monkeypatch.setattr(
        "mpm_warp.kernels.signed_distance.wall_kernel", lambda: asked.append(1) or wall_kernel()
    )
    fine = Bed(size=(0.8, 0.6, 0.15), spacing=0.02, particles_per_cell=8.0)
    scene = body(ROWS - [0, 0, 0, 0.12], tool=mesh(0.4), bed=fine)  # it starts in the soil
    assert any("thinnest part is 20 mm" in line for line in Preview.of(scene).warnings)
    assert len(scene.displaced) and len(asked) == 7  # places in each triangle


def test_a_plate_above_the_soil_is_told_what_its_depth_counts_from():
    assert "never touches soil" in (found := Preview.of(Excavation(motion="rest")).warnings[-1])
    assert found.endswith("scene.depth, which is positive, counts from scene.clearance above the surface")


def test_where_the_walls_are_if_the_grid_does_not_fit_the_bin():
    (line,) = Preview.of(Column(bed=Bed(size=(0.61, 0.6, 0.15), spacing=0.02))).lines
    assert line.endswith("the soil fills 0.61 x 0.6 m, the walls stand 0.62 x 0.6 m apart")
    assert Preview.of(Column()).lines == ()


def test_a_checkpoints_scene_with_a_mesh_says_where_the_mesh_is():
    scene = body(tool=mesh(1.0))
    data = scene.to_dict()
    data["tool"]["digest"] = "0123"
    with pytest.raises(SceneError, match=r"from a run: Scene.from_dict\(run.scene, \*run.meshes\)"):
        Scene.from_dict(data)


def test_a_tool_that_comes_to_the_floor_is_told():
    assert not any("floor" in words for words in Preview.of(cut(depth=0.1, duration=1.5, speed=0.1)).warnings)
    deep = Preview.of(cut(depth=0.15, duration=1.5, speed=0.1)).warnings
    [words] = [one for one in deep if "floor" in one]
    assert "mm above the floor, less than one grid spacing" in words
    assert not any("floor" in words for words in Preview.of(Wheel()).warnings)
    [words] = [one for one in Preview.of(Wheel(clearance=-0.055)).warnings if "floor" in one]
    assert "comes to 5 mm above the floor" in words


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: cut(rake=0.35), "scene.rake is 0.35 degrees, which looks like radians; .*: scene.rake=20.1"),
        (lambda: cut(rake=-0.5), "scene.rake is -0.5 .* scene.rake=-28.6"),
        (lambda: cut(material=Material(friction_angle=0.65)), "material.friction_angle is 0.65 .*=37.2"),
        (lambda: Column(material=Material(friction_angle=0.65)), "material.friction_angle is 0.65 .*=37.2"),
        (lambda: Wheel(friction_angle=0.65), "scene.friction_angle is 0.65 degrees"),
        (
            lambda: Wheel(friction_angle=None, material=Material(friction_angle=0.65)),
            "material.friction_angle is 0.65",
        ),
        (lambda: cut(rake=0.0), None),
        (lambda: cut(rake=3.8), None),
        (lambda: Wheel(slip_angle=0.5), None),  # small ones are usual
        (lambda: Column(tilt=0.5), None),
    ],
)
def test_an_angle_that_looks_like_radians_is_told(make, words):
    found = [line for line in Preview.of(make()).warnings if "radians" in line]
    assert len(found) == (words is not None) and (not words or re.search(words, found[0])), found


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Bed(size=(300.0, 200.0, 100.0)), r"bed.size is \[300.0, .*, in metres: .* millimetres\?"),
        (lambda: Bed(spacing=20.0), r"half the bin's smallest side \(0.075 m\); lengths are in metres"),
        (lambda: cut(depth=50.0), "leaves the bin .*; scene.depth is 50 m; lengths are in metres"),
    ],
)
def test_a_refused_length_in_millimetres_is_told(make, words):
    with pytest.raises(SceneError, match=words):
        make()


def test_a_plate_far_above_the_soil_is_told_that_lengths_are_metres():
    [words] = [line for line in Preview.of(cut(clearance=6.65)).warnings if "never touches" in line]
    assert words.endswith("; lengths are in metres")


def test_soil_that_will_be_pushed_against_a_wall_is_told():
    """Not of presets, nor of a tool that moves away from the wall behind it."""
    assert not any(
        "against the wall" in one for scene in (Wheel(), cut()) for one in Preview.of(scene).warnings
    )
    wheel = Wheel(gravity=1.62, travel_speed=0.05)
    [told] = [one for one in Preview.of(wheel).warnings if "against the wall at x = 0.4 m" in one]
    fits = float(re.search(r"scene.duration=([\d.]+)", told)[1])
    assert 3.5 < fits < 5.0
    assert Preview.of(Wheel(gravity=1.62, travel_speed=0.05, duration=fits)).warnings == ()
    back = [(0.0, 0.4, 0.3, 0.12), (0.5, 0.4, 0.3, 0.03), (1.0, 0.4, 0.35, 0.03), (2.0, 0.4, 0.12, 0.03)]
    assert "against the wall at y = 0 m" in " ".join(Preview.of(body(back)).warnings)
    channel = Bed(size=(0.8, 0.6, 0.15), spacing=0.02, walls=Walls(y="periodic"))
    assert Preview.of(body(back, bed=channel)).warnings == ()


def test_a_tool_that_moves_along_a_wall_is_told():
    """Not of walls on which soil slips, nor of the wall behind a tool, nor above the soil."""

    def told(rows, **kw):
        return [one for one in Preview.of(body(rows, **kw)).warnings if "from the wall" in one]

    [near] = told(np.subtract(ROWS, [0, 0, 0.19, 0]))  # the box is 0.2 m wide
    assert "comes to 10 mm from the wall at y = 0 m, less than one grid spacing" in near
    assert near.endswith("lay scene.path further from it, in a wider scene.bed.size if need be")
    assert "from the wall at y = 0.6 m" in told(np.add(ROWS, [0, 0, 0.19, 0]))[0]
    for rows in (
        np.subtract(ROWS, [0, 0, 0.18, 0]),
        np.subtract(ROWS, [0, 0, 0.19, -0.03]),
        ROWS[1:] - [0.5, 0.15, 0, 0],
    ):
        assert told(rows) == []
    slippery = Bed(size=(0.8, 0.6, 0.15), spacing=0.02, walls=Walls(y="slip"))
    assert told(np.subtract(ROWS, [0, 0, 0.19, 0]), bed=slippery) == []
    [wheel] = [one for one in Preview.of(Wheel(width=0.18)).warnings if "from the wall" in one]
    assert wheel.endswith("too large; use a wider scene.bed.size")


def test_a_tool_so_fast_that_soil_leaves_the_grid_is_told():
    """Soil at 2.2 m/s flies 25 cm high, the default headroom."""
    fast = ROWS * [0.05, 1, 1, 1]  # the whole path in 0.1 s
    [told] = Preview.of(body(fast, duration=0.1)).warnings
    assert "moves at up to 4 m/s in the soil (at 0.0" in told and "flies 815 mm high, out of the grid" in told
    assert told.endswith("are the times of the path in seconds? If it is meant, raise scene.bed.headroom")
    assert Preview.of(body(ROWS * [0.1, 1, 1, 1], duration=0.2)).warnings == ()
    blade = cut(speed=2.0, duration=0.05)
    [told] = [one for one in Preview.of(blade).warnings if "moves at" in one]
    assert "scene.speed is in m/s. If it is meant" in told


def test_a_wheel_that_sinks_too_little_for_the_grid_is_told_afterwards():
    wheel = Wheel()
    poses = wheel.poses_at(wheel.times())
    for sunk, told in ((0.0030, True), (0.0035, False)):  # on a grid of 10 mm
        words = afterwards(wheel, poses - [0, 0, sunk, 0, 0, 0, 0])
        assert len(words) == told
    [words] = afterwards(wheel, poses - [0, 0, 0.0013, 0, 0, 0, 0])
    assert "mean sinkage is 1.3 mm, less than a third of a grid spacing (10 mm)" in words
    assert words.endswith("use a finer scene.bed.spacing")


def test_how_a_tool_is_turned_at_the_start_is_told():
    """A quaternion written w, x, y, z stands the tool on its head; here its origin is its tip."""
    upright = Preview.of(body()).lines[0]
    assert "turned" not in upright
    over = tuple((*row, 1, 0, 0, 0) for row in np.add(ROWS, [0, 0, 0, 0.1]).tolist())
    tool = MeshBody.of_mesh(mesh(1.0).mesh[0] * [1, 1, 2], box_triangles(), origin="tip")
    told = Preview.of(body(tool=tool, path=over)).lines[0]
    assert "at the start it is turned by 180 degrees about (1, 0, 0) and then reaches from" in told
    assert told.split("then reaches")[1].count("-200 to 0 mm along z") == 1


def test_a_raked_plate_that_starts_in_the_soil_is_told_the_clearance_that_it_needs():
    blade = Plate(thickness=0.06, width=0.2, length=0.2, edge="square")
    [told] = [one for one in Preview.of(cut(blade=blade, rake=45.0)).warnings if "at the start" in one]
    clearance = float(re.search(r"scene.clearance=([\d.]+) lets it begin above", told)[1])
    above = Preview.of(cut(blade=blade, rake=45.0, clearance=clearance))
    assert not any("at the start" in one for one in above.warnings) and above.displaced == 0
