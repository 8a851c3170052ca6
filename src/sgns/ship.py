"""Makes a checkpoint small enough to ship, and its model card: `python -m sgns.ship NAME EVALUATION [PACKED]`.

Run it in the folder where `sgns evaluate` ran, since the evaluation says which checkpoint it is of. An evaluation of a
packed dataset has no rollouts; then PACKED, the folder of that dataset, has the runs. What a rollout does not need is
left out; numbers are stored in single precision, modes in half precision where a rollout does not feel it.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import torch

from mpm_warp.poses import in_body_frame
from sgns.config import UserError, parse_yaml
from sgns.data.files import read_json, read_table, whole_file, write_whole
from sgns.data.run import Run
from sgns.model.checkpoint import (
    PRETRAINED,
    is_plain_name,
    pretrained_names,
    read_checkpoint,
    write_checkpoint,
)
from sgns.model.training_range import components
from sgns.numbers import counted
from sgns.reduction.packed import packed_dataset
from sgns.simulator import Simulator

MOST_BYTES = 4_000_000
MOST_LOSS = 0.01
"""Of storing fewer digits, share of the error that counts."""
_ERRORS = {
    "soil [mm]": "rmse_total_mm",
    "soil, if nothing moved [mm]": "rmse_frozen_mm",
    "surface [mm]": "surface_rmse_mm",
    "force [NRMSE]": "force_nrmse",
    "force, if always the mean [NRMSE]": "mean_force_nrmse",
    "mean draft [%]": "draft_abs_mpe_percent",
    "mean vertical force [%]": "vertical_abs_mpe_percent",
    "sinkage [mm]": "sinkage_mae_mm",
}
"""Columns of a card, from those of `metrics.csv`."""
_SHOWN = [words for words in _ERRORS if words.startswith(("soil", "force"))]
"""Of them in the documentation."""


class Loss(NamedTuple):
    """How far rollouts of the smaller checkpoint are from those of the whole one, over some runs."""

    soil: float  # RMS [mm]
    force: float  # RMS / RMS of the force [1]

    def words(self) -> str:
        return f"{self.soil:.2g} mm RMS of the soil and {100 * self.force:.2g} % of the force"


class ToolPath(NamedTuple):
    """What a simulator is told of a run."""

    poses: np.ndarray  # (T, 7)
    points: np.ndarray  # in the body frame [m], shape (M, 3)
    scene: Mapping[str, Any]  # as plain data


def ship(name: str, evaluation: Path, packed: Path | None = None) -> Path:
    """Write `<name>.ckpt` and `<name>.md` of an evaluated checkpoint into the package; returns the checkpoint's path.

    Args:
        name: What it is to be called.
        evaluation: Output of `sgns evaluate`.
        packed: Folder of the packed dataset that it is of; None: it is of a dataset with run files.

    Raises:
        UserError: That is not a complete evaluation, or the checkpoint is too large.
    """
    if not is_plain_name(name):
        raise UserError(f"{name!r} is no plain name; leave out folder and ending")
    wrong = "not of a complete evaluation", "evaluate with sgns evaluate"
    made = read_json(evaluation / "metrics.json", *wrong)["made"]
    rows = read_table(evaluation / "metrics.csv", *wrong)
    whole, target = Path(made["checkpoint"]), PRETRAINED / f"{name}.ckpt"
    content = read_checkpoint(whole)
    names = [row["run"] for row in rows[:-1]]
    paths = of_rollouts(evaluation / "rollouts", names) if packed is None else of_packed(packed, names)
    with TemporaryDirectory() as folder:  # until it is known to be good, nothing ships
        small = Path(folder) / target.name
        for modes in (torch.float16, torch.float32):
            write_checkpoint(smaller(content, modes), small)
            loss = measured_loss(whole, small, paths)
            share = max(
                loss.soil / float(rows[-1]["rmse_total_mm"]), loss.force / float(rows[-1]["force_nrmse"])
            )
            if share <= MOST_LOSS:
                break
        if (size := small.stat().st_size) > MOST_BYTES or share > MOST_LOSS:
            raise UserError(
                f"{whole} has {size / 1e6:.3g} MB with fewer digits, which cost {loss.words()}; at most "
                f"{MOST_BYTES / 1e6:g} MB and {100 * MOST_LOSS:g} % of the error can ship: train with fewer modes"
            )
        stored = f"modes in {'half' if modes == torch.float16 else 'single'} precision, the rest in single"
        digits = f"{stored}: {loss.words()}"
        text = card(small, evaluation, packed, content["hyper_parameters"], made, rows, digits)
        with whole_file(target) as hidden:
            hidden.write_bytes(small.read_bytes())
    write_whole(target.with_suffix(".md"), text)
    return target


def smaller(content: Mapping[str, Any], modes: torch.dtype) -> dict[str, Any]:
    """What of a checkpoint a rollout needs, with fewer digits."""
    state = dict(content["state_dict"])
    for key, value in state.items():
        if value.dtype == torch.float64:
            state[key] = value.to(modes if key == "surrogate.basis_modes" else torch.float32)
    return {"state_dict": state, "hyper_parameters": content["hyper_parameters"]}


def of_rollouts(folder: Path, names: Sequence[str]) -> list[ToolPath]:
    """The tools' paths of the rollouts that an evaluation has written."""
    found = []
    for name in names:
        with Run(folder / f"{name}.h5") as run:
            found.append(ToolPath(run.pose, in_body_frame(run.pose[0], run.body_points[0]), run.scene))
    return found


def of_packed(folder: Path, names: Sequence[str]) -> list[ToolPath]:
    """The tools' paths of these test runs of a packed dataset."""
    runs = {run.name: run for run in packed_dataset(folder, {"num_modes": 1}).runs("test")}
    if missing := [name for name in names if name not in runs]:
        raise UserError(f"{folder} has no test run {missing[0]}; name the packed dataset that was evaluated")
    known = (runs[name] for name in names)
    return [ToolPath(run.pose, in_body_frame(run.pose[0], run.body_points[0]), run.scene) for run in known]


def measured_loss(whole: Path, small: Path, paths: Sequence[ToolPath]) -> Loss:
    """Both checkpoints along the tool's paths of some runs, from the bed at rest."""
    simulators = [Simulator.load(whole), Simulator.load(small)]
    soil, force = [], []  # squares: of the difference, and what they are shares of
    for path in paths:
        one, other = (
            simulator.rollout(path.poses, path.points, values=path.scene) for simulator in simulators
        )
        for latents in zip(one.latent, other.latent, strict=True):
            a, b = (s.basis.inverse(latent) for s, latent in zip(simulators, latents, strict=True))
            soil.append(float((a - b).square().mean()))
        force.append((np.square(one.force - other.force).sum(), np.square(one.force).sum()))
    difference, size = np.sum(force, axis=0)
    return Loss(1e3 * float(np.mean(soil)) ** 0.5, float(difference / size) ** 0.5)


# --- The model card -------------------------------------------------------------------------------------


def card(
    target: Path,
    evaluation: Path,
    packed: Path | None,
    known: Mapping[str, Any],
    made: Mapping[str, str],
    rows: Sequence[Mapping[str, str]],
    digits: str,
) -> str:
    """The model card of a checkpoint; `known` is what it says of itself, `made` and `rows` are the evaluation's."""
    name, settings, scene = target.stem, known["settings"], known["scene"]
    trained, validation = len(known["basis"]["fitted_on"]), len(settings["validation_runs"])
    tested = len(rows) - 1
    particles = f"{len(read_checkpoint(target)['state_dict']['surrogate.start_positions'])} particles"
    steps = settings["training"].get("max_steps")
    facts = {
        "data": f"{settings['dataset']}: {trained} training, {validation} validation, {tested} test runs",
        "bed": f"{scene['kind']}, {' x '.join(f'{side:g}' for side in scene['bed']['size'])} m, {particles}, "
        f"{known['frame_rate']:g} Hz",
        "model": f"{known['model']['kind']}, {counted(known['num_modes'], 'mode')}, {known['model']['history']} frames "
        f"of history{f', {steps} steps' if steps else ''}",
        "file": f"{target.stat().st_size / 1e6:.2f} MB; {digits}",
        "versions": f"trained with sgns {known['package_version']}; evaluated with {made['package']}",
        "machine": f"{made['machine']}; {made['date']}",
    }
    columns = {words: key for words, key in _ERRORS.items() if any(row[key] for row in rows)}
    errors = [
        [row["run"], *(row[key] and f"{float(row[key]):.3g}" for key in columns.values())] for row in rows
    ]
    commands = [
        training_command(Path(made["checkpoint"]).parent, settings),
        made["command"],
        " ".join(["python -m sgns.ship", name, *(shlex.quote(str(p)) for p in (evaluation, packed) if p)]),
    ]
    lines = [
        f"# {name}",
        "",
        f'`sgns rollout checkpoint={name} output=new.h5`, or `sgns.Simulator.pretrained("{name}")`.',
        "",
        *markdown(["", ""], facts.items()),
        "",
        "## Errors on the test runs",
        "",
        *markdown(["run", *columns], errors),
        "",
        "## Range of the training runs",
        "",
        "Beyond it an answer is a guess. Lengths in m, angles in radians.",
        "",
        *markdown(["quantity", "from", "to"], ranges(known["training_range"])),
        "",
        "## How it was made",
        "",
        *(f"    {command}" for command in commands),
        "",
        "The last command has written this page.",
        "",
    ]
    return "\n".join(lines)


def ranges(known: Mapping[str, Mapping[str, Sequence[float]]]) -> list[tuple[str, ...]]:
    """Quantity, smallest and largest value in the training runs, but for the soil's and directions of axes."""
    return [
        (f"{name}{part}", f"{low + 0.0:.3g}", f"{high + 0.0:.3g}")
        for name, lows in known["low"].items()
        if not name.startswith("the soil's") and name != "the tool's orientation"
        for part, low, high in zip(components(name, len(lows)), lows, known["high"][name], strict=True)
    ]


def training_command(folder: Path, settings: Mapping[str, Any]) -> str:
    """The command of a training, as Hydra keeps it beside the checkpoint."""
    words = [f"dataset={settings['dataset']}", f"preset={settings['preset']}", f"output={folder}"]
    if (record := folder / ".hydra" / "overrides.yaml").is_file():
        words = parse_yaml(record.read_text(encoding="utf-8"))
    return shlex.join(["sgns", "train", *words])


def markdown(head: Sequence[str], rows: Any) -> list[str]:
    """The lines of a table."""
    return [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows)]


def table() -> str:
    """All that ship, from their cards, as the table of the documentation."""
    rows = []
    for name in pretrained_names():
        cells = [
            [cell.strip() for cell in line.strip("|").split("|")]
            for line in (PRETRAINED / f"{name}.md").read_text(encoding="utf-8").splitlines()
            if line.startswith("|")
        ]
        facts = {row[0]: row[1] for row in cells}
        head, errors = (next(row for row in cells if row[0] == first) for first in ("run", "all runs"))
        of = dict(zip(head, errors, strict=True))
        rows.append(
            [
                f"`{name}`",
                facts["data"],
                *(of.get(words, "") for words in _SHOWN),
                facts["file"].split(";")[0],
            ]
        )
    return "\n".join(markdown(["name", "data", *_SHOWN, "file"], rows)) if rows else "None ships yet."


if __name__ == "__main__":
    if not 3 <= len(sys.argv) <= 4:
        sys.exit("sgns.ship: give NAME, EVALUATION and, of a packed dataset, its folder")
    try:
        target = ship(sys.argv[1], *(Path(word) for word in sys.argv[2:4]))
        print(f"{target} and its card; for docs/learning.md:\n\n{table()}")
    except UserError as error:
        sys.exit(f"sgns.ship: {error}")
