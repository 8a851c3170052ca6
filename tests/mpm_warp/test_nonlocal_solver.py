"""Fluidity and nonlocality in a whole solver: what is off costs nothing, precisions, symmetry, seams, inertness."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from mpm_warp import Bed, Effects, Material, Scene, Solver, SolverStopped, Walls
from sgns_testing.scenes import cut
from sgns_testing.solvers import compiled_source, launches

STEADY, DYNAMIC = Effects(nonlocality=True), Effects(fluidity=True, nonlocality=True)
PRESSURE = 1000.0


@pytest.mark.parametrize("at_walls", ["free", "zero"])
@pytest.mark.parametrize("effects", [STEADY, DYNAMIC])
def test_a_periodic_seam_is_nowhere(effects, at_walls):
    """Random flow, and the same flow moved on by 3 and 2 cells through the seams: the same excess on each particle."""
    bed = Bed(
        size=(0.06, 0.08, 0.06),
        spacing=0.01,
        headroom=0.02,
        initial_stress="none",
        walls=Walls("periodic", "periodic"),
    )
    material = Material(grain_diameter=0.02, fluidity_at_walls=at_walls)
    scene = Scene(bed=bed, material=material, gravity=0.0, duration=0.1)
    cells = (6, 8, 6)
    # The particles of the lattice in the order of their cells.
    order = np.lexsort(np.round(scene.initial_positions() / 0.01 - 0.5).astype(int).T[::-1])
    mu = np.random.default_rng(0).uniform(0.3, 0.94, cells)

    def excess(moved):
        solver = Solver(scene, effects, precision="float64")
        e, flow = np.zeros((len(order), 6)), np.roll(mu, moved, axis=(0, 1)).ravel()
        e[order, 4] = flow * PRESSURE / (2.0 * material.shear_modulus)
        solver.particles.elastic_strain.assign(e)
        solver.particles.log_volume.fill_(-PRESSURE / material.bulk_modulus)
        if effects.fluidity:
            g = np.zeros(len(order))
            g[order] = 10.0 * flow
            solver.particles.fluidity.assign(g)
        for launch in (*solver._remap.begin, *solver._steps.begin, *solver._steps.step):
            launch.launch()
        found = solver.particles.excess.numpy()[order].reshape(cells)
        return np.roll(found, [-m for m in moved], axis=(0, 1))

    still = excess((0, 0))
    assert still.std() > 0.05  # there is something to be moved
    np.testing.assert_allclose(excess((3, 2)), still, atol=1e-9 * np.abs(still).max())


def test_what_is_off_costs_nothing():
    """No array and no instruction of an effect that is off; its arrays when it is on."""
    plain, fluid = Solver(cut(duration=0.05)), Solver(cut(duration=0.05), DYNAMIC)
    assert [launch.kernel.name for launch in launches(plain)] == [
        "to_grid", "begin", "scatter", "step", "gather", "material", "from_grid"
    ]  # fmt: skip
    assert len(fluid._steps.step) > len(plain._steps.step)
    assert len(plain.particles.fluidity) == 0
    assert fluid.particles.fluidity.shape == (fluid.particle_count,)
    assert "fluidity_step" in compiled_source(fluid._steps.step[-1])
    for launch in launches(plain):
        found = compiled_source(launch)
        assert (
            "fluidity_step" not in found
            and "friction_with_excess" not in found
            and "coefficients" not in found
        )


@pytest.mark.parametrize("effects", [STEADY, DYNAMIC, Effects(fluidity=True)])
def test_precisions_agree_in_a_cut(effects):
    scene = cut(duration=0.1, material=Material(grain_diameter=5e-3))
    one, two = (list(Solver(scene, effects, precision=p).frames())[-1] for p in ("float32", "float64"))
    assert np.linalg.norm(two.force) > 1.0
    np.testing.assert_allclose(one.force, two.force, atol=0.02 * np.linalg.norm(two.force))
    assert np.abs(one.position - two.position).max() < 1e-4


def test_stops_where_the_fluidity_is_no_number():
    """Its soil would be elastic and look sound."""
    solver = Solver(cut(duration=0.1, material=Material(grain_diameter=5e-3)), STEADY)
    frames = solver.frames()
    next(frames), next(frames)
    field = solver._cooperative_field.numpy().copy()
    field[:, 3] = np.nan  # which the sweeps of the steady form go on from
    solver._cooperative_field.assign(field)
    with pytest.raises(SolverStopped, match="its fluidity is not finite"):
        list(frames)


def test_inert_nonlocality_leaves_a_cut_as_it_is():
    """The paper's sand on a 2 cm grid: A d is a hundred and forty times smaller. The RMS of all particles is judged: a
    single one at the edge of the heap may go another way after the smallest change."""
    one, two = (list(Solver(cut(), e).frames())[-1] for e in (Effects(), STEADY))
    np.testing.assert_allclose(two.force, one.force, atol=0.01 * np.linalg.norm(one.force))
    assert np.sqrt(np.mean((one.position - two.position) ** 2)) < 1e-4


@pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device")
def test_cuda_agrees_with_the_cpu():
    one, two = (list(Solver(cut(duration=0.1), DYNAMIC, device=d).frames())[-1] for d in ("cpu", "cuda"))
    np.testing.assert_allclose(one.force, two.force, atol=0.01 * np.linalg.norm(one.force))


@pytest.mark.parametrize("effects", [STEADY, DYNAMIC])
@pytest.mark.parametrize("width", [0.4, 0.42])  # a layer of nodes on the plane; one of particles
def test_half_is_whole(effects, width):
    """With mirror symmetry half the bed gives the same force and motion to round-off."""
    scene = cut(
        bed=Bed(size=(0.48, width, 0.16), spacing=0.02, headroom=0.12),
        material=Material(grain_diameter=5e-3),
        duration=0.1,
        depth=0.08,
        clearance=0.0,
        remap_time=1e-3,
    )
    whole, half = (
        list(Solver(scene, replace(effects, symmetry=on), precision="float64").frames())[-1]
        for on in (False, True)
    )
    assert np.linalg.norm(whole.force) > 1.0
    np.testing.assert_allclose(half.force, whole.force, atol=1e-10 * np.linalg.norm(whole.force))
    np.testing.assert_allclose(half.position, whole.position, atol=1e-9)
