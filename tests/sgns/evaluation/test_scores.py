import csv
import json
import math

import numpy as np
import pytest

from sgns.evaluation.metrics import VectorErrors
from sgns.evaluation.scores import Scores, aggregate, write_csv, write_json


def scores(name, total, frozen, force=1.0, rate=10.0):
    truth = np.full((4, 3), [-100.0, 0.0, 50.0])
    errors = VectorErrors.compare(truth, force * truth)
    mse = dict.fromkeys(("reduction", "network", "surface", "surface_frozen"), 1e-6)
    mse |= {"total": total, "frozen": frozen, "constant_velocity": 2.0 * frozen}
    mpe = {"draft": 100 * abs(force - 1), "lateral": math.nan, "vertical": 100 * abs(force - 1)}
    return Scores(name, 4, mse, errors, errors, errors, errors, rate, mpe)


def test_aggregate_by_hand():
    total = aggregate([scores("a", 1e-6, 4e-6, 1.2), scores("b", 3e-6, 4e-6, 0.9, math.nan)])
    assert total.frames == 8
    assert total.skill() == pytest.approx(0.5)
    assert total.skill("constant_velocity") == pytest.approx(0.75)
    assert total.rmse_mm("total") == pytest.approx(math.sqrt(2.0))
    assert total.force.mpe[0] == pytest.approx(5.0)  # signed: errors cancel
    assert total.absolute_mpe["draft"] == pytest.approx(15.0)  # unsigned: they do not
    assert math.isnan(total.absolute_mpe["lateral"])
    assert total.solver_rate == 10.0


def test_aggregate_of_one_run_is_that_run():
    one = scores("a", 1e-6, 4e-6, 1.2)
    row = aggregate([one], "a").row()
    assert {k: row[k] for k in row} == pytest.approx(one.row(), nan_ok=True)


def test_csv_has_a_row_per_run_and_empty_cells_without_meaning(tmp_path):
    rows = [scores("a, with comma", 1e-6, 4e-6), scores("b", 1e-6, 4e-6)]
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
