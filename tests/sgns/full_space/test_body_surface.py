"""Body nodes lie on the surface, none twice, no hole wider than asked."""

from __future__ import annotations

import numpy as np
import pytest

from sgns.full_space.body_surface import box_surface


@pytest.mark.parametrize("spacing", [0.015, 0.04, 1.0])
def test_the_surface_is_covered(spacing) -> None:
    half = np.array([0.021, 0.10, 0.06])
    points = box_surface(half, spacing)
    np.testing.assert_allclose(np.max(np.abs(points) / half, axis=1), 1.0)
    assert len(np.unique(points.round(9), axis=0)) == len(points)
    for axis in range(3):
        places = np.unique(points[:, axis].round(9))
        assert places[[0, -1]] == pytest.approx([-half[axis], half[axis]])
        assert np.diff(places).max() <= spacing + 1e-9 or len(places) == 2
    # Wherever a point sits on the surface, a node is within half a cell's diagonal.
    rng = np.random.default_rng(0)
    probes = rng.uniform(-half, half, (300, 3))
    axis = rng.integers(3, size=300)
    probes[np.arange(300), axis] = np.sign(probes[np.arange(300), axis]) * half[axis]
    nearest = np.linalg.norm(probes[:, None] - points, axis=-1).min(axis=1)
    assert nearest.max() <= min(spacing, 2 * half.max()) / np.sqrt(2) + 1e-9


def test_a_coarse_spacing_leaves_the_corners() -> None:
    assert len(box_surface(np.ones(3), 10.0)) == 8
