"""Checkpoints that ship with the package: found by name, made small, described by their card."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch

from sgns import Run, Simulator, UserError, ship
from sgns.data.check import check_run
from sgns.model import checkpoint
from sgns_testing.commands import TRAIN, call, refused, sgns, small_dataset

ROOT = Path(__file__).resolve().parents[2]
SHIPPED = checkpoint.PRETRAINED
MOST = 20_000_000  # bytes of all together


def let_ship_from(patch: pytest.MonkeyPatch, folder: Path) -> None:
    for module in (checkpoint, ship):
        patch.setattr(module, "PRETRAINED", folder)


class Work(NamedTuple):
    """A folder where a small checkpoint was trained, evaluated and made to ship, and where it ships from."""

    here: Path
    shipped: Path


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Work:
    here, shipped = tmp_path_factory.mktemp("work"), tmp_path_factory.mktemp("pretrained")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sgns.evaluate.report.report_figures", lambda evaluation: [])
        let_ship_from(patch, shipped)
        small_dataset(here / "data" / "quick")
        for words in (
            ["train", *TRAIN, "output=out"],
            ["evaluate", "checkpoint=out/best.ckpt", "output=report"],
        ):
            done = sgns(here, *words)
            assert done.returncode == 0, done.stderr
        patch.chdir(here)
        assert ship.ship("small", Path("report")) == shipped / "small.ckpt"
    return Work(here, shipped)


@pytest.fixture(autouse=True)
def _ships(work: Work, monkeypatch: pytest.MonkeyPatch) -> None:
    let_ship_from(monkeypatch, work.shipped)


def test_it_rolls_out_by_its_name_in_an_empty_folder(work: Work, empty_folder: Path) -> None:
    done = call("rollout", "checkpoint=small", "output=new.h5")
    assert done.returncode == 0, done.stderr
    assert check_run("new.h5") == []
    with Run("new.h5") as run:
        assert run.extra["checkpoint"] == "small"
    assert call("plot", "new.h5").returncode == 0 and Path("new.png").is_file()


def test_it_steps_as_the_whole_one_does(work: Work) -> None:
    whole, small = Simulator.load(work.here / "out/best.ckpt"), Simulator.pretrained("small", num_modes=2)
    assert small.num_modes == 2
    small = Simulator.pretrained("small")
    poses = np.tile([0.2, 0.1, 0.06, 0.0, 0.0, 0.0, 1.0], (10, 1))
    a, b = (simulator.rollout(poses) for simulator in (whole, small))
    np.testing.assert_allclose(b.latent, a.latent, atol=1e-4)
    np.testing.assert_allclose(b.force, a.force, rtol=1e-3, atol=1e-3)
    assert (work.shipped / "small.ckpt").stat().st_size < 0.5 * (work.here / "out/best.ckpt").stat().st_size


def test_evaluate_and_train_take_the_name(
    work: Work, no_pictures: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(work.here)
    Path("training.json").write_text("of another training")  # in the folder of a plain name
    done = call("evaluate", "checkpoint=small", "output=again")
    assert done.returncode == 0, done.stderr
    done = call("train", *TRAIN, "checkpoint=small", "output=further")
    assert done.returncode == 0, done.stderr
    Path("training.json").unlink()


def test_a_file_goes_before_a_name_and_a_name_before_a_folder(work: Work, empty_folder: Path) -> None:
    Path("small").mkdir()
    shutil.copy(work.here / "out/best.ckpt", "small")
    assert checkpoint.checkpoint_file("small") == work.shipped / "small.ckpt"
    assert checkpoint.checkpoint_file("./small") == Path("small")
    assert checkpoint.checkpoint_file("small.ckpt") == Path("small.ckpt")
    shutil.rmtree("small")
    Path("small").touch()
    assert checkpoint.checkpoint_file("small") == Path("small")


def test_unknown_names_are_refused_with_those_that_ship(empty_folder: Path) -> None:
    said = refused("rollout", "checkpoint=smal", "output=new.h5")
    assert "no checkpoint at smal; with the package ship: small; train one" in said
    assert "package ship" not in refused("rollout", "checkpoint=smal.ckpt", "output=new.h5")
    with pytest.raises(
        UserError, match="no pretrained checkpoint is called 'smal'; with the package ship: small"
    ):
        Simulator.pretrained("smal")


def test_what_is_too_large_or_loses_too_much_does_not_ship(
    work: Work, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(work.here)
    with monkeypatch.context() as patch:
        patch.setattr(ship, "MOST_BYTES", 1000)
        with pytest.raises(
            UserError, match=r"MB with fewer digits, .* at most 0.001 MB .*: train with fewer modes"
        ):
            ship.ship("large", Path("report"))
        before = (work.shipped / "small.ckpt").read_bytes()
        with pytest.raises(UserError, match="train with fewer modes"):
            ship.ship("small", Path("report"))
        assert (work.shipped / "small.ckpt").read_bytes() == before
    monkeypatch.setattr(ship, "MOST_LOSS", 0.0)
    with pytest.raises(UserError, match=r"which cost .* mm RMS of the soil"):
        ship.ship("large", Path("report"))
    with pytest.raises(UserError, match="'a/b' is no plain name"):
        ship.ship("a/b", Path("report"))
    with pytest.raises(UserError, match="evaluate with sgns evaluate"):
        ship.ship("large", Path("nowhere"))
    assert checkpoint.pretrained_names() == ["small"]


def test_modes_are_stored_in_half_precision_where_nobody_feels_it(work: Work) -> None:
    state = torch.load(work.shipped / "small.ckpt", weights_only=True)["state_dict"]
    kinds = {value.dtype for name, value in state.items() if name != "surrogate.basis_modes"}
    assert state["surrogate.basis_modes"].dtype == torch.float16 and kinds == {torch.float32}


def test_the_card_says_what_it_is_made_of(work: Work) -> None:
    card = (work.shipped / "small.md").read_text()
    for words in (
        "| data | quick: 4 training, 2 validation, 1 test runs |",
        "modes in half precision, the rest in single: ",
        "| all runs |",
        "| the tool's position (x) |",
        f"    sgns train {' '.join(TRAIN)} output=out\n",
        "    sgns evaluate checkpoint=out/best.ckpt output=report\n",
        "    python -m sgns.ship small report\n",
        "trained with sgns ",
    ):
        assert words in card, words
    row = ship.table().splitlines()[2]
    assert row.startswith("| `small` | quick: 4 training, 2 validation, 1 test runs | ") and row.endswith(
        " MB |"
    )


def test_the_table_of_the_documentation_is_that_of_the_cards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    assert f"\n\n{ship.table()}\n\n" in (ROOT / "docs/learning.md").read_text(encoding="utf-8")
    sizes = [
        (checkpoint.PRETRAINED / f"{name}.ckpt").stat().st_size for name in checkpoint.pretrained_names()
    ]
    assert all(size <= ship.MOST_BYTES for size in sizes) and sum(sizes) <= MOST


@pytest.mark.parametrize("name", checkpoint.pretrained_names())
def test_what_ships_rolls_out(name: str, empty_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    let_ship_from(monkeypatch, SHIPPED)
    done = call("rollout", f"checkpoint={name}", "scene.duration=0.5", "output=new.h5")
    assert done.returncode == 0, done.stderr


def test_the_test_runs_of_a_packed_dataset_are_compared() -> None:
    folder, name = ROOT / "reduced" / "quick", "0001_motion-curved_rake-0.0_depth-0.04_speed-0.08"
    [path] = ship.of_packed(folder, [name])
    assert path.poses.shape[1:] == (7,) and path.points.shape[1:] == (3,)
    assert path.scene["depth"] == 0.04
    with pytest.raises(UserError, match="has no test run other; name the packed dataset"):
        ship.of_packed(folder, [name, "other"])


@pytest.mark.parametrize(
    ("name", "packed", "soil", "force"),
    [
        ("excavation", "quick", 2.03, 0.171),
        pytest.param("paper_excavation", "paper_excavation", 3.31, 0.1005, marks=pytest.mark.long),
    ],
)
def test_what_ships_is_as_good_as_its_card_says(
    name: str, packed: str, soil: float, force: float, empty_folder: Path
) -> None:
    """On the packed test runs of the dataset that it was trained on."""
    file = ROOT / "src" / "sgns" / "pretrained" / f"{name}.ckpt"
    words = [
        f"dataset={packed}_reduced",
        f"dataset.path={ROOT / 'reduced' / packed}",
        f"checkpoint={file}",
        "output=report",
    ]
    assert call("evaluate", *words).returncode == 0
    total = json.loads(Path("report/metrics.json").read_text())["aggregate"]
    assert total["rmse_total_mm"] == pytest.approx(soil, abs=0.02)
    assert total["force_nrmse"] == pytest.approx(force, abs=0.002)
