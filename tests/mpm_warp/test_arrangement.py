"""Beds: full, inside, reproducible."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from mpm_warp import SceneError, arrange
from mpm_warp.arrangement import POISSON_RADIUS

SIZE = (0.2, 0.15, 0.07)


@pytest.mark.parametrize("kind", ["lattice", "jittered", "poisson"])
def test_particles_are_in_the_bin_and_reproducible(kind):
    points, volume = arrange(kind, SIZE, 0.01, seed=3)
    assert np.all(points >= [0, 0, -SIZE[2]])
    assert np.all(points <= [SIZE[0], SIZE[1], 0])
    assert volume > 0
    arrange.cache_clear()
    np.testing.assert_array_equal(points, arrange(kind, SIZE, 0.01, seed=3)[0])


@pytest.mark.parametrize("kind", ["lattice", "jittered"])
def test_a_full_bed_has_the_bins_volume(kind):
    points, volume = arrange(kind, SIZE, 0.013, seed=0)
    assert len(points) * volume == pytest.approx(np.prod(SIZE), rel=1e-12)


def test_the_papers_bed_has_29700_particles():
    assert len(arrange("lattice", (0.8, 0.6, 0.15), 0.8 / 60, 0)[0]) == 29700


def test_poisson_points_keep_their_distance_and_are_as_dense_as_the_published():
    """The published bed holds 0.797 of a full one; the share near walls and surface is the same as inside."""
    spacing = 0.01
    points, volume = arrange("poisson", SIZE, spacing, seed=0)
    nearest = cKDTree(points).query(points, k=2)[0][:, 1]
    assert nearest.min() >= POISSON_RADIUS * spacing * (1 - 1e-9)
    assert len(points) * volume / np.prod(SIZE) == pytest.approx(0.797, abs=0.02)
    top = np.mean(points[:, 2] > -2 * spacing) / (2 * spacing / SIZE[2])
    assert top == pytest.approx(1.0, abs=0.06)


def test_unknown_arrangement():
    with pytest.raises(SceneError, match="allowed: lattice, jittered, poisson"):
        arrange("heap", SIZE, 0.01, 0)
