"""What tests look at inside a solver."""

from dataclasses import astuple
from pathlib import Path

import numpy as np
import warp as wp


def momenta(solver):
    """Linear and angular momentum of the particles, the affine part (C dx^2 / 4) included."""
    mass = solver.grid.particle_mass
    soil = solver.particles
    x, v, c = soil.position.numpy(), soil.velocity.numpy(), soil.velocity_gradient.numpy()
    spin = np.stack([c[:, 2, 1] - c[:, 1, 2], c[:, 0, 2] - c[:, 2, 0], c[:, 1, 0] - c[:, 0, 1]], axis=-1)
    angular = mass * (np.cross(x, v) + spin * solver.scene.bed.spacing**2 / 4)
    return mass * v.sum(axis=0), angular.sum(axis=0)


def assert_same_frames(found, wanted):
    """Two sequences of frames are equal bit by bit."""
    for one, two in zip(found, wanted, strict=True):
        for a, b in zip(astuple(one), astuple(two), strict=True):
            np.testing.assert_array_equal(a, b)


def change(array, values, at=...):
    """Write into a solver's array, from which `numpy()` may give a copy."""
    found = array.numpy().copy()
    found[at] = values
    array.assign(found)


def launches(solver):
    """At a remap, in a step and at its end."""
    steps = solver._steps
    return [*solver._remap.begin, *steps.begin, *steps.step, *steps.end]


def compiled_source(launch):
    """What Warp compiled for a kernel with a module of its own, from its cache."""
    assert launch.recorded
    (newest, *_) = sorted(
        Path(wp.config.kernel_cache_dir).glob(f"wp_{launch.kernel.alone.module.name}_*/*.cpp"),
        key=lambda file: file.stat().st_mtime,
        reverse=True,
    )
    return newest.read_text()
