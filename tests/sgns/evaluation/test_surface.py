import numpy as np
import pytest

from mpm_warp import Bed
from sgns.evaluation.surface import SurfaceGrid, height_map, particle_spacing, surface_grid


def lattice(nx=12, ny=8, nz=4, spacing=0.05):
    """A full bed whose top layer lies at z = 0, particles in the middle of their cells."""
    axes = [np.arange(nx) + 0.5, np.arange(ny) + 0.5, -np.arange(nz)]
    return spacing * np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def test_spacing_of_a_lattice():
    assert particle_spacing(lattice()) == pytest.approx(0.05, rel=1e-9)


def test_grid_covers_the_bed_with_columns_of_two_spacings():
    grid = surface_grid(lattice())
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


def test_flat_bed_is_flat_and_order_does_not_matter():
    bed = lattice()
    grid = surface_grid(bed)
    assert (height_map(bed, grid) == 0.0).all()
    shuffled = np.random.default_rng(0).permutation(bed)
    assert (height_map(shuffled, grid) == height_map(bed, grid)).all()


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
        return np.sqrt(
            np.mean((raised - height_map(start, grid)) ** 2)
        )  # a column without particles makes it NaN

    full = bed.filled[0]
    thinned = full[bed.stored]
    assert error(thinned) == pytest.approx(error(full), rel=0.05)
    assert particle_spacing(thinned) == pytest.approx(5 ** (1 / 3) * particle_spacing(full), rel=0.05)
