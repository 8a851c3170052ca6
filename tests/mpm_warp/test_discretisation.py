"""Mirror symmetry: half the bed computed is the whole bed computed."""

from dataclasses import replace

import numpy as np
import pytest

from mpm_warp import Bed, Column, Effects, Material, Scene, SceneError, Solver, Walls, asymmetry
from mpm_warp.discretisation import half
from sgns_testing.scenes import cut

BED = Bed(size=(0.48, 0.40, 0.16), spacing=0.02, headroom=0.12)
ODD = replace(BED, size=(0.48, 0.42, 0.16))


@pytest.mark.parametrize(
    ("bed", "on_plane", "effects"),
    [
        (BED, 0, Effects()),  # the plane is a layer of nodes
        (ODD, 192, Effects()),  # half way between two, with particles on it
        (replace(BED, size=(0.48, 0.41, 0.16)), 0, Effects()),  # not a whole number of cells
        (replace(BED, arrangement="poisson", mirrored=True), None, Effects()),
        (replace(ODD, arrangement="jittered", mirrored=True), 192, Effects()),
        (replace(BED, walls=Walls("periodic", "slip", 0.3)), 0, Effects()),
        (BED, 0, Effects(fluidity=True, nonlocality=True)),
        (ODD, 192, Effects(nonlocality=True)),
    ],
)
def test_half_is_whole(bed, on_plane, effects):
    """Force, torque, positions and velocities agree to round-off, in the same order."""
    coarse = Material(grain_diameter=5e-3)
    scene = cut(bed=bed, material=coarse, duration=0.1, depth=0.08, clearance=0.0, remap_time=1e-3)
    whole, mirrored = (
        Solver(scene, replace(effects, symmetry=on), precision="float64") for on in (False, True)
    )
    assert mirrored.computed_count == (whole.computed_count + half(scene).on_plane) / 2
    assert mirrored.particle_count == whole.particle_count == whole.computed_count
    assert on_plane in (half(scene).on_plane, None)
    size = 0.0
    for one, other in zip(whole.frames(), mirrored.frames(), strict=True):
        size = max(size, np.linalg.norm(one.force))
        np.testing.assert_allclose(other.force, one.force, atol=1e-10 * size)
        np.testing.assert_allclose(other.torque, one.torque, atol=1e-10 * size)
        np.testing.assert_allclose(other.position, one.position, atol=1e-9)
        np.testing.assert_allclose(other.velocity, one.velocity, atol=1e-8)
    assert size > 10.0


LAYER = Bed(size=(0.2, 0.04, 0.12), spacing=0.02, particles_per_cell=0.125, walls=Walls(y="slip"))
"""One layer of particles, on the plane of symmetry: no half is left out, and all of them count half."""


def narrow_column(width: float) -> Column:
    bed = Bed(size=(0.3, width, 0.05), spacing=0.01, headroom=0.03)
    # The time between remaps is bounded so that it does not hang on the last digit of the top speed.
    return Column(bed=bed, radius=0.05, duration=0.1, remap_time=1e-3)


@pytest.mark.parametrize(
    ("scene", "nonlocality", "moved", "close"),
    [
        (narrow_column(0.30), False, 1e-2, 1e-8),
        (narrow_column(0.31), False, 1e-2, 1e-8),  # with particles on the plane
        (Scene(bed=LAYER, duration=0.05), False, 1e-6, 1e-9),
        (Scene(bed=LAYER, duration=0.05), True, 1e-6, 1e-9),
    ],
    ids=["column", "column on plane", "layer", "nonlocal layer"],
)
def test_half_is_whole_without_a_body_too(scene, nonlocality, moved, close):
    whole, half = (
        list(Solver(scene, Effects(symmetry=on, nonlocality=nonlocality), precision="float64").frames())[-1]
        for on in (False, True)
    )
    assert np.abs(whole.position - scene.initial_positions()).max() > moved
    np.testing.assert_allclose(half.position, whole.position, atol=close)


def test_a_mirrored_bed_is_as_dense_as_others():
    for kind in ("jittered", "poisson"):
        beds = [replace(BED, size=(0.24, 0.4, 0.1), arrangement=kind, mirrored=m) for m in (False, True)]
        plain, mirrored = (b.filled[0] for b in beds)
        assert len(mirrored) == pytest.approx(len(plain), rel=0.03)
        y = mirrored[:, 1] - 0.2
        assert np.sum(np.abs(y) < 0.04) == pytest.approx(0.2 * len(mirrored), rel=0.1)
        assert beds[0].arrangement_hash != beds[1].arrangement_hash


def path(y: float = 0.2, roll: float = 0.0):
    """Straight but for one moment between two frames, when it is off the plane or turned about x."""
    straight = (0.2, 0.2, 0.04, 0.0, 0.0, 0.0, 1.0)
    off = (0.2, y, 0.04, np.sin(roll / 2), 0.0, 0.0, np.cos(roll / 2))
    return ((0.0, *straight), (0.005, *off), (0.01, *straight))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (
            {"motion": "path", "path": path(y=0.21)},
            r"the body is at y = 0.2100 m at 0.005 s, not at mid-width",
        ),
        (
            {"motion": "path", "path": path(roll=0.1)},
            "at 0.005 s the body is turned about another axis than y",
        ),
        ({"bed": replace(BED, arrangement="jittered")}, "use bed.arrangement=lattice or bed.mirrored=true"),
        ({"bed": replace(BED, walls=Walls(y="periodic"))}, "periodic in y"),
    ],
)
def test_what_is_not_symmetric_is_refused_with_the_reason(change, reason):
    scene = cut(**({"duration": 0.05, "frame_rate": 100.0} | change))
    with pytest.raises(SceneError, match=f"effects.symmetry needs .*{reason}"):
        Solver(scene, Effects(symmetry=True))
    assert asymmetry(scene) is not None


def test_what_is_symmetric():
    assert asymmetry(cut()) is None
    assert asymmetry(cut(motion="path", path=path(), duration=0.05)) is None
    assert asymmetry(Scene(bed=replace(BED, arrangement="jittered", mirrored=True))) is None
