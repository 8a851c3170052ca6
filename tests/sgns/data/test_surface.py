"""The surface of the soil: known beds, hills and holes."""

import numpy as np
import pytest

from mpm_warp import Bed, Scene
from sgns.config import UserError
from sgns.data.surface import SurfaceGrid, height_map, particle_spacing, soil_surface, surface_grid


def lattice(nx=12, ny=8, nz=4, spacing=0.05):
    """A full bed whose top layer lies at z = 0, particles in the middle of their cells."""
    axes = [np.arange(nx) + 0.5, np.arange(ny) + 0.5, -np.arange(nz)]
    return spacing * np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def test_grid_covers_the_bed_with_columns_of_two_spacings():
    grid = surface_grid(lattice())
    assert particle_spacing(lattice()) == pytest.approx(0.05, rel=1e-9)
    assert grid.shape == (6, 4)
    assert grid.x_edges[[0, -1]] == pytest.approx([0.0, 0.6])
    assert grid.y_edges[[0, -1]] == pytest.approx([0.0, 0.4])
    assert grid.x_centres[0] == pytest.approx(0.05)


def test_known_bump():
    bed = lattice()
    bump = 0.03 * np.exp(-((bed[:, 0] - 0.325) ** 2) / 0.01)
    raised = bed + np.stack([0 * bump, 0 * bump, bump], axis=1)
    grid = surface_grid(bed)
    heights = height_map(raised, grid)
    # Every column's height is that of the higher of its two rows of top particles.
    rows = np.sort(np.unique(bed[:, 0])).reshape(-1, 2)
    expected = 0.03 * np.exp(-((rows - 0.325) ** 2) / 0.01).max(axis=1)
    assert heights == pytest.approx(np.repeat(expected[:, None], 4, axis=1))
    shuffled = np.random.default_rng(0).permutation(raised)
    assert (height_map(shuffled, grid) == heights).all()
    assert (height_map(bed, grid) == 0.0).all()


def test_empty_column_is_nan_and_outside_counts_for_the_border():
    grid = SurfaceGrid(np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0]))
    heights = height_map(np.array([[-5.0, 9.0, 0.3]]), grid)
    assert heights[0, 0] == pytest.approx(0.3)
    assert np.isnan(heights[1, 0])


def test_thin_and_tiny_beds_have_a_grid():
    assert surface_grid(np.zeros((1, 3))).shape == (1, 1)
    line = np.stack([np.linspace(0, 1, 11), np.zeros(11), np.zeros(11)], axis=1)
    assert surface_grid(line).shape[1] == 1


@pytest.mark.parametrize("arrangement", ["lattice", "jittered"])
def test_surface_error_of_a_thinned_bed_is_that_of_the_bed(arrangement):
    bed = Bed(store_every=5, arrangement=arrangement)

    def error(start):
        hill = 0.03 * np.exp(
            -((start[:, 0] - 0.4) ** 2 + (start[:, 1] - 0.3) ** 2) / 0.01 + start[:, 2] / 0.05
        )
        grid = surface_grid(start)
        raised = height_map(start + np.stack([0 * hill, 0 * hill, hill], axis=1), grid)
        # A column without particles makes it NaN.
        return np.sqrt(np.mean((raised - height_map(start, grid)) ** 2))

    full = bed.filled[0]
    thinned = full[Scene(bed=bed).stored]
    assert error(thinned) == pytest.approx(error(full), rel=0.05)
    assert particle_spacing(thinned) == pytest.approx(5 ** (1 / 3) * particle_spacing(full), rel=0.05)


@pytest.mark.parametrize("change", [{}, {"particles_per_cell": 4.0}, {"store_every": 5}], ids=str)
def test_a_bed_at_rest_is_flat_at_zero_and_a_hill_has_its_height(change):
    scene = Scene(bed=Bed(**change))
    start = scene.filled[0][scene.stored]
    x, y, z = soil_surface(start, scene.to_dict())
    lx, ly, _ = scene.bed.size
    assert z.shape == (len(x), len(y))
    assert (x[0] + x[-1], y[0] + y[-1]) == pytest.approx((lx, ly))
    spacing = scene.bed.particle_spacing
    if scene.bed.store_every == 1:
        assert z == pytest.approx(0.0, abs=0.05 * spacing)
    else:  # some columns miss the top layer
        assert abs(np.mean(z)) < spacing and z.max() <= spacing
    raised = start.copy()
    raised[:, 2] += 0.02 * (raised[:, 0] > 0.5 * lx)
    risen = soil_surface(raised, scene.to_dict()).z - z
    assert risen[x < 0.45 * lx] == pytest.approx(0.0, abs=1e-9)
    assert risen[x > 0.55 * lx] == pytest.approx(0.02)


def test_the_surface_covers_the_bin_not_only_where_soil_was(tmp_path):
    scene = Scene()
    x, _, z = soil_surface(np.array([[0.01, 0.01, -0.1], [0.79, 0.59, 0.1]]), scene.to_dict())
    assert np.isfinite(z).sum() == 2 and x[-1] > 0.75
    spacing = scene.bed.particle_spacing
    assert (z[0, 0], z[-1, -1]) == pytest.approx((-0.1 + spacing / 2, 0.1 + spacing / 2))


def test_a_scene_without_a_bed_has_no_columns():
    for scene in ({}, {"bed": {"size": [0, 0, 0]}}):
        with pytest.raises(UserError, match="how its bed is filled"):
            soil_surface(np.zeros((1, 3)), scene)
