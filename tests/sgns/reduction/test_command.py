"""`sgns reduce`: what it says and the table it writes."""

from __future__ import annotations

import csv

import numpy as np
import pytest
import yaml
from omegaconf import OmegaConf

from sgns.reduction.basis import reconstruction_curve
from sgns.reduction.command import main
from sgns.reduction.reduce import reduce_dataset
from sgns_testing.tiny import REDUCTION, make_dataset


def settings(folder, output, **changes):
    return OmegaConf.create(
        {
            "dataset": {"path": str(folder)},
            "reduction": REDUCTION | changes,
            "output": str(output),
            "device": "cpu",
        }
    )


def table(folder):
    with (folder / "energy.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_the_command_returns_the_error_and_writes_every_number_of_modes(tmp_path, caplog) -> None:
    dataset = make_dataset(tmp_path / "data")
    with caplog.at_level("INFO"):
        error = main(settings(tmp_path / "data", tmp_path / "out"))
    basis = reduce_dataset(dataset, REDUCTION).basis
    assert error == basis.residual_mse(4)
    assert "displacement energy" in caplog.text and "energy.csv" in caplog.text
    rows = table(tmp_path / "out")
    assert [int(row["modes"]) for row in rows] == list(range(1, basis.num_modes + 1))
    columns = {
        "energy": basis.energy(),
        "displacement_energy": basis.displacement_energy(),
        "mse_training_m2": basis.residual_mse(),
        "mse_validation_m2": reconstruction_curve(dataset.runs("validation"), basis)[1:],
    }
    for name, expected in columns.items():
        assert [float(row[name]) for row in rows] == pytest.approx(np.asarray(expected))
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["energy.csv"]


def test_without_validation_runs_their_column_is_empty(tmp_path) -> None:
    make_dataset(tmp_path / "data")
    file = tmp_path / "data" / "dataset.yaml"
    content = yaml.safe_load(file.read_text())
    content["split"]["validation"] = []
    file.write_text(yaml.safe_dump(content))
    main(settings(tmp_path / "data", tmp_path / "out"))
    assert {row["mse_validation_m2"] for row in table(tmp_path / "out")} == {""}


def test_auto_says_what_it_chose_and_why(tmp_path, caplog) -> None:
    dataset = make_dataset(tmp_path / "data")
    basis = reduce_dataset(dataset, REDUCTION).basis
    curve = 1e3 * np.sqrt(reconstruction_curve(dataset.runs("validation"), basis))
    tolerance = float(curve[2:4].mean())
    with caplog.at_level("INFO"):
        error = main(settings(tmp_path / "data", tmp_path / "out", num_modes="auto", tolerance=tolerance))
    assert error == basis.residual_mse(3)
    assert f"auto: 3 modes; RMSE on 2 validation runs is {curve[3]:.4g} mm" in caplog.text
    assert "    3 " in next(line for line in caplog.text.splitlines() if "<- reduction.num_modes" in line)
