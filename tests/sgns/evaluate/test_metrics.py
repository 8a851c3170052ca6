import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sgns.config import UserError
from sgns.data import run as chunks
from sgns.data.surface import surface_grid
from sgns.evaluate.metrics import (
    PositionErrors,
    VectorErrors,
    body_errors,
    mean_prediction,
    position_errors,
    rms_mm,
    skill,
)
from sgns.reduction.basis import Basis


def lattice(nx=12, ny=8, nz=4, spacing=0.05):
    """A full bed whose top layer lies at z = 0, particles in the middle of their cells."""
    axes = [np.arange(nx) + 0.5, np.arange(ny) + 0.5, -np.arange(nz)]
    return spacing * np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def in_memory(positions):
    """A run of these positions."""
    values = np.asarray(positions, dtype=np.float32)
    return SimpleNamespace(
        positions=lambda frames: values[frames],
        frame_count=values.shape[0],
        particle_count=values.shape[1],
        time=np.arange(len(values)) / 60.0,
        arrangement_hash="same",
        path="run.h5",
    )


def make_basis(n=7, r=2, seed=0):
    rng = np.random.default_rng(seed)
    modes = np.linalg.qr(rng.normal(size=(n, r)))[0]
    return Basis(
        mean=torch.from_numpy(rng.normal(size=(n, 3))),
        modes=torch.from_numpy(modes),
        eigenvalues=torch.arange(r, 0, -1, dtype=torch.float64),
        total_variance=float(r * (r + 1) / 2),
        displacement_variance=1.0,
        centring="particle_axis",
    )


def compared(truth, prediction, basis=None, history=2):
    grid = surface_grid(truth[0])
    truth, prediction = in_memory(truth), in_memory(prediction)
    return position_errors(truth, prediction, basis or make_basis(truth.particle_count), history, grid)


def random_walk(frames=9, n=7, seed=1, size=0.1):
    return np.cumsum(np.random.default_rng(seed).normal(0.0, size, (frames, n, 3)), axis=0)


def test_position_errors_by_hand():
    # One particle that goes 0, 1, 3, 6 along x; the prediction stays at 1; two frames are given.
    truth = np.zeros((4, 1, 3))
    truth[:, 0, 0] = [0, 1, 3, 6]
    prediction = np.zeros((4, 1, 3))
    prediction[:, 0, 0] = [0, 1, 1, 1]
    basis = make_basis(n=1, r=1)
    errors = compared(truth, prediction, basis)
    assert errors.frozen == pytest.approx([4 / 3, 25 / 3])
    assert errors.total == pytest.approx([4 / 3, 25 / 3])
    assert errors.constant_velocity == pytest.approx([1 / 3, 9 / 3])  # goes on to 2 and 3
    assert errors.reduction == pytest.approx([0.0, 0.0], abs=1e-12)  # one mode holds one particle
    assert errors.network == pytest.approx(errors.total)
    assert errors.mse("total") == pytest.approx(29 / 6)
    assert rms_mm(errors.mse("total")) == pytest.approx(1e3 * math.sqrt(29 / 6))
    assert skill_of(errors, "constant_velocity") == pytest.approx(1 - 29 / 10)
    assert errors.time == pytest.approx([2 / 60, 3 / 60])


def skill_of(errors, baseline="frozen"):
    return skill([errors.mse("total")], [errors.mse(baseline)])


def test_skill_of_perfect_is_one_of_frozen_zero_and_of_several_runs_that_of_sums():
    truth = random_walk()
    assert skill_of(compared(truth, truth)) == 1.0
    frozen = truth.copy()
    frozen[2:] = frozen[1]
    assert skill_of(compared(truth, frozen)) == pytest.approx(0.0, abs=1e-12)
    assert skill([1.0, 3.0], [4.0, 4.0]) == pytest.approx(0.5)
    assert skill([5.0], [4.0]) == pytest.approx(-0.25)
    assert math.isnan(skill([0.0], [0.0]))


def test_history_counts_in_no_metric():
    truth, prediction = random_walk(), random_walk(seed=2)
    expected = compared(truth, prediction)
    prediction[:2] += 100.0
    changed = compared(truth, prediction)
    assert changed.mse("total") == expected.mse("total")
    assert len(changed.total) == len(truth) - 2


def test_latent_formula_equals_full_space():
    truth, basis = random_walk(), make_basis()
    latent = torch.from_numpy(np.random.default_rng(3).normal(size=(9, 2, 3)))
    prediction = basis.inverse(latent).numpy()
    errors = compared(truth, prediction, basis)
    projected = basis.inverse(basis.transform(torch.from_numpy(truth.astype(np.float32)).double())).numpy()
    full = np.mean((prediction.astype(np.float32) - projected)[2:] ** 2, axis=(1, 2))
    assert errors.network == pytest.approx(full, rel=1e-5)
    # The residual of the reduction stands at right angles to the subspace.
    assert errors.total == pytest.approx(errors.network + errors.reduction, rel=1e-5)
    assert errors.particles.reduction.shape == errors.particles.network.shape == (7,)
    assert errors.particles.reduction.mean() == pytest.approx(errors.mse("reduction"))
    assert errors.particles.network.mean() == pytest.approx(errors.mse("network"), rel=1e-5)


def test_chunks_of_frames_do_not_change_anything(monkeypatch):
    truth, prediction = random_walk(), random_walk(seed=2)
    whole = compared(truth, prediction)
    monkeypatch.setattr(chunks, "CHUNK_BYTES", 1.0)
    pieces = compared(truth, prediction)
    for name in ("reduction", "network", "total", "frozen", "constant_velocity", "surface"):
        assert getattr(pieces, name) == pytest.approx(getattr(whole, name), rel=1e-12)
    assert pieces.particles.reduction == pytest.approx(whole.particles.reduction, rel=1e-12)
    assert pieces.particles.network == pytest.approx(whole.particles.network, rel=1e-12)


def test_error_of_one_particle_by_hand():
    basis = make_basis()
    inside = basis.inverse(basis.transform(torch.from_numpy(random_walk()))).numpy()
    off = inside.copy()
    off[2:, 3, 1] += 0.3
    particles = compared(inside, off, basis).particles
    assert particles.network[3] == pytest.approx(0.3**2 / 3, rel=1e-4)
    assert np.delete(particles.network, 3) == pytest.approx(0.0, abs=1e-12)
    assert particles.reduction == pytest.approx(0.0, abs=1e-12)


def test_surface_error_of_a_raised_bed():
    bed = np.stack(np.meshgrid(np.arange(6.0), np.arange(6.0), np.arange(3.0)), axis=-1).reshape(1, -1, 3)
    truth = np.repeat(bed, 4, axis=0)
    prediction = truth.copy()
    prediction[2:, :, 2] += 0.01
    errors = compared(truth, prediction, make_basis(n=truth.shape[1]))
    assert rms_mm(errors.mse("surface")) == pytest.approx(10.0, rel=1e-5)
    assert errors.mse("surface_frozen") == 0.0


def test_one_frame_of_history_has_no_velocity():
    truth = random_walk()
    errors = compared(truth, truth, history=1)
    assert errors.constant_velocity == pytest.approx(errors.frozen)


def test_a_run_of_nothing_but_its_history_is_refused():
    truth = random_walk()
    with pytest.raises(UserError, match="nothing is left to compare"):
        compared(truth, truth, history=9)


def test_force_metrics_by_hand():
    truth = np.array([[-100.0, 0.0, 50.0], [-300.0, 0.0, -50.0]])
    prediction = np.array([[-110.0, 1.0, 50.0], [-330.0, -1.0, -30.0]])
    errors = VectorErrors.compare(truth, prediction)
    assert errors.mae == pytest.approx([20.0, 1.0, 10.0])
    assert errors.nrmse[0] == pytest.approx(0.1)
    assert errors.nrmse[2] == pytest.approx(math.sqrt(200 / 2500))
    assert math.isnan(errors.nrmse[1])  # zero by symmetry: a ratio says nothing
    assert errors.mpe[0] == pytest.approx(10.0)
    assert math.isnan(errors.mpe[1]) and math.isnan(errors.mpe[2])  # means are zero
    assert errors.overall_nrmse == pytest.approx(math.sqrt((100 + 900 + 2 + 400) / (1e4 + 9e4 + 5e3)))


def test_sign_of_mpe_does_not_depend_on_the_sign_of_the_force():
    truth = np.full((5, 3), [-10.0, 8.0, 10.0])
    high, low = (VectorErrors.compare(truth, factor * truth) for factor in (1.2, 0.9))
    assert high.mpe == pytest.approx(20.0) and low.mpe == pytest.approx(-10.0)
    assert (high + low).mpe == pytest.approx(5.0)  # cancels
    assert (high + low).absolute_mpe == pytest.approx(15.0)  # does not


def test_body_errors_by_hand():
    poses = np.zeros((5, 7))
    moved = poses.copy()
    moved[0, 0] = 9.0  # within the history: does not count
    moved[2:, 2] = [-0.003, 0.003, -0.003]
    moved[2:, 1] = 0.004
    wheel = {"kind": "wheel"}
    errors = body_errors(SimpleNamespace(pose=poses, scene=wheel), moved, 2)
    assert errors.mse == pytest.approx(0.005**2)
    assert errors.sinkage_mae == pytest.approx(0.003)
    blade = body_errors(SimpleNamespace(pose=poses, scene={}), poses, 2)
    assert blade.mse == 0.0 and math.isnan(blade.sinkage_mae)


def test_sums_of_runs_equal_the_runs_joined():
    rng = np.random.default_rng(0)
    truth, prediction = rng.normal(size=(2, 10, 3))
    parts = VectorErrors.compare(truth[:4], prediction[:4]) + VectorErrors.compare(truth[4:], prediction[4:])
    whole = VectorErrors.compare(truth, prediction)
    assert parts.samples == whole.samples == 10
    for name in ("mae", "nrmse", "mpe", "overall_nrmse"):
        assert getattr(parts, name) == pytest.approx(getattr(whole, name), nan_ok=True)


def test_forces_of_zero_have_no_relative_error():
    errors = VectorErrors.compare(np.zeros((3, 3)), np.ones((3, 3)))
    assert math.isnan(errors.overall_nrmse)
    for relative in (errors.nrmse, errors.mpe, errors.absolute_mpe):
        assert np.isnan(relative).all()


def test_constant_prediction_and_training_mean():
    histories = [np.array([[9.0, 9, 9], [1, 2, 3]]), np.array([[9.0, 9, 9], [3, 4, 5], [5, 6, 7]])]
    mean = mean_prediction(histories, history=1)
    assert mean == pytest.approx([3.0, 4.0, 5.0])
    errors = VectorErrors.compare(np.array([[1.0, 2, 3], [3, 4, 5]]), mean)
    assert errors.mae == pytest.approx([1.0, 1.0, 1.0])
    assert rms_mm(PositionErrors(*[np.zeros(3)] * 8).mse("total")) == 0.0
