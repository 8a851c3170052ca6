"""Which files `sgns check` reads, and what it says of them."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from synthetic import make_run

from sgns.check import main, run_files
from sgns.errors import UserError


def test_a_dataset_stands_for_its_runs_in_order(tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir()
    for name in ("b.h5", "a.h5", ".a.h5.123", ".half.h5", "notes.txt"):
        (tmp_path / "runs" / name).touch()
    (tmp_path / "basis.h5").touch()
    expected = [tmp_path / "runs/a.h5", tmp_path / "runs/b.h5"]
    assert run_files([tmp_path]) == run_files([tmp_path / "runs"]) == expected
    assert run_files([expected[1], expected[0]]) == expected[::-1]


def test_what_cannot_be_checked_is_said(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="holds no run file"):
        run_files([tmp_path])
    with pytest.raises(UserError, match="no such file"):
        run_files([tmp_path / "nope.h5"])
    with pytest.raises(UserError, match="nothing to check"):
        run_files([])


def test_good_files_are_good(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    make_run(tmp_path / "run.h5")
    with caplog.at_level(logging.INFO):
        assert main(OmegaConf.create({"files": str(tmp_path / "run.h5")})) == 0
    assert caplog.messages == [f"{tmp_path / 'run.h5'}: good"]


def test_every_file_is_read_before_a_bad_one_is_reported(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    make_run(tmp_path / "good.h5")
    (tmp_path / "bad.h5").write_bytes(b"not HDF5")
    with caplog.at_level(logging.INFO), pytest.raises(UserError, match="1 of 2 files checked is not good"):
        main(OmegaConf.create({"files": [str(tmp_path / "bad.h5"), str(tmp_path / "good.h5")]}))
    assert caplog.messages[-1] == f"{tmp_path / 'good.h5'}: good"
    assert caplog.messages[0].startswith(f"{tmp_path / 'bad.h5'}")
    assert caplog.messages[0].count("bad.h5") == 1
