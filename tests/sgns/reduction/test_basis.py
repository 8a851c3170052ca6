"""Basis: projection, energies, the file, and the error of projecting runs."""

from __future__ import annotations

import dataclasses

import h5py
import numpy as np
import pytest
import torch

from sgns.config import UserError
from sgns.data import run as runs
from sgns.data.run import Run
from sgns.reduction.basis import CENTRINGS, Basis, left_out, reconstruction_curve
from sgns.reduction.pca import IncrementalPCA
from sgns_testing.runs import make_run
from sgns_testing.surrogates import fitted, small_dataset


@pytest.fixture
def positions() -> np.ndarray:
    rng = np.random.default_rng(1)
    return rng.uniform(size=(1, 20, 3)) + 0.1 * rng.normal(size=(30, 20, 3)) * rng.uniform(size=(20, 1))


@pytest.fixture(params=CENTRINGS)
def basis(request, positions) -> Basis:
    pca = IncrementalPCA(6, 14).partial_fit(positions)
    return pca.basis(request.param, arrangement_hash="abc", fitted_on=["run_0", "läuft"])


def same(a: Basis, b: Basis) -> bool:
    """Whether every field is bit-equal."""
    values = zip(a.state().items(), b.state().items(), strict=True)
    return all(
        p == q and (torch.equal(x, y) if isinstance(x, torch.Tensor) else x == y) for (p, x), (q, y) in values
    )


def test_transform_and_inverse_undo_each_other_in_the_subspace(basis, positions):
    latent = basis.transform(positions)
    assert latent.shape == (30, 6, 3)
    assert latent.dtype == torch.float64
    np.testing.assert_allclose(basis.transform(basis.inverse(latent)), latent, atol=1e-13)
    once = basis.inverse(latent)
    np.testing.assert_allclose(basis.inverse(basis.transform(once)), once, atol=1e-13)


def test_transform_is_the_papers_projection(basis, positions):
    frame = positions[3]
    expected = (frame - basis.mean.numpy()).T @ basis.modes.numpy()
    np.testing.assert_allclose(basis.transform(frame), expected.T, atol=1e-14)
    several = basis.transform(torch.from_numpy(positions.reshape(5, 6, 20, 3)))
    np.testing.assert_allclose(several[0, 3], expected.T, atol=1e-14)
    assert basis.inverse(several).shape == (5, 6, 20, 3)


def test_gradients_reach_the_latent(basis):
    latent = torch.zeros(2, 6, 3, requires_grad=True)
    basis.inverse(latent).sum().backward()
    expected = basis.modes.sum(0)[:, None].expand(2, 6, 3)
    np.testing.assert_allclose(latent.grad, expected.float(), rtol=1e-6)


def test_energies_rise_to_their_definitions(basis):
    kept = basis.eigenvalues.cumsum(0)
    np.testing.assert_allclose(basis.energy(), kept / basis.total_variance, rtol=1e-12)
    residual = basis.total_variance - kept
    np.testing.assert_allclose(basis.residual_mse() * 20, residual, rtol=1e-10)
    np.testing.assert_allclose(
        basis.displacement_energy(), 1 - residual / basis.displacement_variance, rtol=1e-10
    )
    assert (np.diff(basis.energy()) > 0).all()
    assert (np.diff(basis.displacement_energy()) > 0).all()
    assert basis.energy(0) == pytest.approx(0.0, abs=1e-12)
    assert basis.energy(4) == float(basis.energy()[3])
    if basis.centring == "particle_axis":
        assert basis.displacement_energy(4) == basis.energy(4)


def test_a_slice_is_the_smaller_basis(basis, positions):
    cut = basis.sliced(2)
    fitted = IncrementalPCA(2, 18).partial_fit(positions).basis(basis.centring)
    np.testing.assert_allclose(cut.modes, fitted.modes, atol=1e-10)
    assert cut.energy(2) == basis.energy(2)
    assert cut.residual_mse(1) == pytest.approx(basis.residual_mse(1), rel=1e-14)
    assert (cut.arrangement_hash, cut.fitted_on) == ("abc", ["run_0", "läuft"])
    for r in (0, 7):
        with pytest.raises(UserError, match=f"cannot keep {r} modes; .* allowed: 1 to 6"):
            basis.sliced(r)
    with pytest.raises(UserError, match="asked for 7 modes"):
        basis.energy(7)


def test_wrong_shapes_are_named(basis):
    with pytest.raises(
        UserError, match=r"positions have shape \(2, 19, 3\); this basis takes \(\.\.\., 20, 3\)"
    ):
        basis.transform(np.zeros((2, 19, 3)))
    with pytest.raises(UserError, match=r"reduced positions have shape \(6,\)"):
        basis.inverse(np.zeros(6))
    with pytest.raises(UserError, match="do not belong together"):
        dataclasses.replace(basis, mean=basis.mean[1:])


def test_file_round_trip_is_bit_equal(basis, tmp_path):
    path = tmp_path / "basis.h5"
    basis.save(path)
    basis.save(path)  # replaces
    assert [p.name for p in tmp_path.iterdir()] == ["basis.h5"]
    assert same(Basis.load(path), basis)
    assert same(Basis.load(str(path)).sliced(2), basis.sliced(2))


def test_state_survives_a_checkpoint_without_pickle(basis, tmp_path):
    torch.save(basis.state(), tmp_path / "basis.ckpt")
    assert same(Basis.from_state(torch.load(tmp_path / "basis.ckpt", weights_only=True)), basis)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"modes": None}, "not a basis"),
        ({"displacement_variance": 5000 * "["}, "not a basis"),
        ({"format_version": 99}, "newer than this program"),
        ({"centring": "none"}, "unknown centring"),
        ({"total_variance": float("nan")}, "not finite"),
        ({"modes": torch.ones(20, 6)}, "not orthonormal"),
        ({"modes": torch.eye(20)}, "do not belong together"),
    ],
)
def test_a_wrong_state_is_named(basis, change, message):
    with pytest.raises(UserError, match=message) as caught:
        Basis.from_state(basis.state() | change)
    assert len(str(caught.value)) < 500
    with pytest.raises(UserError, match="not a basis"):
        Basis.from_state({})


def test_damaged_missing_and_foreign_files_are_refused(basis, tmp_path):
    saved = tmp_path / "basis.h5"
    with pytest.raises(UserError, match="no basis file at"):
        Basis.load(saved)
    basis.save(saved)
    whole = saved.read_bytes()
    with h5py.File(saved, "a") as file:
        where = file["modes"].id.get_chunk_info(0).byte_offset
        del file["modes"]
    lacking = saved.read_bytes()
    flipped = bytearray(whole)
    flipped[where + 12] ^= 1
    for damaged in (whole[: len(whole) // 2], b"", b"not HDF5 at all", bytes(flipped), lacking):
        saved.write_bytes(damaged)
        with pytest.raises(UserError, match="truncated or damaged") as caught:
            Basis.load(saved)
        assert "\n" not in str(caught.value)
    with h5py.File(saved, "w") as file:
        file["modes"] = np.eye(3)
    with pytest.raises(UserError, match="not a basis"):
        Basis.load(saved)


def test_reconstruction_curve_is_the_error_of_projecting(tmp_path):
    dataset = small_dataset(tmp_path)
    basis = fitted(dataset.runs("train"), modes=6)
    path = dataset.runs("test")[0]
    curve = reconstruction_curve([path], basis)
    with Run(path) as run:
        true = torch.from_numpy(run.positions()).double()
        for r in (1, 3, 6):
            part = basis.sliced(r)
            direct = float((part.inverse(part.transform(true)) - true).square().mean())
            assert curve[r] == pytest.approx(direct, rel=1e-6)
    assert (np.diff(curve) <= 0.0).all()
    own = reconstruction_curve(dataset.runs("train"), basis)
    assert own[1:] == pytest.approx(np.asarray(basis.residual_mse()), rel=1e-4, abs=1e-14)
    assert np.isnan(reconstruction_curve([], basis)).all()


@pytest.mark.parametrize("centring", CENTRINGS)
def test_what_modes_leave_out_of_places_and_of_ways(tmp_path, monkeypatch, centring):
    monkeypatch.setattr(runs, "CHUNK_BYTES", 24 * 60 * 5)  # several chunks
    path = make_run(tmp_path / "a.h5", frames=12, n=60)
    with Run(path) as run:
        positions = run.positions().astype(np.float64)
    basis = IncrementalPCA(6, 14).partial_fit(positions).basis(centring, 3)
    rest = positions - basis.inverse(basis.transform(positions)).numpy()
    here, way = left_out(path, basis, 2)
    np.testing.assert_allclose(here, (rest**2).sum((1, 2)), atol=1e-12)
    np.testing.assert_allclose(way, ((rest - rest[2]) ** 2).sum((1, 2)), atol=1e-12)
    assert here.shape == (12,) and way[2] == 0.0
