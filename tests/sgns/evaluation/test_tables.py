import csv
import json
import math

import numpy as np
import pytest
from surrogates import made_scores

from sgns.evaluation.scores import aggregate
from sgns.evaluation.tables import write_csv, write_json


def test_csv_has_a_row_per_run_and_empty_cells_without_meaning(tmp_path):
    rows = [made_scores("a, with comma", 1e-6, 4e-6), made_scores("b", 1e-6, 4e-6)]
    write_csv(tmp_path / "metrics.csv", [*rows, aggregate(rows)])
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
