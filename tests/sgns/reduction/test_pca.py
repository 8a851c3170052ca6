"""IncrementalPCA against explicit decompositions of the whole data."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sgns.config import UserError
from sgns.reduction.basis import CENTRINGS
from sgns.reduction.pca import IncrementalPCA


def soil(frames=40, particles=30, rank=None, decay=0.8, seed=0, offset=0.0) -> np.ndarray:
    """Moving soil (T, n, 3): a random layout plus motion in `rank` directions of falling size."""
    rng = np.random.default_rng(seed)
    rank = min(particles, 3 * frames) if rank is None else rank
    modes = np.linalg.qr(rng.normal(size=(particles, particles)))[0][:, :rank]
    size = decay ** np.arange(rank)[:, None]
    return offset + rng.uniform(size=(particles, 3)) + modes @ (size * rng.normal(size=(frames, rank, 3)))


def fit(positions, num_modes, batch=7, oversampling=None) -> IncrementalPCA:
    pca = IncrementalPCA(num_modes, oversampling)
    for start in range(0, len(positions), batch):
        pca.partial_fit(positions[start : start + batch])
    return pca


def centre(x, centring) -> np.ndarray:
    return {"scalar": x.mean(), "particle": x.mean((0, 2))[:, None], "particle_axis": x.mean(0)}[centring]


def stacked(positions, centring) -> np.ndarray:
    """The centred data matrix (3 T, n), rows (frame, axis), by the definition of each centring."""
    x = np.asarray(positions, dtype=np.float64)
    return (x - centre(x, centring)).transpose(0, 2, 1).reshape(-1, x.shape[1])


def exact(positions, centring) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues (n,) and modes (n, n) of the explicit covariance, falling."""
    rows = stacked(positions, centring)
    values, modes = np.linalg.eigh(rows.T @ rows / len(rows))
    return values[::-1], modes[:, ::-1]


def askew(modes: torch.Tensor) -> float:
    return float((modes.T @ modes - torch.eye(modes.shape[1], dtype=modes.dtype)).abs().max())


def largest_angle(a, b) -> float:
    """Sine of the largest angle between two subspaces with orthonormal columns."""
    a, b = np.asarray(a), np.asarray(b)
    return float(np.linalg.norm(a - b @ (b.T @ a), 2))


@pytest.mark.parametrize("centring", CENTRINGS)
@pytest.mark.parametrize("shape", [(40, 30), (5, 60), (1500, 6), (1, 12), (2, 1)])
def test_equals_the_explicit_decomposition(centring, shape):
    x = soil(*shape)
    pca = fit(x, num_modes=shape[1], oversampling=0)
    rank = pca.rank(centring)
    values, modes = exact(x, centring)
    assert rank == np.linalg.matrix_rank(stacked(x, centring))
    if rank == 0:
        return
    basis = pca.basis(centring, rank)
    np.testing.assert_allclose(basis.mean, centre(x, centring) + 0 * x[0], atol=1e-13)
    np.testing.assert_allclose(basis.eigenvalues, values[:rank], rtol=1e-9)
    np.testing.assert_allclose(np.abs(modes[:, :rank].T @ basis.modes.numpy()), np.eye(rank), atol=1e-6)
    assert basis.total_variance == pytest.approx(values.sum(), rel=1e-12)
    assert basis.displacement_variance == pytest.approx(exact(x, "particle_axis")[0].sum(), rel=1e-12)
    assert askew(basis.modes) < 1e-12


@pytest.mark.parametrize("centring", CENTRINGS)
def test_batch_size_changes_nothing(centring):
    x = soil(150, 50)
    whole = fit(x, 5, batch=150).basis(centring)
    for batch in (1, 13, 96):
        parts = fit(x, 5, batch).basis(centring)
        assert torch.equal(parts.modes, whole.modes)
        assert torch.equal(parts.eigenvalues, whole.eigenvalues)


def test_looking_does_not_disturb_the_stream():
    x = soil(100, 20)
    looked = IncrementalPCA(4)
    for frame in x:
        looked.partial_fit(frame[None])
        if looked.frame_count > 3:
            looked.basis("scalar")
    assert torch.equal(looked.basis().modes, fit(x, 4).basis().modes)
    assert looked.frame_count == 100


def test_modes_far_below_the_largest_are_resolved():
    # Amplitudes down to 1e-10 of the first: a plain Gram matrix is blind under 1e-8.
    x = soil(600, 40, rank=11, decay=0.1)
    values = np.linalg.svd(stacked(x, "particle_axis"), compute_uv=False)[:11] ** 2 / 1800
    basis = fit(x, 11, oversampling=0).basis()
    np.testing.assert_allclose(basis.eigenvalues.sqrt(), values**0.5, rtol=1e-3)
    assert askew(basis.modes) < 1e-12


@pytest.mark.parametrize("centring", CENTRINGS)
def test_residual_is_the_reconstruction_error(centring):
    x = soil(80, 25)
    basis = fit(x, 20, oversampling=5).basis(centring)
    for r in (1, 2, 5, 20):
        cut = basis.sliced(r)
        error = np.mean((cut.inverse(cut.transform(x)).numpy() - x) ** 2)
        for residual in (basis.residual_mse(r), cut.residual_mse(r), float(basis.residual_mse()[r - 1])):
            assert residual == pytest.approx(error, rel=1e-9)


def test_truncated_stream_keeps_the_leading_subspace_and_the_exact_total():
    x = soil(600, 150, decay=0.9, seed=3)
    values, modes = exact(x, "particle_axis")
    basis = fit(x, 8).basis()
    assert largest_angle(basis.modes, modes[:, :8]) < 0.05
    np.testing.assert_allclose(basis.eigenvalues, values[:8], rtol=1e-3)
    assert basis.total_variance == pytest.approx(values.sum(), rel=1e-12)
    error = np.mean((basis.inverse(basis.transform(x)).numpy() - x) ** 2)
    assert error == pytest.approx(values[8:].sum() / 150, rel=2e-3)
    # Dropped directions can only make the stated error too large.
    assert error <= basis.residual_mse(8) <= 1.02 * error


def drifting(frames=900, particles=120) -> np.ndarray:
    """Frames (T, n, 3) that follow each other slowly: few directions in any short stretch, many in all."""
    rng = np.random.default_rng(5)
    modes = np.linalg.qr(rng.normal(size=(particles, particles)))[0]
    time = np.arange(frames)[:, None, None] / 90
    size = 0.85 ** np.arange(particles)[:, None]
    waves = size * np.sin(time * rng.uniform(0.1, 1.0, (particles, 1)) + rng.uniform(0, 6, (particles, 3)))
    return rng.uniform(size=(particles, 3)) + modes @ waves


def test_thinned_blocks_lose_no_more_than_the_weakest_tracked_direction():
    x = drifting()
    pca = fit(x, 12, oversampling=6)
    assert pca._queued > 0  # blocks were thinned
    values, modes = exact(x, "particle_axis")
    basis = pca.basis()
    error = np.mean((basis.inverse(basis.transform(x)).numpy() - x) ** 2)
    assert largest_angle(basis.modes[:, :6], modes[:, :6]) < 1e-3
    assert (values[:12] - basis.eigenvalues.numpy() >= -1e-12).all()
    assert (values[:12] - basis.eigenvalues.numpy() <= 2.0 * values[17]).all()
    assert values[12:].sum() / 120 <= error <= basis.residual_mse(12) <= 1.5 * error
    assert basis.total_variance == pytest.approx(values.sum(), rel=1e-12)
    total = float(basis.eigenvalues.sum()) + basis.residual_variance
    assert total == pytest.approx(basis.total_variance, rel=1e-12)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("centring", CENTRINGS)
def test_rank_deficient_data(dtype, centring):
    x = soil(200, 40, rank=3).astype(dtype)
    pca = fit(x, 12)
    # The layout adds a direction per axis; centred on the particle's mean, their sum is zero.
    rank = 3 + {"scalar": 3, "particle": 2, "particle_axis": 0}[centring]
    assert pca.rank(centring) == rank
    basis = pca.basis(centring, rank)
    assert askew(basis.modes) < 1e-12
    assert basis.residual_mse(rank) < (1e-13 if dtype is np.float32 else 1e-28)
    with pytest.raises(UserError, match=f"num_modes is 12 but the data has rank {rank} "):
        pca.basis(centring)


@pytest.mark.parametrize("value", [0.0, 0.3, 1e6])
def test_constant_data_has_no_modes(value):
    still = np.repeat(soil(1, 20, offset=value).astype(np.float32), 100, axis=0)
    pca = fit(still, 4)
    assert pca.rank("particle_axis") == 0
    assert pca.rank("particle") == 2
    with pytest.raises(UserError, match=r"rank 0 .*; add runs"):
        pca.basis("particle_axis", 1)
    layout = pca.basis("particle", 2)
    assert layout.displacement_variance == 0.0
    assert layout.energy(1) < 1.0 and layout.energy(2) == pytest.approx(1.0)
    assert layout.displacement_energy(1) == -np.inf
    one_point = fit(np.full((5, 20, 3), value), 4)
    assert [one_point.rank(c) for c in CENTRINGS] == [0, 0, 0]


def test_huge_offset_costs_no_more_than_the_input_lost():
    x = np.round(soil(100, 20, rank=5) * 2**20) / 2**20
    near, far = fit(x, 5).basis(), fit(x + 2.0**20, 5).basis()
    np.testing.assert_allclose(far.eigenvalues, near.eigenvalues, rtol=1e-12)
    np.testing.assert_allclose(far.modes, near.modes, atol=1e-12)
    np.testing.assert_allclose(far.mean - 2.0**20, near.mean, atol=1e-9)
    for centring in CENTRINGS:
        basis = fit(x * [1, 1, 1] + [2.0**20, 0, 0], 7).basis(centring, 5)
        assert askew(basis.modes) < 1e-12


@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_rounding_of_float32_input_makes_no_modes(offset):
    # Two large motions; everything else in the data is what float32 rounded away.
    x = (1e3 * soil(300, 40, rank=2) + offset).astype(np.float32)
    pca = fit(x, 10)
    assert pca.rank() == 2
    assert pca.basis(num_modes=2).residual_mse(2) <= (6e-8 * np.abs(x).max()) ** 2


def test_arrays_and_tensors_of_any_layout_are_alike():
    x = soil(20, 15).astype(np.float32)
    frozen = x.copy()
    frozen.flags.writeable = False
    expected = fit(x, 3).basis()
    layouts = [frozen, x.astype(">f4"), np.asfortranarray(x), torch.from_numpy(x), x.astype(np.float64)]
    for same in [*layouts, torch.from_numpy(x).requires_grad_()]:
        basis = IncrementalPCA(3).partial_fit(same).basis()
        assert basis.modes.dtype == torch.float64
        assert not basis.modes.requires_grad
        np.testing.assert_allclose(basis.modes, expected.modes, atol=1e-13)
    assert IncrementalPCA(3).partial_fit(x[::-1, :, ::-1]).rank() == 3


@given(st.integers(1, 12), st.integers(1, 40), st.integers(0, 9), st.integers(0, 4), st.integers(0, 99))
@settings(max_examples=40, deadline=None)
def test_any_shape_gives_orthonormal_modes_and_rising_energy(particles, frames, rank, oversampling, seed):
    x = soil(frames, particles, min(rank, particles), seed=seed)
    pca = fit(x, particles, batch=5, oversampling=oversampling)
    for centring in CENTRINGS:
        available = pca.rank(centring)
        assert available == min(np.linalg.matrix_rank(stacked(x, centring), tol=1e-9), particles)
        if available:
            basis = pca.basis(centring, available)
            assert askew(basis.modes) < 1e-12
            largest = basis.modes.gather(0, basis.modes.abs().argmax(0, keepdim=True))
            assert (largest > 0).all()
            assert (np.diff(basis.energy()) >= 0).all()
            assert (np.diff(basis.residual_mse()) <= 0).all()
            assert basis.energy(available) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e200])
def test_not_finite_is_refused_and_leaves_the_stream_as_it_was(value):
    x = soil(20, 15)
    pca = fit(x, 3)
    bad = x.copy()
    bad[4, 7, 2] = value
    with pytest.raises(
        UserError, match=r"frame 4 of this batch \(frame 24 of the stream\), particle 7, axis z"
    ):
        pca.partial_fit(bad)
    assert torch.equal(pca.basis().modes, fit(x, 3).basis().modes)
    with pytest.raises(UserError, match=r"frame 0 .*particle 0, axis x"):
        IncrementalPCA(1).partial_fit(torch.full((2, 3, 3), torch.inf, dtype=torch.float32))


@pytest.mark.parametrize(
    ("positions", "message"),
    [
        (np.zeros((4, 5, 2)), "shape .4, 5, 2."),
        (np.zeros((4, 0, 3)), "shape .4, 0, 3."),
        (np.zeros((2, 5, 3), int), "type int64"),
        (torch.zeros(2, 5, 3, dtype=torch.int32), "type torch.int32"),
        ("soil", "type <U4"),
        (np.zeros((2, 6, 3)), "6 particles but the frames before had 5"),
    ],
)
def test_wrong_input_is_named(positions, message):
    pca = IncrementalPCA(2).partial_fit(np.zeros((1, 5, 3)))
    with pytest.raises(UserError, match=message) as caught:
        pca.partial_fit(positions)
    assert "\n" not in str(caught.value)


def test_wrong_settings_are_named():
    with pytest.raises(UserError, match="num_modes is 0"):
        IncrementalPCA(0)
    with pytest.raises(UserError, match="oversampling is -1"):
        IncrementalPCA(2, -1)
    with pytest.raises(UserError, match="device 'abacus'"):
        IncrementalPCA(2, device="abacus")
    with pytest.raises(UserError, match="no basis without frames"):
        IncrementalPCA(2).partial_fit(np.zeros((0, 5, 3))).basis()
    pca = fit(soil(), 4)
    with pytest.raises(UserError, match="unknown centring 'mean'; allowed: scalar, particle, particle_axis"):
        pca.basis("mean")
    with pytest.raises(UserError, match="num_modes is 5; this stream tracked 4"):
        pca.basis(num_modes=5)


@pytest.mark.parametrize("centring", CENTRINGS)
@pytest.mark.parametrize("cut", [0, 1, 77, 150])
def test_streams_of_two_shares_merge_to_that_of_all_frames(centring, cut):
    # No more directions than are tracked, 12 + 16, and a far reference frame.
    x = soil(150, 60, rank=12, offset=5.0)
    shares = [
        pickle.loads(pickle.dumps(fit(part, 12))) for part in (x[:cut], x[cut:])
    ]  # as from other machines
    merged = shares[0].merge(shares[1])
    whole = fit(x, 12)
    assert merged.frame_count == 150 and merged.rank(centring) == whole.rank(centring)
    a, b = (pca.basis(centring, 10) for pca in (merged, whole))
    np.testing.assert_allclose(a.mean, b.mean, atol=1e-12)
    np.testing.assert_allclose(a.eigenvalues, b.eigenvalues, rtol=1e-9)
    np.testing.assert_allclose(a.modes, b.modes, atol=1e-6)
    for one, other in (
        (a.total_variance, b.total_variance),
        (a.displacement_variance, b.displacement_variance),
    ):
        assert one == pytest.approx(other, rel=1e-12)
    assert askew(a.modes) < 1e-12


def test_a_merged_stream_goes_on_and_the_other_one_stays():
    x = soil(150, 60, rank=12)
    other = fit(x[40:90], 12)
    before = other.basis(num_modes=10).modes
    going_on = fit(x[:40], 12).merge(other).partial_fit(x[90:])
    assert torch.equal(other.basis(num_modes=10).modes, before) and other.frame_count == 50
    whole = fit(x, 12).basis(num_modes=10)
    np.testing.assert_allclose(going_on.basis(num_modes=10).eigenvalues, whole.eigenvalues, rtol=1e-9)
    assert IncrementalPCA(12).merge(IncrementalPCA(12)).frame_count == 0


def test_merged_streams_that_dropped_directions_keep_totals_and_bounds():
    x = soil(600, 150, decay=0.9, seed=3)
    values, modes = exact(x, "particle_axis")
    basis = fit(x[:250], 8).merge(fit(x[250:], 8)).basis()
    assert largest_angle(basis.modes, modes[:, :8]) < 0.05
    assert basis.total_variance == pytest.approx(values.sum(), rel=1e-12)
    error = np.mean((basis.inverse(basis.transform(x)).numpy() - x) ** 2)
    assert error <= basis.residual_mse(8) <= 1.02 * error


def test_streams_that_do_not_belong_together_are_not_merged():
    with pytest.raises(UserError, match="has 20 particles and this one 30; one basis"):
        fit(soil(5, 30), 4).merge(fit(soil(5, 20), 4))
    with pytest.raises(UserError, match="tracks 20 directions and this one 21"):
        IncrementalPCA(5).merge(IncrementalPCA(4))
