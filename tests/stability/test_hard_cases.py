"""The hard cases of `make stability`: the quick ones, what they measure, and what is made of the measurements."""

import json
import math
import subprocess
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import run
from common import read_rows
from hard_cases import AREAS, Case, cases
from hard_cases.measures import (
    blade_force,
    energies,
    refused,
    shares,
    stopped_with,
    volume_gain,
    work_on_soil,
)

from mpm_warp import Bed, Frame, Scene, SceneError
from sgns_testing.scenes import cut

QUICK = [(area, name) for area in AREAS for name, case in cases(area).items() if case.quick]


@pytest.mark.parametrize(("area", "name"), QUICK)
def test_quick_case(area, name):
    row = cases(area)[name].run(area)
    assert row.passed, f"{row.quantity}: {row.measured:.4g} {row.unit}, limit {row.limit:g}; {row.note}"


def case(**changes) -> Case:
    return replace(Case("a case", "hard", "must", "quantity", 2.0, "mm", lambda: (1.0, "a note")), **changes)


@pytest.mark.parametrize(
    ("value", "limit", "passed", "margin"),
    [
        *((1.0, 2.0, True, 0.5), (2.0, 2.0, True, 0.0), (3.0, 2.0, False, -0.5)),
        *((0.0, 0.0, True, 0.0), (1.0, 0.0, False, -math.inf)),  # a limit of zero allows nothing
        *((math.nan, 2.0, False, math.nan), (math.inf, 2.0, False, -math.inf), (-1.0, 2.0, False, 1.5)),
    ],
)
def test_margin(value, limit, passed, margin):
    row = case(measure=lambda: value, limit=limit).run("x")
    assert (row.passed, row.margin) == (passed, pytest.approx(margin, nan_ok=True))


def test_a_measurement_that_breaks_down_fails_and_says_why():
    row = case(measure=lambda: [][1]).run("x")
    assert not row.passed
    assert math.isnan(row.measured)
    assert row.note.startswith("IndexError")


# --- what is measured ------------------------------------------------------------------------------------


def frame(position, velocity=None, x=0.0, z=0.0, force=(0.0, 0.0, 0.0)) -> Frame:
    soil = np.asarray(position, dtype=np.float32)
    moving = np.zeros_like(soil) if velocity is None else np.asarray(velocity, dtype=np.float32)
    return Frame(
        index=0, time=0.0, position=soil, velocity=moving, body_pose=np.array([x, 0, z, 0, 0, 0, 1.0]),
        body_points=np.zeros((0, 3)), force=np.array(force), torque=np.zeros(3),
    )  # fmt: skip


@pytest.mark.parametrize(("count", "depth"), [(1.0, 0.24), (8.0, 0.24), (1.0, 0.15), (4.0, 0.15)])
def test_volume_gain(count, depth):
    """A full bed has gained nothing, also one of 7.5 cells; one with a tenth of its particles taken out has gained a
    ninth."""
    scene = Scene(bed=Bed(size=(0.4, 0.4, depth), spacing=0.02, particles_per_cell=count))
    soil = scene.initial_positions()
    assert volume_gain(scene, soil) == pytest.approx(0.0, abs=0.002)
    kept = np.random.default_rng(0).random(len(soil)) > 0.1
    assert volume_gain(scene, soil[kept]) == pytest.approx(1 / 9, abs=0.03)
    doubled = np.concatenate([soil, soil])
    assert volume_gain(scene, doubled) == pytest.approx(-0.5, abs=0.002)


def test_volume_gain_needs_soil():
    with pytest.raises(ValueError, match="surrounded"):
        volume_gain(Scene(bed=Bed(size=(0.4, 0.4, 0.24), spacing=0.02)), np.zeros((1, 3)))


def test_energies_and_work():
    """A particle that falls from the surface to the floor keeps its energy."""
    scene = Scene(bed=Bed(size=(0.4, 0.4, 0.2), spacing=0.02))
    speed = math.sqrt(2.0 * scene.gravity * 0.2)
    found = energies(scene, [frame([[0, 0, 0.0]]), frame([[0, 0, -0.2]], [[0, 0, -speed]])])
    assert found[0] > 0.0
    assert found[1] == pytest.approx(found[0], rel=1e-5)
    # The soil pushes back with 2 N over 3 m.
    work = work_on_soil([frame([[0, 0, 0]]), frame([[0, 0, 0]], x=3.0, force=(-2.0, 5.0, 0.0))])
    np.testing.assert_allclose(work, [0.0, 6.0])


def test_shares():
    value, words = shares({"force": (3.0, 4.0, "N"), "leak": (-1.0, 2.0, "%")})
    assert value == 0.75
    assert words == "force 3 of 4 N; leak -1 of 2 %"
    assert math.isnan(shares({"force": (math.nan, 4.0, "N"), "leak": (1.0, 2.0, "%")})[0])


def test_blade_force_grows_with_depth():
    deep, deeper = (blade_force(cut(), [frame([[0, 0, 0]], z=height)]) for height in (0.06, 0.04))
    assert 0.0 < deep < deeper


def test_refused_and_stopped():
    def refuse():
        raise SceneError("too small")

    assert refused(refuse, "small") == (0.0, "too small")
    assert refused(refuse, "large")[0] == 1.0
    assert refused(lambda: None, "small")[0] == 1.0
    assert stopped_with(cut(duration=0.05), "anything") == (1.0, "it went on to the end")


# --- rows, table and figure ------------------------------------------------------------------------------


def test_a_row_is_measured_again_when_its_case_changes(tmp_path):
    file = tmp_path / "row.json"
    assert run.stored(file, case()) is None
    row = case().run("area")
    run.keep(file, row)
    assert run.stored(file, case()) == row
    assert run.stored(file, case(limit=1.0)) is None
    assert run.stored(file, case(must="something else")) is None
    file.write_text(json.dumps(asdict(row))[:-20])  # cut short
    assert run.stored(file, case()) is None


def test_a_process_that_dies_is_a_failed_case(tmp_path, monkeypatch):
    died = subprocess.CompletedProcess([], -11, stderr="segmentation\nfault")
    monkeypatch.setattr(run.subprocess, "run", lambda *_, **__: died)
    row = run.measure("area", case(), tmp_path)
    assert not row.passed
    assert row.note == "the process ended with status -11: segmentation fault"
    again = run.stored(run.row_file(tmp_path, "area", "a case"), case())
    assert again.note == row.note and math.isnan(again.measured)


def test_table_and_figure(tmp_path):
    values = (1.0, 3.0, 0.0, math.nan)
    rows = [case(measure=lambda v=v: v).run(area) for v in values for area in ("one", "two")]
    rows.append(case(limit=0.0, measure=lambda: 1.0).run("two"))
    run.write_table(tmp_path / "table.csv", rows)
    found = read_rows(tmp_path / "table.csv")
    assert [row["result"] for row in found[::2]] == ["pass", "fail", "pass", "fail", "fail"]
    assert found[0]["margin"] == "0.500"
    run.draw(rows, tmp_path / "margins.png")
    assert (tmp_path / "margins.png").read_bytes()[:4] == b"\x89PNG"


def test_names_make_files_of_their_own(tmp_path):
    files = [run.row_file(tmp_path, area, name) for area in AREAS for name in cases(area)]
    assert len(set(files)) == len(files)


def test_the_committed_table_is_of_these_cases():
    """Every case is in it with the limit it has now, and its result follows from its numbers."""
    table = {(row["area"], row["name"]): row for row in read_rows(Path(run.__file__).with_name("table.csv"))}
    for area in AREAS:
        for name, known in cases(area).items():
            row = table[area, name]
            assert float(row["limit"]) == pytest.approx(known.limit, rel=1e-5)
            assert (row["result"] == "pass") == (float(row["margin"]) >= 0.0)
