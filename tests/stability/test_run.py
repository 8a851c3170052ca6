"""`make stability`: what is measured again, what a crash leaves, the table and the figure."""

from __future__ import annotations

import csv
import json
import math
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from areas import AREAS, cases
from case import Case

FOLDER = Path(__file__).parents[2] / "experiments" / "stability"


@pytest.fixture
def run(monkeypatch):
    """The script as a module."""
    monkeypatch.syspath_prepend(str(FOLDER))
    sys.modules.pop("run", None)
    import run

    yield run
    sys.modules.pop("run", None)


def case(**changes) -> Case:
    return replace(Case("a case", "hard", "must", "quantity", 2.0, "mm", lambda: (1.0, "a note")), **changes)


def test_a_row_is_measured_again_when_its_case_changes(run, tmp_path):
    file = tmp_path / "row.json"
    assert run.stored(file, case()) is None
    row = case().run("area")
    run.keep(file, row)
    assert run.stored(file, case()) == row
    assert run.stored(file, case(limit=1.0)) is None
    assert run.stored(file, case(must="something else")) is None
    file.write_text(json.dumps(asdict(row))[:-20])  # cut short
    assert run.stored(file, case()) is None


def test_a_process_that_dies_is_a_failed_case(run, tmp_path, monkeypatch):
    died = subprocess.CompletedProcess([], -11, stderr="segmentation\nfault")
    monkeypatch.setattr(run.subprocess, "run", lambda *_, **__: died)
    row = run.measure("area", case(), tmp_path)
    assert not row.passed
    assert row.note == "the process ended with status -11: segmentation fault"
    again = run.stored(run.row_file(tmp_path, "area", "a case"), case())
    assert again.note == row.note and math.isnan(again.measured)


def test_table_and_figure(run, tmp_path):
    values = (1.0, 3.0, 0.0, math.nan)
    rows = [case(measure=lambda v=v: v).run(area) for v in values for area in ("one", "two")]
    rows.append(case(limit=0.0, measure=lambda: 1.0).run("two"))
    run.write_table(tmp_path / "table.csv", rows)
    with (tmp_path / "table.csv").open() as stream:
        found = list(csv.DictReader(stream))
    assert [row["result"] for row in found[::2]] == ["pass", "fail", "pass", "fail", "fail"]
    assert found[0]["margin"] == "0.500"
    run.draw(rows, tmp_path / "margins.png")
    assert (tmp_path / "margins.png").read_bytes()[:4] == b"\x89PNG"


def test_names_make_files_of_their_own(run, tmp_path):
    files = [run.row_file(tmp_path, area, name) for area in AREAS for name in cases(area)]
    assert len(set(files)) == len(files)


def test_the_committed_table_is_of_these_cases():
    """Every case is in it with the limit it has now, and its result follows from its numbers."""
    with (FOLDER / "table.csv").open() as stream:
        table = {(row["area"], row["name"]): row for row in csv.DictReader(stream)}
    for area in AREAS:
        for name, known in cases(area).items():
            row = table[area, name]
            assert float(row["limit"]) == pytest.approx(known.limit, rel=1e-5)
            assert (row["result"] == "pass") == (float(row["margin"]) >= 0.0)
