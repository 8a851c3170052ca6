"""The number of modes that `reduction.num_modes=auto` takes."""

from __future__ import annotations

import numpy as np
import pytest
from omegaconf import OmegaConf
from tiny import MODEL, REDUCTION, TRAINING, make_dataset

from sgns.errors import UserError
from sgns.learning.surrogate import load_surrogate
from sgns.learning.training import main
from sgns.reduction.choice import choose_modes
from sgns.reduction.reconstruction import reconstruction_curve
from sgns.reduction.reduced import reduce_dataset


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


def test_training_uses_what_was_chosen(tmp_path) -> None:
    three = reduce_dataset(make_dataset(tmp_path / "data"), REDUCTION).basis.energy(3)
    cfg = {
        "dataset": {"path": str(tmp_path / "data"), "name": "tiny"},
        "reduction": REDUCTION | {"num_modes": "auto", "choose": "energy", "share": three},
        "model": MODEL,
        "training": TRAINING | {"max_steps": 2, "validate_every": 2},
        "preset": {"name": "default"},
        "checkpoint": None,
        "output": str(tmp_path / "out"),
        "seed": 0,
        "device": "cpu",
    }
    main(OmegaConf.create(cfg))
    assert load_surrogate(tmp_path / "out" / "best.ckpt").dynamics.num_modes == 3
