"""The number of modes that `reduction.num_modes=auto` takes, and the cache of reduced runs."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import torch

from sgns.config import UserError
from sgns.data.run import Run
from sgns.reduction import reduce as module
from sgns.reduction.basis import reconstruction_curve
from sgns.reduction.reduce import choose_modes, reduce_dataset
from sgns_testing.runs import make_run
from sgns_testing.tiny import REDUCTION, make_dataset


@pytest.fixture(params=["particle_axis", "particle"])
def case(request, tmp_path):
    """Basis, validation runs and settings."""
    settings = REDUCTION | {"num_modes": "auto", "tolerance": 1e3, "centring": request.param}
    dataset = make_dataset(tmp_path)
    return reduce_dataset(dataset, settings).basis, dataset.runs("validation"), settings


@pytest.mark.parametrize("measure", ["energy", "displacement_energy"])
def test_energies_are_reached_by_the_fewest_modes(case, measure) -> None:
    basis, validation, settings = case
    energy = getattr(basis, measure)
    for share in (0.6, 0.9, 0.95):
        chosen, reason = choose_modes(basis, settings | {"choose": measure, "share": share}, validation)
        assert energy(chosen) >= share
        assert chosen == 1 or energy(chosen - 1) < share
        assert measure.replace("_", " ") in reason and f"{energy(chosen):.4g}" in reason


@pytest.mark.parametrize("held_out", [True, False])
def test_position_goes_by_held_out_runs_where_there_are_any(case, held_out) -> None:
    basis, validation, settings = case
    paths = validation if held_out else []
    curve = reconstruction_curve(validation, basis)[1:] if held_out else np.asarray(basis.residual_mse())
    rmse = 1e3 * np.sqrt(curve)
    for r in (2, 5):
        chosen, reason = choose_modes(basis, settings | {"tolerance": float(rmse[r - 1])}, paths)
        assert chosen == r
        assert ("2 validation runs" if held_out else "the training runs") in reason
        tighter = settings | {"tolerance": float(np.nextafter(rmse[r - 1], 0.0))}
        assert choose_modes(basis, tighter, paths)[0] == r + 1


def test_a_tolerance_out_of_reach_names_what_is_reached(case) -> None:
    basis, validation, settings = case
    rmse = 1e3 * np.sqrt(reconstruction_curve(validation, basis)[-1])
    with pytest.raises(UserError) as caught:
        choose_modes(basis, settings | {"tolerance": rmse / 2}, validation)
    line = str(caught.value)
    assert f"all 6 modes reach {rmse:.4g} mm" in line and "or raise reduction.max_modes" in line
    with pytest.raises(UserError, match=r"lower reduction\.share") as caught:
        choose_modes(basis, settings | {"choose": "energy", "share": 1.0, "max_modes": 9}, validation)
    assert "max_modes" not in str(caught.value)


# --- The cache of reduced runs: what is reused, what is made anew, what is refused ----------------------


def files(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*.h5")}


def test_reduced_runs_are_transformed_runs(tmp_path) -> None:
    dataset = make_dataset(tmp_path)
    reduced = reduce_dataset(dataset, REDUCTION)
    assert reduced.basis.fitted_on == ["a", "b", "c", "d"]
    assert [run.name for run in reduced.runs("validation")] == ["e", "f"]
    with Run(dataset.runs("test")[0]) as run:
        found = reduced.runs("test")[0]
        np.testing.assert_array_equal(found.latent, reduced.basis.transform(run.positions()).numpy())
        np.testing.assert_array_equal(found.force, run.force)
        np.testing.assert_array_equal(reduced.start_positions, run.positions(0)[0])
        assert found.scene == run.scene
        assert reduced.frame_rate == run.frame_rate


def test_what_is_there_is_taken_also_in_a_sweep_over_modes(tmp_path, monkeypatch) -> None:
    dataset = make_dataset(tmp_path)
    first = reduce_dataset(dataset, REDUCTION)
    before = files(tmp_path / "reduced")
    monkeypatch.setattr(module, "fit_runs", None)
    for r in (1, 4, 6):
        reduced = reduce_dataset(dataset, REDUCTION | {"num_modes": r})
        assert (reduced.basis.num_modes, reduced.num_modes) == (6, r)
    auto = {"num_modes": "auto", "choose": "energy", "share": 0.5, "tolerance": 7.0}
    again = reduce_dataset(dataset, REDUCTION | auto)
    assert again.num_modes < 6 and files(tmp_path / "reduced") == before
    for a, b in zip(first.runs("train"), again.runs("train"), strict=True):
        np.testing.assert_array_equal(a.latent, b.latent)


def test_other_settings_and_other_training_runs_get_another_cache(tmp_path) -> None:
    dataset = make_dataset(tmp_path)
    first = reduce_dataset(dataset, REDUCTION)
    for change in ({"centring": "particle"}, {"max_modes": 5}):
        assert reduce_dataset(dataset, REDUCTION | change).folder != first.folder
    make_run(dataset.runs("test")[0], frames=14, seed=99)
    second = reduce_dataset(dataset, REDUCTION)
    assert second.folder == first.folder
    assert np.abs(second.runs("test")[0].latent - first.runs("test")[0].latent).max() > 1e-6
    make_run(dataset.runs("train")[0], frames=14, seed=98)
    assert reduce_dataset(dataset, REDUCTION).folder != first.folder


def test_damaged_cache_is_made_anew(tmp_path) -> None:
    dataset = make_dataset(tmp_path)
    first = reduce_dataset(dataset, REDUCTION)
    for path in first.folder.iterdir():
        path.write_bytes(path.read_bytes()[:100])
    again = reduce_dataset(dataset, REDUCTION)
    assert torch.equal(again.basis.modes, first.basis.modes)


def test_no_more_modes_than_the_data_has(tmp_path) -> None:
    dataset = make_dataset(tmp_path, n=5)
    with pytest.raises(UserError, match="ask for at most"):
        reduce_dataset(dataset, REDUCTION | {"num_modes": 6, "max_modes": 9})


def test_a_mixture_of_beds_is_refused(tmp_path) -> None:
    dataset = make_dataset(tmp_path)
    make_run(dataset.runs("validation")[0], frames=14, n=40)
    with pytest.raises(UserError, match="do not belong together"):
        reduce_dataset(dataset, REDUCTION)


def test_runs_with_further_bodies_are_refused(tmp_path) -> None:
    dataset = make_dataset(tmp_path)
    make_run(dataset.runs("train")[0], frames=14, scene={"others": [{"motion": "free"}]})
    with pytest.raises(UserError, match=r"has further bodies .* a network knows one body"):
        reduce_dataset(dataset, REDUCTION)


def test_a_device_that_is_not_here_is_one_line_also_with_a_cache(tmp_path) -> None:
    dataset = make_dataset(tmp_path)
    reduce_dataset(dataset, REDUCTION)
    with pytest.raises(UserError, match=r"device 'abacus'.*use device=cpu"):
        reduce_dataset(dataset, REDUCTION, device="abacus")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_the_gpu_reduces_alike(tmp_path) -> None:
    cpu = reduce_dataset(make_dataset(tmp_path / "cpu"), REDUCTION)
    gpu = reduce_dataset(make_dataset(tmp_path / "gpu"), REDUCTION, device="cuda")
    assert gpu.basis.modes.device.type == "cpu"
    np.testing.assert_allclose(gpu.basis.modes, cpu.basis.modes, atol=1e-8)
    for a, b in zip(gpu.runs("test"), cpu.runs("test"), strict=True):
        np.testing.assert_allclose(a.latent, b.latent, atol=1e-8)


@pytest.mark.parametrize("name", ["c", "e"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_positions_that_are_no_numbers_are_named(tmp_path, name, value) -> None:
    """Of a training run while the basis is fitted, of a validation run while it is reduced."""
    dataset = make_dataset(tmp_path)
    path = tmp_path / "runs" / f"{name}.h5"
    with h5py.File(path, "r+") as file:
        file["particles/soil/position/value"][6, 17, 2] = value
    with pytest.raises(UserError, match=rf"{name}\.h5: .*particle 17 along z is {value} at frame 6"):
        reduce_dataset(dataset, REDUCTION)
    assert not list((tmp_path / "reduced").rglob("*.tmp*"))
