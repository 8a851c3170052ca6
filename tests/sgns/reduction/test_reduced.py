"""The cache of reduced runs: what is reused, what is made anew, what is refused."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from synthetic import make_run
from tiny import REDUCTION, make_dataset

import sgns.reduction.reduced as module
from sgns.errors import UserError
from sgns.reduction.reduced import reduce_dataset
from sgns.runs import Run


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


def test_second_time_nothing_is_computed(tmp_path, monkeypatch) -> None:
    dataset = make_dataset(tmp_path)
    first = reduce_dataset(dataset, REDUCTION)
    before = files(tmp_path / "reduced")
    monkeypatch.setattr(module, "fit_runs", None)
    second = reduce_dataset(dataset, REDUCTION)
    assert files(tmp_path / "reduced") == before
    for a, b in zip(first.runs("train"), second.runs("train"), strict=True):
        np.testing.assert_array_equal(a.latent, b.latent)


def test_a_sweep_over_modes_fits_one_basis(tmp_path, monkeypatch) -> None:
    dataset = make_dataset(tmp_path)
    reduce_dataset(dataset, REDUCTION)
    monkeypatch.setattr(module, "fit_runs", None)
    for r in (1, 2, 6):
        reduced = reduce_dataset(dataset, REDUCTION | {"num_modes": r})
        assert (reduced.basis.num_modes, reduced.num_modes) == (6, r)
    auto = {"num_modes": "auto", "choose": "energy", "share": 0.5, "tolerance": 7.0}
    assert reduce_dataset(dataset, REDUCTION | auto).num_modes < 6
    assert len(list((tmp_path / "reduced").iterdir())) == 1


def test_other_settings_and_other_training_runs_get_another_cache(tmp_path) -> None:
    dataset = make_dataset(tmp_path)
    first = reduce_dataset(dataset, REDUCTION).folder
    assert reduce_dataset(dataset, REDUCTION | {"centring": "particle"}).folder != first
    assert reduce_dataset(dataset, REDUCTION | {"max_modes": 5}).folder != first
    make_run(dataset.runs("test")[0], frames=14, seed=99)
    assert reduce_dataset(dataset, REDUCTION).folder == first
    make_run(dataset.runs("train")[0], frames=14, seed=98)
    assert reduce_dataset(dataset, REDUCTION).folder != first


def test_a_changed_test_run_is_reduced_again(tmp_path) -> None:
    dataset = make_dataset(tmp_path)
    before = reduce_dataset(dataset, REDUCTION).runs("test")[0]
    make_run(dataset.runs("test")[0], frames=14, seed=99)
    after = reduce_dataset(dataset, REDUCTION).runs("test")[0]
    assert np.abs(after.latent - before.latent).max() > 1e-6


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


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"num_modes": "many"}, "must be a whole number or auto"),
        ({"num_modes": None}, "must be a whole number"),
        ({"num_modes": 0}, "1 to"),
        ({"num_modes": 7}, "max_modes"),
        ({"centring": "median"}, "particle_axis"),
        ({"choose": "taste"}, "allowed: position, energy, displacement_energy"),
        ({"tolerance": 0.0}, "more than 0"),
        ({"share": 1.5}, "at most 1"),
    ],
)
def test_wrong_settings(tmp_path, change, line) -> None:
    with pytest.raises(UserError, match=line):
        reduce_dataset(make_dataset(tmp_path), REDUCTION | change)


def test_a_mixture_of_beds_is_refused(tmp_path) -> None:
    dataset = make_dataset(tmp_path)
    make_run(dataset.runs("validation")[0], frames=14, n=40)
    with pytest.raises(UserError, match="do not belong together"):
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
