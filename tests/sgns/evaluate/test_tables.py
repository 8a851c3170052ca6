import csv
import json
import math

import numpy as np
import pytest

from sgns.evaluate.results import aggregate
from sgns.evaluate.tables import example_row, write_csv, write_json
from sgns_testing.surrogates import made_scores


def test_csv_has_a_row_per_run_and_empty_cells_without_meaning(tmp_path):
    rows = [made_scores("a, with comma", 1e-6, 4e-6), made_scores("b", 1e-6, 4e-6)]
    write_csv(tmp_path / "metrics.csv", [score.row() for score in (*rows, aggregate(rows))])
    with (tmp_path / "metrics.csv").open(newline="", encoding="utf-8") as file:
        read = list(csv.DictReader(file))
    assert [row["run"] for row in read] == ["a, with comma", "b", "all runs"]
    assert float(read[0]["skill_frozen"]) == pytest.approx(0.75)
    assert read[0]["lateral_nrmse"] == ""
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.csv"]


def test_json_is_strict(tmp_path):
    write_json(
        tmp_path / "a.json",
        {"x": math.nan, "y": [np.float64(1.5), np.inf], "z": np.arange(2), "n": np.int64(3)},
    )
    assert json.loads((tmp_path / "a.json").read_text()) == {"x": None, "y": [1.5, None], "z": [0, 1], "n": 3}


def test_row_of_examples_has_signed_and_unsigned_errors():
    scores = [made_scores("a", 1e-6, 4e-6, force=1.2), made_scores("b", 3e-6, 4e-6, force=0.9)]
    row = example_row(scores[1])
    assert row["mse_total_m2"] == 3e-6 and row["mse_frozen_m2"] == 4e-6
    assert row["draft_mpe_percent"] == pytest.approx(-10.0)
    assert row["draft_abs_mpe_percent"] == pytest.approx(10.0)
    assert row["nrmse"] == pytest.approx(0.1)
    assert math.isnan(row["lateral_mpe_percent"])
    together = example_row(aggregate(scores))
    assert together["draft_mpe_percent"] == pytest.approx(5.0)
    assert together["draft_abs_mpe_percent"] == pytest.approx(15.0)
    assert list(together) == list(row)
