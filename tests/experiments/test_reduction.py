"""The table of modes that follow from the first ones: its rows for a dataset of any size."""

import importlib.util
from pathlib import Path

import pytest

from sgns.reduction.reduce import reduce_dataset
from sgns.settings import ReductionSettings
from sgns.train.command import train
from sgns_testing.tiny import FIT, POLYNOMIAL, make_dataset

FILE = Path(__file__).parents[2] / "experiments" / "reduction" / "closure.py"


@pytest.fixture(scope="module")
def closure():
    spec = importlib.util.spec_from_file_location("closure", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_closures_have_rows_for_every_number_of_training_runs(closure, tmp_path, monkeypatch):
    monkeypatch.setattr(closure, "LINEAR", (2, 4, 999))
    monkeypatch.setattr(closure, "CLOSURES", [("kernel", 2, 4), ("quadratic", 2, 6), ("quadratic", 2, 999)])
    make_dataset(tmp_path / "tiny", frames=30)
    table = tmp_path / "table.csv"
    for counts, of in (([], "4"), ([2, 4], "24")):
        closure.measured(tmp_path / "tiny", counts, table=table)
        rows = closure.read_rows(table)
        names = [(row["dataset"], row["method"], row["training_runs"]) for row in rows]
        closures = [("tiny", name, n) for n in of for name in ("kernel 2 to 4", "quadratic 2 to 6")]
        assert names == [("tiny", "linear 2", "4"), ("tiny", "linear 4", "4"), *closures]
        linear = [float(row["test_position_rmse_mm"]) for row in rows[:2]]
        assert linear[1] < linear[0]
        assert all(0 < float(row["decode_ms_per_frame"]) < 1e3 for row in rows)


def test_a_checkpoint_adds_the_errors_of_its_rollouts(closure, tmp_path, monkeypatch):
    monkeypatch.setattr(closure, "LINEAR", (2, 4))
    monkeypatch.setattr(closure, "CLOSURES", [("kernel", 2, 4)])
    data = reduce_dataset(
        make_dataset(tmp_path / "tiny", frames=30), ReductionSettings().to_dict(), progress=False
    )
    train(data, num_modes=2, model=POLYNOMIAL, training=FIT, output=tmp_path)
    closure.measured(tmp_path / "tiny", [], tmp_path / "best.ckpt", tmp_path / "table.csv")
    two, four, closed = closure.read_rows(tmp_path / "table.csv")
    assert four["rollout_position_rmse_mm"] == ""
    for row in (two, closed):
        assert float(row["rollout_position_rmse_mm"]) > float(row["test_position_rmse_mm"])
    make_dataset(tmp_path / "other" / "tiny", frames=28)
    with pytest.raises(SystemExit, match="belongs to another basis"):
        closure.measured(tmp_path / "other" / "tiny", [], tmp_path / "best.ckpt", tmp_path / "table.csv")


def test_more_training_runs_than_there_are_is_refused(closure, tmp_path):
    make_dataset(tmp_path / "tiny", frames=30)
    with pytest.raises(SystemExit, match="there are 4 training runs"):
        closure.measured(tmp_path / "tiny", [5], table=tmp_path / "table.csv")
