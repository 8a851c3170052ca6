"""Reduced datasets in small files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from sgns.config import UserError
from sgns.data.dataset import SPLITS
from sgns.data.run import Run
from sgns.evaluate.command import scored
from sgns.evaluate.costs import roll_out
from sgns.model.checkpoint import read_summary
from sgns.reduction import packed
from sgns.reduction.packed import PRECISION, pack, packed_dataset
from sgns.reduction.reduce import ReducedDataset, reduce_dataset
from sgns.simulator import Simulator
from sgns.train.command import train
from sgns_testing.commands import refusal, sgns
from sgns_testing.tiny import BRIEF, MODEL, REDUCTION, make_dataset, reduced


@pytest.fixture(scope="module")
def true(tmp_path_factory) -> ReducedDataset:
    return reduced(tmp_path_factory.mktemp("true") / "data")


@pytest.fixture(scope="module")
def folder(true, tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("packed") / "tiny"
    assert pack(true, place).startswith("7 reduced runs of 6 modes in ")
    return place


def test_what_is_packed_comes_back(true, folder) -> None:
    found = packed_dataset(folder, {"num_modes": 4})
    assert found.num_modes == 4 and found.frame_rate == true.frame_rate
    assert found.basis.fitted_on == true.basis.fitted_on
    np.testing.assert_allclose(found.start_positions, true.start_positions, atol=1e-7)
    for split in SPLITS:
        for one, other in zip(true.runs(split), found.runs(split), strict=True):
            assert (one.name, one.scene) == (other.name, other.scene) and other.path is None
            change = found.basis.inverse(other.latent) - true.basis.inverse(one.latent)
            assert 0 < float(change.square().mean()) ** 0.5 < 2 * PRECISION
            for name in ("time", "pose", "body_points"):
                np.testing.assert_allclose(getattr(other, name), getattr(one, name), atol=1e-6)
            np.testing.assert_allclose(other.force, one.force, atol=1e-3 * np.abs(one.force).max())
            np.testing.assert_allclose(other.torque, one.torque, atol=1e-3 * np.abs(one.torque).max())


def test_large_ones_are_several_files_and_may_be_packed_again(true, folder, tmp_path, monkeypatch) -> None:
    size = (folder / "runs_00.npz").stat().st_size
    for name, most in (("again", size // 3), ("each", 1)):  # a run is never torn apart
        monkeypatch.setattr(packed, "MOST_BYTES", most)
        pack(packed_dataset(folder, {"num_modes": 1}), tmp_path / name)
        assert 2 < len(list((tmp_path / name).glob("runs_*.npz"))) <= 7
        one, other = (packed_dataset(place, {"num_modes": 1}) for place in (folder, tmp_path / name))
        for a, b in zip(one.runs("train"), other.runs("train"), strict=True):
            np.testing.assert_allclose(a.latent, b.latent, atol=1e-3)


def test_training_scores_as_with_the_runs(true, folder, tmp_path) -> None:
    """Skill and errors are those of all particles, although the files have none."""
    how = {"model": MODEL, "training": BRIEF, "num_modes": 4}
    train(true, output=tmp_path / "runs", **how)
    train(packed_dataset(folder, {"num_modes": 4}), output=tmp_path / "packed", **how)
    one, other = (read_summary(tmp_path / name) for name in ("runs", "packed"))
    for key in ("skill", "position_rmse", "force_nrmse"):
        assert other[key] == pytest.approx(one[key], rel=0.02)


def test_commands_from_packing_to_a_table(tmp_path) -> None:
    reduced(tmp_path / "data")
    few = ["reduction.num_modes=4", "reduction.max_modes=6"]
    done = sgns(tmp_path, "reduce", "dataset.path=data", *few, "pack=small", "output=out")
    assert "7 reduced runs of 6 modes in small" in done.stdout
    small = ["dataset=quick_reduced", "dataset.path=small"]
    brief = ["training.max_steps=2", "training.validate_every=2", "model.context=[]"]
    sgns(tmp_path, "train", *small, *few, *brief, "output=net")
    done = sgns(tmp_path, "evaluate", *small, "checkpoint=net/best.ckpt", "output=report")
    assert "mean |MPE|" in done.stdout
    rows = json.loads((tmp_path / "report" / "metrics.json").read_text())
    [run], total = rows["runs"], rows["aggregate"]
    assert run["run"] == "g" and total["mse_reduction_m2"] > 0
    assert total["mse_total_m2"] == pytest.approx(total["mse_reduction_m2"] + total["mse_network_m2"])
    assert "is reduced already" in refusal(tmp_path, "reduce", *small)
    (tmp_path / "small" / "runs_00.npz").unlink()
    assert "runs_00.npz" in refusal(tmp_path, "train", *small, *few)


def test_wrong_requests(folder, true, tmp_path) -> None:
    with pytest.raises(UserError, match=r"allowed are 1 to 6"):
        packed_dataset(folder, {"num_modes": 7, "max_modes": 7})
    with pytest.raises(UserError, match=r"allowed are 1 to 6"):
        packed_dataset(folder, {"num_modes": "auto"})
    with pytest.raises(UserError, match="of centring particle_axis"):
        packed_dataset(folder, {"num_modes": 2, "centring": "scalar"})
    with pytest.raises(UserError, match=r"basis\.npz is missing"):
        packed_dataset(tmp_path, {"num_modes": 2})
    with pytest.raises(UserError, match="is not empty"):
        pack(true, folder)


@pytest.mark.parametrize("name", ["basis.npz", "runs_00.npz"])
def test_damaged_files_are_refused_in_one_line(folder, tmp_path, name) -> None:
    whole = {path.name: path.read_bytes() for path in folder.iterdir()}
    rng = np.random.default_rng(0)
    for number in range(20):
        place = tmp_path / str(number)
        place.mkdir()
        for file, content in whole.items():
            if file == name:
                changed = bytearray(content)
                for at in rng.integers(0, len(changed), 20):
                    changed[at] ^= int(rng.integers(1, 256))
                content = bytes(changed[: len(changed) // 2] if number == 0 else changed)
            (place / file).write_bytes(content)
        try:
            packed_dataset(place, {"num_modes": 4})
        except UserError as error:
            assert "\n" not in str(error)


@pytest.mark.parametrize("closure", ["none", "kernel"])
def test_errors_are_those_of_all_particles(tmp_path, closure, monkeypatch) -> None:
    """Up to rounding, which an untrained network may enlarge."""
    monkeypatch.setattr(packed, "PRECISION", 1e-9)
    dataset = make_dataset(tmp_path / "data")
    how = REDUCTION | {"num_modes": 2, "closure": closure, "closure_modes": 4}
    pack(reduce_dataset(dataset, how, progress=False), tmp_path / "packed")
    small = packed_dataset(tmp_path / "packed", how)
    train(small, num_modes=2, model=MODEL, training=BRIEF, output=tmp_path / "net")
    simulator = Simulator.load(tmp_path / "net" / "best.ckpt")
    [run] = small.runs("test")
    found = scored(simulator, run, np.zeros(3)).mse
    with Run(dataset.runs("test")[0]) as truth:
        positions = truth.positions()[simulator.history :]
        latents = {"total": roll_out(simulator, truth).latent, "reduction": run.latent[:, :2]}
    for name, latent in latents.items():
        error = simulator.basis.inverse(latent[simulator.history :]).numpy() - positions
        assert found[name] == pytest.approx(np.square(error).mean(), rel=1e-2)
