"""The solver against cases with known answers (physics that must hold whatever the parameters)."""

import math
from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from mpm_warp import Bed, Effects, Material, Scene, SceneError, Solver
from sgns_testing.scenes import block, cut
from sgns_testing.solvers import momenta

ELASTIC = Effects(yielding=False, rate_dependence=False, separation=False)


def test_free_fall_is_exact():
    """Symplectic Euler: after n steps v = -g n dt and the drop is g dt^2 n (n + 1) / 2."""
    scene = block(gravity=9.81)
    solver = Solver(scene, precision="float64")
    start = solver.particles.position.numpy().copy()
    for _ in solver.frames():
        pass
    n = (scene.frame_count - 1) * solver.substeps_per_frame
    dt = solver.time_step
    np.testing.assert_allclose(solver.particles.velocity.numpy()[:, 2], -9.81 * n * dt, rtol=1e-12)
    drop = solver.particles.position.numpy() - start
    np.testing.assert_allclose(drop[:, 2], -9.81 * dt**2 * n * (n + 1) / 2, rtol=1e-12)
    np.testing.assert_allclose(drop[:, :2], 0.0, atol=1e-15)


@pytest.mark.parametrize("effects", [ELASTIC, Effects()])
def test_momentum_is_conserved(effects):
    """A free block thrown about: linear and (APIC) angular momentum to round-off."""
    solver = Solver(block(remap_time=0.0, velocity_memory=1e-9), effects, precision="float64")
    rng = np.random.default_rng(0)
    x = solver.particles.position.numpy()
    turning = np.cross([3.0, -2.0, 5.0], x - x.mean(axis=0)) + np.array([0.3, 0.1, -0.2])
    solver.particles.velocity.assign(turning + 0.2 * rng.normal(size=turning.shape))
    before = momenta(solver)
    for _ in solver.frames():
        pass
    after = momenta(solver)
    size = solver.grid.particle_mass * np.abs(solver.particles.velocity.numpy()).sum()
    np.testing.assert_allclose(after[0], before[0], atol=1e-12 * size)
    np.testing.assert_allclose(after[1], before[1], atol=1e-12 * size)
    assert np.linalg.norm(before[1]) > 1e-3 * size * 0.1  # there was something to conserve


def test_a_column_that_is_let_go():
    """Elastic soil from the stress-free state, in the middle of a wide bin: it comes back after 4 L / c_p with
    c_p^2 = (K + 4 G / 3) / rho; in the mean it is at rest, sunk by rho g (L h - h^2 / 2) / (K + 4 G / 3) at height h,
    with K0 = nu / (1 - nu)."""
    bed = Bed(size=(0.72, 0.72, 0.1), spacing=0.01, initial_stress="none", headroom=0.05)
    scene = Scene(bed=bed, duration=0.018, frame_rate=3000.0, courant=0.4)
    solver, material = Solver(scene, ELASTIC), scene.material
    start = scene.initial_positions()
    middle = np.all(np.abs(start[:, :2] - 0.36) < 0.03, axis=1)
    heights = start[middle, 2] + 0.1
    layers = np.unique(heights.round(6))
    sink, stress = [], []
    for _ in solver.frames():
        now = solver.particles.position.numpy()[middle, 2] + 0.1 - heights
        sink.append([now[np.isclose(heights, h, atol=1e-5)].mean() for h in layers])
        e, ln_j = (a.numpy()[middle] for a in (solver.particles.elastic_strain, solver.particles.log_volume))
        volumetric = material.bulk_modulus * ln_j
        stress.append([np.mean(2 * material.shear_modulus * e[:, i] + volumetric) for i in (0, 2)])
    sink, stress, cycle = np.array(sink), np.array(stress), 4 * 0.1 / material.wave_speed
    back = 10 + int(np.argmax(sink[10:, -1]))  # the highest point after the start is the first return
    assert scene.times()[back] == pytest.approx(cycle, rel=0.05)
    period = slice(0, round(cycle * scene.frame_rate))
    stiffness = material.wave_speed**2 * material.bulk_density
    exact = -material.bulk_density * scene.gravity * (0.1 * layers - layers**2 / 2) / stiffness
    np.testing.assert_allclose(sink[period].mean(axis=0), exact, rtol=0.06)
    ratio = stress[period, 0].mean() / stress[period, 1].mean()
    assert ratio == pytest.approx(material.lateral_stress_ratio, rel=0.02)


@pytest.mark.parametrize("initial_stress", ["geostatic", "k0"])
def test_bed_in_balance_stays_still(initial_stress):
    """No settling spike, no creep."""
    bed = replace(cut().bed, initial_stress=initial_stress)
    scene = cut(bed=bed, motion="rest", clearance=0.05, duration=0.5)
    frame = list(Solver(scene).frames())[-1]
    assert np.abs(frame.position - scene.initial_positions()).max() < 2e-4
    assert np.abs(frame.velocity).max() < 0.01
    assert np.linalg.norm(frame.force) == 0.0


def diagonal_path(dy: float, shift: float = 0.0, spin: float = 0.0):
    """A plate that starts in the soil, close to the particles in front, and moves along x and y."""
    rows = []
    for t in (0.0, 0.02):
        angle = 0.5 * spin * t
        rows.append([t, 0.2028 + 0.3 * t + shift, 0.2 + dy * t, 0.04, 0, 0, math.sin(angle), math.cos(angle)])
    return tuple(tuple(r) for r in rows)


def last_frame(scene, precision="float64", effects=None):
    return list(Solver(scene, effects, precision=precision).frames())[-1]


@pytest.mark.parametrize(
    ("duration", "frame_rate", "one", "other", "force", "torque"),
    [
        # Mirrored in y: F_x, F_z and T_y stay, F_y, T_x and T_z change sign.
        (0.02, 100.0, diagonal_path(0.2, spin=1.0), diagonal_path(-0.2, spin=-1.0), [1, -1, 1], [-1, 1, -1]),
        # Shifted by three cells, before a wave can reach a wall: nothing changes.
        (0.004, 1000.0, diagonal_path(0.1), diagonal_path(0.1, shift=0.06), 1, 1),
    ],
    ids=["mirrored", "shifted"],
)
def test_the_same_cut_elsewhere(duration, frame_rate, one, other, force, torque):
    first, second = (
        last_frame(cut(path=path, motion="path", duration=duration, frame_rate=frame_rate))
        for path in (one, other)
    )
    size = np.linalg.norm(first.force)
    assert size > 1.0 and abs(first.force[1]) > 0.01 * size
    np.testing.assert_allclose(second.force, first.force * force, atol=1e-8 * size)
    np.testing.assert_allclose(second.torque, first.torque * torque, atol=1e-8 * size)


def test_a_plate_at_constant_depth():
    """4 cm deep over six cells, 10 frames for each: the draft does not come and go with the cells, and no particle's
    centre gets deeper into the plate than the contact margin and a tenth of a cell."""
    path = ((0.0, 0.10, 0.2, 0.06, 0, 0, 0, 1), (0.6, 0.22, 0.2, 0.06, 0, 0, 0, 1))
    scene = cut(motion="path", path=path, duration=0.6, frame_rate=100.0)
    frames = list(Solver(scene).frames())[20:]
    draft = -np.array([f.force[0] for f in frames])
    smooth = np.convolve(draft, np.ones(10) / 10, mode="valid")
    swing = draft[5 : 5 + len(smooth)] - smooth
    assert smooth.min() > 0.0
    assert swing.std() < 0.15 * smooth.mean()
    core = scene.blade.half_size - 0.6 * scene.bed.spacing
    for frame in frames[::10]:
        assert not np.all(np.abs(frame.position - frame.body_pose[:3]) < core, axis=1).any()


@pytest.mark.parametrize("effects", [Effects(), Effects(fluidity=True, nonlocality=True)])
def test_precisions_agree(effects):
    scene = cut(duration=0.1, material=Material(grain_diameter=5e-3))
    one, two = (last_frame(scene, p, effects) for p in ("float32", "float64"))
    np.testing.assert_allclose(one.force, two.force, atol=0.01 * np.linalg.norm(two.force))
    assert np.abs(one.position - two.position).max() < 1e-4


@pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device")
@pytest.mark.parametrize("effects", [Effects(), Effects(fluidity=True, nonlocality=True)])
def test_cuda_agrees_with_the_cpu(effects):
    one, two = (list(Solver(cut(duration=0.1), effects, d).frames())[-1] for d in ("cpu", "cuda"))
    np.testing.assert_allclose(one.force, two.force, atol=0.01 * np.linalg.norm(one.force))
    assert np.abs(one.position - two.position).max() < 1e-4


def test_step_follows_the_wave_speed():
    slow, fast = (Solver(cut(material=Material(youngs_modulus=e))) for e in (1e6, 4e6))
    assert fast.substeps_per_frame == pytest.approx(2 * slow.substeps_per_frame, abs=2)


@pytest.mark.parametrize(("key", "value"), [("device", "tpu"), ("precision", "float16")])
def test_unknown_device_or_precision(key, value):
    with pytest.raises(SceneError, match=f"{key} is '{value}'; allowed"):
        Solver(cut(), **{key: value})


def test_torque_is_about_the_centre_of_mass():
    """Force and torque of a thin slice of contact: T = r x F for soil on one side only."""
    frame = last_frame(cut(motion="path", path=diagonal_path(0.0), duration=0.02, frame_rate=100.0))
    # The soil pushes below the centre of mass against the motion: T_y = r_z F_x - r_x F_z > 0 with r_z < 0.
    assert frame.force[0] < 0.0
    assert frame.torque[1] > 0.0
    assert abs(frame.torque[1]) < 0.2 * np.linalg.norm(frame.force)  # the arm is shorter than the plate


def test_impulse_on_the_body_is_the_soils_momentum():
    """A plate hits a free block: what the soil gains the body loses, and likewise the moments."""
    path = ((0.0, 0.08, 0.15, -0.15, 0, 0, 0, 1), (1.0, 1.08, 0.15, -0.15, 0, 0, 0, 1))
    free = block(duration=0.05)
    scene = cut(bed=free.bed, gravity=0.0, motion="path", path=path, duration=0.05, frame_rate=200.0)
    solver = Solver(scene, precision="float64")
    impulse = sum(f.force for f in solver.frames()) / scene.frame_rate
    gained, _ = momenta(solver)
    assert gained[0] > 1e-3
    np.testing.assert_allclose(impulse, -gained, atol=1e-12 * abs(gained[0]))
