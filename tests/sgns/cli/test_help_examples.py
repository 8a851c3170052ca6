"""The examples of the help pages run as they stand, on data so small that each takes a second."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
from pathlib import Path

import pytest

from mpm_warp import Effects
from sgns.cli.commands import COMMANDS
from sgns.config import Interrupted, heeded_signals
from sgns.data.run import Run
from sgns.simulate.run import simulate_scene
from sgns.simulate.scene import scene_from_config
from sgns_testing.commands import SMALL, TRAIN, call, composed, refused, sgns, small_dataset

REDUCED = Path(__file__).parents[3] / "reduced"

UNDRAWN = [word for word in SMALL if not word.startswith("scene.speed=")]  # the datasets draw it
# Settings that make an example small; they stand after its own.
FEW_STEPS = [word for word in TRAIN if not word.startswith("reduction.")]
FITTED_QUICKLY = ["training.noises=[0.1]", "training.penalties=[1e-3]", "training.threads=1"]
SMALLER = {
    "simulate": SMALL,
    "reduce": ["reduction.max_modes=6"],
    "train": ["dataset.path=data/quick", "reduction.max_modes=6"],
    "rollout": ["scene.duration=0.1", "scene.start=0.5"],
    "evaluate": ["dataset.path=data/quick"],
}
LONG = "export"
"""The command whose examples take ten seconds each."""
LEFT_OUT = {"frontier": "takes minutes: see tests/sgns/frontier", "submitit": "needs a cluster"}


pytestmark = pytest.mark.usefixtures("no_pictures")


def examples() -> list[str]:
    found = []
    for command in COMMANDS:
        page = call(command, "--help").stdout.partition("Examples:\n")[2].partition("\n\n")[0]
        found += [line.partition("  # ")[0].strip() for line in page.splitlines() if line.strip()]
    assert all(line.startswith("sgns ") for line in found) and len(found) > 15
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where a user has been at work: a dataset, a training, a run and one that was interrupted."""
    here = tmp_path_factory.mktemp("work")
    small_dataset(here / "data" / "quick")
    done = sgns(here, "train", "dataset=quick", *TRAIN, "output=outputs/first")
    assert done.returncode == 0, done.stderr
    assert sgns(here, "simulate", *SMALL, "output=run.h5").returncode == 0
    for name in ("arrays.npz", "arrays_1.npz", "arrays_2.npz", "arrays_3.npz"):
        assert sgns(here, "convert", "run.h5", name).returncode == 0
    scene, effects = scene_from_config(composed(*SMALL)), Effects()
    count = iter(range(100))

    def interrupt() -> None:
        if next(count) == 3:
            signal.raise_signal(signal.SIGTERM)  # a shell in the background ignores SIGINT

    with pytest.raises(Interrupted), heeded_signals():
        simulate_scene(
            scene, here / "run.h5", progress=interrupt, effects=effects, reasons=effects.described()
        )
    return here


def needed(folder: Path, here: Path, example: str) -> None:
    """Give `here` what the example reads, and nothing that it makes."""
    shutil.copytree(folder / "data", here / "data")
    if "dataset=quick_reduced" in example:
        shutil.copytree(REDUCED, here / "reduced")
    if "import arrays" in example or "import 'arrays" in example:
        for file in folder.glob("arrays*.npz"):
            shutil.copy(file, here)
    for name in re.findall(r"=(outputs/\w+)/best\.ckpt|(run[.\w]*\.h5)", example):
        if "output=" + "".join(name) not in example:
            source, place = folder / "".join(name), here / "".join(name)
            place.parent.mkdir(exist_ok=True)
            (shutil.copytree if source.is_dir() else shutil.copy)(source, place)


@pytest.mark.parametrize(
    "example",
    [pytest.param(one, marks=pytest.mark.long if one.split()[1] == LONG else ()) for one in examples()],
)
def test_examples_of_the_help_run(
    example: str, folder: Path, empty_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for word, reason in LEFT_OUT.items():
        if word in example:
            pytest.skip(reason)
    needed(folder, empty_folder, example)
    # The runs here move in three modes only.
    few = re.sub(r"num_modes=\d\S*", "num_modes=1,2" if " -m " in example else "num_modes=3", example)
    _, command, *words = shlex.split(few)
    smaller = list(SMALLER.get(command, []))
    if "dataset=quick" in words and command == "simulate":
        smaller = [*UNDRAWN, "dataset.runs=3", "dataset.path=data/made", "scene.start=0.5"]
    if command == "train":
        smaller += FITTED_QUICKLY if "model=polynomial" in words else FEW_STEPS
    if command in ("train", "reduce") and "num_modes" not in few:
        smaller += ["reduction.num_modes=3"]
    if "dataset=quick_reduced" in words:
        smaller = [word for word in smaller if not word.startswith("dataset.path=")]
    if any(word.startswith("continue_from=") for word in words):
        smaller = []
    if command == "view":  # which serves its page until Ctrl-C: tests/sgns/view
        monkeypatch.setattr("sgns.view.server.serve", served)
        shutil.copy(folder / "run.h5", empty_folder / "new.h5")
    done = call(command, *words, *smaller)
    assert done.returncode == 0, done.stderr


async def served(*_: object) -> None:
    """Nobody opens the page."""


def test_a_rollout_plays_the_scene_of_its_checkpoint(folder: Path) -> None:
    checkpoint = "checkpoint=outputs/first/best.ckpt"
    assert sgns(folder, "rollout", checkpoint, "scene.depth=0.03", "output=own.h5").returncode == 0
    with Run(folder / "own.h5") as run:
        expected = scene_from_config(composed(*SMALL, "scene.depth=0.03")).to_dict()
        assert run.scene == expected
    with Run(folder / "run.h5") as run:
        assert run.scene["depth"] != 0.03
    before = Path.cwd()
    os.chdir(folder)
    try:
        assert "scene.slip: no such key" in refused("rollout", checkpoint, "scene.slip=0.2")
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("HOME", str(folder))
            at_home = 'checkpoint="~/outputs/first/best.ckpt"'
            assert call("rollout", at_home, "output=home.h5").returncode == 0
        assert "bed is not the one" in refused("rollout", checkpoint, "scene=excavation", "output=other.h5")
    finally:
        os.chdir(before)


def test_a_command_ends_with_the_next_one(empty_folder: Path) -> None:
    dataset = ["dataset=quick", "dataset.path=data/a b"]
    made = call("simulate", *dataset, "dataset.runs=3", "scene.start=0.5", *UNDRAWN)
    assert made.stdout.endswith("next: sgns train dataset=quick 'dataset.path=data/a b'\n"), made.stderr
    for _ in range(2):  # also when nothing is left to do
        trained = call("train", *dataset, *TRAIN, "output=one")
        done = trained.stdout
        assert trained.returncode == 0, trained.stderr
        checkpoint = "checkpoint=one/best.ckpt"
        for words in (["evaluate", *map(shlex.quote, dataset), checkpoint], ["rollout", checkpoint]):
            assert f"sgns {' '.join(words)}" in done
    *_, one, other = (shlex.split(line.partition("sgns ")[2]) for line in done.splitlines())
    for command in (one, other):
        assert call(*command).returncode == 0


def test_a_sweep_over_checkpoints_plays_the_scene_of_each(folder: Path) -> None:
    shutil.copytree(folder / "outputs/first", folder / "outputs/second", dirs_exist_ok=True)
    checkpoints = [f"outputs/{name}/best.ckpt" for name in ("first", "second")]
    sweep = ["-m", f"checkpoint={','.join(checkpoints)}", "scene.depth=0.03", "output=swept.h5"]
    done = sgns(folder, "rollout", *sweep, "hydra.sweep.dir=swept")
    assert done.returncode == 0, done.stderr
    assert "of_checkpoint" not in done.stdout
    for number in range(2):
        with Run(folder / f"swept/{number}/swept.h5") as run:
            assert run.scene == scene_from_config(composed(*SMALL, "scene.depth=0.03")).to_dict()
    rows = [line.split(",") for line in (folder / "swept/sweep.csv").read_text().splitlines()]
    forces = ["mean_draft_N", "mean_vertical_force_N"]
    assert rows[0] == ["checkpoint", *forces, "output", "wall_s_per_simulated_s"]
    assert [row[0] for row in rows[1:]] == checkpoints


def test_finished_work_is_replaced_only_when_asked(folder: Path) -> None:
    cut = ["simulate", *SMALL, "output=cut.h5"]
    rollout = ["rollout", "checkpoint=outputs/first/best.ckpt", "output=cut.h5"]
    report = ["evaluate", "dataset.path=data/quick", "checkpoint=outputs/first/best.ckpt", "output=report"]
    table = ["reduce", "dataset.path=data/quick", "reduction.num_modes=3", "output=table"]
    assert sgns(folder, *cut).returncode == 0
    before = (folder / "cut.h5").read_bytes()
    for result in ("report/report.html", "table/energy.csv"):
        (folder / result).parent.mkdir()
        (folder / result).touch()
    for command in (cut, rollout, report, table):
        done = sgns(folder, *command)
        assert done.returncode == 2 and done.stderr.endswith(
            "is there already; choose another output, or replace it with overwrite=true\n"
        )
    assert (folder / "cut.h5").read_bytes() == before
    for command in (cut, rollout, report, table):
        done = sgns(folder, *command, "overwrite=true")
        assert done.returncode == 0, done.stderr
    assert (folder / "cut.h5").read_bytes() != before
    assert (folder / "report" / "report.html").stat().st_size and (
        folder / "table" / "energy.csv"
    ).stat().st_size
