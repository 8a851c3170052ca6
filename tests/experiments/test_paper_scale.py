"""Learning curves from a packed dataset: a measure of the surface, and the table."""

from __future__ import annotations

import csv
import importlib.util
import math
import sys
from pathlib import Path

import numpy as np
import pytest

from sgns.data.surface import particle_spacing, surface_grid
from sgns.reduction.packed import pack
from sgns_testing.tiny import reduced

FILE = Path(__file__).parents[2] / "experiments" / "paper_scale" / "run.py"


@pytest.fixture(scope="module")
def study():
    spec = importlib.util.spec_from_file_location("paper_scale", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_columns_are_filled_as_high_as_the_bed_and_soil_is_kept(study):
    sides = [np.arange(count) * 0.01 + 0.005 for count in (24, 16, 8)]
    bed = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)
    grid, volume = surface_grid(bed), particle_spacing(bed) ** 3
    np.testing.assert_allclose(study.filled(bed, grid, volume), 0.08, rtol=1e-6)
    hill = bed + np.random.default_rng(0).normal(0.0, 0.02, bed.shape)
    assert study.filled(hill, grid, volume).mean() == pytest.approx(0.08)
    # A heap on one half: soil moved from the other.
    moved = bed[bed[:, 0] < 0.12] + np.array([0.12, 0.0, 0.08])
    heap = study.filled(np.concatenate([bed[bed[:, 0] > 0.12], moved]), grid, volume)
    assert heap[-4:].mean() == pytest.approx(0.16) and heap[:4].mean() == pytest.approx(0.0)


def test_a_training_has_one_row_and_is_not_repeated(study, tmp_path, monkeypatch, capsys):
    pack(reduced(tmp_path / "data"), tmp_path / "packed")
    words = [
        "tiny",
        "reduction.num_modes=3",
        "model.context=[]",
        "model.hidden_width=8",
        "training.validate_every=2",
    ]
    places = ["--folder", "packed", "--table", "table.csv", "--output", "out", "--steps", "2", "--runs", "2"]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(study, "EVERY", 2)
    monkeypatch.setattr(sys, "argv", ["run.py", *words, *places])
    for _ in range(2):
        study.main()
        with open("table.csv", newline="") as file:
            [row] = csv.DictReader(file)
        assert (row["runs"], row["steps"], row["modes"]) == ("2", "2", "3")
        assert float(row["filled_rmse_mm"]) > 0 and math.isfinite(float(row["force_nrmse"]))
    monkeypatch.setattr(sys, "argv", ["run.py", "tiny", *words[1:], *places[:-1], "99"])
    with pytest.raises(SystemExit, match="--runs 99: there are"):
        study.main()
