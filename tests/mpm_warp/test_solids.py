"""What a mesh bounds: volume, centre of mass and inertia against known answers."""

import re

import numpy as np
import pytest

from mpm_warp import SceneError
from mpm_warp.solids import checked_mesh, closed_mesh
from sgns_testing.meshes import box_corners, box_triangles

INWARDS = box_triangles()[:, ::-1]


def moments(vertices, triangles):
    """Volume, centre (3,) and second moments (3, 3) about the origin."""
    corners = vertices[triangles]
    parts = np.linalg.det(corners) / 6.0
    total = corners.sum(axis=1)
    second = np.einsum("t,tki,tkj->ij", parts, corners, corners) + np.einsum(
        "t,ti,tj->ij", parts, total, total
    )
    return parts.sum(), (parts[:, None] * total).sum(axis=0) / (4.0 * parts.sum()), second / 20.0


def boxes(*several):
    """Vertices and triangles of boxes (size, lowest corner, triangles)."""
    vertices = np.concatenate([box_corners(size, corner) for size, corner, _ in several])
    return vertices, np.concatenate([8 * k + faces for k, (_, _, faces) in enumerate(several)])


def of_boxes(*several):
    """Moments of a sum of boxes (size, lowest corner, sign)."""
    volume, first, second = 0.0, np.zeros(3), np.zeros((3, 3))
    for size, corner, sign in several:
        size, middle = np.array(size), np.array(corner) + np.array(size) / 2
        v = sign * np.prod(size)
        volume += v
        first += v * middle
        second += v * (np.outer(middle, middle) + np.diag(size**2) / 12)
    return volume, first / volume, second


def check(solid, *known):
    volume, centre, second = of_boxes(*known)
    found = moments(solid.vertices, solid.triangles)
    np.testing.assert_allclose(found[0], volume, rtol=1e-9)
    np.testing.assert_allclose(found[1], 0.0, atol=1e-9)
    np.testing.assert_allclose(solid.centre, centre, atol=1e-9)
    np.testing.assert_allclose(found[2], second - volume * np.outer(centre, centre), atol=1e-9)
    checked_mesh(solid.vertices, solid.triangles)  # a run can keep it


A, B = ((1.0, 2.0, 3.0), (0.0, 0.0, 0.0)), ((1.0, 1.0, 1.0), (4.0, 1.0, 2.0))
INSIDE = ((0.4, 0.5, 0.6), (0.2, 0.3, 0.4))
OUT = box_triangles()


@pytest.mark.parametrize(
    ("parts", "known", "words"),
    [
        ([(*A, OUT)], [(*A, 1)], None),
        ([(*A, INWARDS)], [(*A, 1)], "the triangles faced inwards"),
        ([(*A, OUT), (*B, OUT)], [(*A, 1), (*B, 1)], None),
        ([(*A, OUT), (*B, INWARDS)], [(*A, 1), (*B, 1)], "1 of 2 parts faced inwards"),
        ([(*A, OUT), (*INSIDE, INWARDS)], [(*A, 1), (*INSIDE, -1)], None),
        ([(*A, INWARDS), (*INSIDE, OUT)], [(*A, 1), (*INSIDE, -1)], "faced inwards"),
        ([(*A, OUT), (*INSIDE, OUT)], [(*A, 1)], "wholly inside another"),
        (
            [(*A, OUT), (*INSIDE, INWARDS), ((0.1, 0.1, 0.1), (0.3, 0.4, 0.5), OUT)],
            [(*A, 1), (*INSIDE, -1), ((0.1, 0.1, 0.1), (0.3, 0.4, 0.5), 1)],
            None,
        ),
        # they overlap: what they share counts once
        (
            [(*A, OUT), ((2.0, 1.0, 1.0), (0.5, 0.5, 0.5), OUT)],
            [(*A, 1), ((2.0, 1.0, 1.0), (0.5, 0.5, 0.5), 1), ((0.5, 1.0, 1.0), (0.5, 0.5, 0.5), -1)],
            r"overlap.*share \(6%\) counts once",
        ),
    ],
    ids=["one", "inwards", "two", "one of two", "cavity", "all inwards", "nested", "island", "overlap"],
)
def test_shells_and_solids(parts, known, words):
    solid = closed_mesh(*boxes(*parts), "a.stl")
    check(solid, *known)
    assert bool(solid.notes) == bool(words)
    if words:
        assert re.search(words, solid.notes[0])


@pytest.mark.parametrize(
    "corner", [(1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0.5, 0)], ids=["face", "edge", "corner", "part"]
)
@pytest.mark.parametrize("other", [OUT, INWARDS], ids=["out", "in"])
def test_solids_that_touch(corner, other):
    """Corners at one place are one vertex, so edges belong to four triangles."""
    unit = (1.0, 1.0, 1.0)
    vertices, triangles = boxes((unit, (0, 0, 0), OUT), (unit, corner, other))
    vertices, place = np.unique(vertices, axis=0, return_inverse=True)
    triangles = place.reshape(-1)[triangles]
    if corner == (1, 0, 0) and other is INWARDS:
        with pytest.raises(SceneError, match="do not all face the same way"):
            closed_mesh(vertices, triangles, "a.stl")
    else:
        check(closed_mesh(vertices, triangles, "a.stl"), (unit, (0, 0, 0), 1), (unit, corner, 1))


def test_some_triangles_face_the_other_way():
    triangles = OUT.copy()
    triangles[[1, 5]] = triangles[[1, 5], ::-1]
    solid = closed_mesh(box_corners(*A), triangles, "a.stl")
    check(solid, (*A, 1))
    assert "2 triangles faced the other way than their neighbours" in solid.notes[0]


@pytest.mark.parametrize("rounding", [1e-7, 1e-6, 1e-5])
def test_corners_that_differ_by_rounding(rounding):
    corners = box_corners(*A)[OUT].reshape(-1, 3)
    corners = corners + np.random.default_rng(0).uniform(-rounding, rounding, corners.shape)
    solid = closed_mesh(corners, np.arange(36).reshape(-1, 3), "a.stl")
    assert solid.vertices.shape == (8, 3)
    assert "were joined" in solid.notes[0]
    np.testing.assert_allclose(moments(*solid[:2])[0], 6.0, rtol=20 * rounding)


def test_an_uneven_mesh_has_its_volumes_centre():
    """A pyramid's centre of mass lies a quarter of its height above its base."""
    vertices = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [0, 0, 2]]) + 7.0
    faces = np.array([[0, 2, 1], [0, 3, 2], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    solid = closed_mesh(vertices, faces, "pyramid")
    np.testing.assert_allclose(solid.vertices[4], [0, 0, 1.5], atol=1e-12)
    again = closed_mesh(vertices, faces[:, ::-1], "pyramid")
    np.testing.assert_allclose(again.vertices, solid.vertices, atol=1e-12)
    np.testing.assert_array_equal(again.triangles, faces)


def test_what_is_no_solid_is_refused():
    vertices = box_corners(*A)
    with pytest.raises(
        SceneError, match=r"not closed: 3 of 18 edges.*the first at \([\d. ,]+\) mm; .*fill_holes"
    ):
        closed_mesh(vertices, OUT[1:], "a.stl")
    with pytest.raises(SceneError, match="encloses no volume"):
        closed_mesh(vertices * [1, 1, 0], OUT, "a.stl")
    for far in (1e300, np.nan):
        with pytest.raises(SceneError, match=r"a corner of the mesh in a\.stl is not finite or beyond"):
            closed_mesh(vertices * far, OUT, "a.stl")
    many = [((1.0, 1.0, 1.0), (2.0 * k, 0.0, 0.0), OUT) for k in range(1001)]
    with pytest.raises(SceneError, match="1001 separate parts"):
        closed_mesh(*boxes(*many), "a.stl")


def test_a_mesh_without_any_area_is_refused():
    with pytest.raises(SceneError, match="no triangle of the mesh in"):
        closed_mesh(np.zeros((4, 3)), np.zeros((0, 3), dtype=int), "a.obj")
