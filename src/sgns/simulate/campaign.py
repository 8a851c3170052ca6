"""A campaign: a dataset's runs drawn from a grid of scenes, and what they cost."""

from __future__ import annotations

import csv
import glob
import heapq
import io
import itertools
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from mpm_warp import Decision, Effects, Scene, SceneError, substeps_per_frame
from mpm_warp.settings import short
from sgns.command_settings import Limits
from sgns.config import UserError, differences, flattened
from sgns.data.dataset import SPLITS, read_description
from sgns.data.files import file_lock, write_whole
from sgns.numbers import counted, duration_words
from sgns.settings import DatasetSettings
from sgns.simulate.scene import decided, replaced, scene_from_data

# --- What runs cost in work, time and disk, before and while they are made ------------------------------

# A recorded particle is a position and a velocity in float32, a body point a position in float64. The others are those
# of files: pose, force, torque, time and HDF5's own for each frame; scene and structure.
_BYTES_PER_PARTICLE = 24
_BYTES_PER_FRAME = 240
_BYTES_PER_BODY_POINT = 24
_BYTES_PER_FILE = 30_000
_BYTES_OF_STATE = 144  # of a computed particle, in float32
CORE_RATE = 1.0e7
"""Particle-steps per second on one core of a good CPU, which estimates assume (experiments/throughput)."""


@dataclass(frozen=True)
class RunCost:
    """What a run takes, whatever the machine."""

    particles: int
    """That the solver computes."""
    substeps: int
    """Between two frames."""
    frames: int
    """T."""
    size: int
    """Of the run file [bytes], to a few per cent."""

    @property
    def steps_per_frame(self) -> int:
        """Particle-steps between two frames."""
        return self.particles * self.substeps

    @property
    def particle_steps(self) -> int:
        """Particle-steps of the run."""
        return self.steps_per_frame * (self.frames - 1)

    @property
    def steps(self) -> int:
        """Of the run."""
        return self.substeps * (self.frames - 1)


def run_cost(scene: Scene, effects: Effects | None = None) -> RunCost:
    """The cost of a scene's run; without `effects` with all of the bed in its last state.

    Raises:
        SceneError: it is too large to be computed.
    """
    substeps = substeps_per_frame(scene)  # before its particles are made
    particles, stored = len(scene.initial_positions()), len(scene.stored)
    per_frame = (
        stored * _BYTES_PER_PARTICLE + len(scene.body_points()) * _BYTES_PER_BODY_POINT + _BYTES_PER_FRAME
    )
    frames = scene.frame_count
    computed = particles // 2 if effects is not None and effects.symmetry else particles
    size = frames * per_frame + computed * _BYTES_OF_STATE + _BYTES_PER_FILE
    return RunCost(computed, substeps, frames, size)


def cost_line(costs: Sequence[RunCost]) -> str:
    """What runs take in all, in words."""
    steps = sum(one.particle_steps for one in costs)
    work = "" if len(costs) > 1 else f"{costs[0].particles} particles in {costs[0].steps} steps: "
    size = size_words(sum(one.size for one in costs))
    return f"{work}about {duration_words(steps / CORE_RATE)} of one core and {size} of disk (estimated for a fast core)"


def require_limits(costs: Mapping[str, RunCost], limits: Limits) -> None:
    """Refuses to begin what takes longer, or more disk, than `limits` allow.

    Raises:
        UserError: the line names the limit.
    """
    longest = max(costs, key=lambda name: costs[name].particle_steps)
    size, run = sum(one.size for one in costs.values()), costs[longest]
    if run.particle_steps / CORE_RATE > limits.time * 86_400:
        raise UserError(
            f"{longest} takes {cost_line([run])}; limits.time is {limits.time:g} days: raise it, or use a larger "
            "scene.bed.spacing or a lower scene.duration"
        )
    if size > limits.disk * 1e9:
        raise UserError(
            f"the run files take about {size_words(size)}; limits.disk is {limits.disk:g} GB: raise it, or record "
            "fewer particles: scene.bed.store_every=5"
        )


def finishing_time(waiting: Sequence[float], running: Sequence[float], workers: int) -> float:
    """When the last job ends if every worker that becomes free takes the next one, in the unit of the jobs' lengths:
    those waiting, in their order, and what is left of those running, at most one for each worker."""
    free_at = [*running, *[0.0] * (workers - len(running))]
    heapq.heapify(free_at)
    for length in waiting:
        heapq.heapreplace(free_at, free_at[0] + length)
    return max(free_at)


def require_space(folder: Path, size: int) -> None:
    """Refuses to begin what the disk cannot take: files of this size [bytes] in a folder that need not exist yet.

    Raises:
        UserError: less than that is free.
    """
    there = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    free = shutil.disk_usage(there).free
    if size > free:
        raise UserError(
            f"{folder} needs {size_words(size)} of disk and {size_words(free)} are free; free some space, choose "
            "another folder, or record fewer particles: scene.bed.store_every=5"
        )


def size_words(size: float) -> str:
    """A number of bytes in decimal units, to two digits or more: 56 MB, 1.4 GB."""
    units = ["kB", "MB", "GB", "TB"]
    size /= 1000
    while size >= 999.5 and len(units) > 1:
        size /= 1000
        units.pop(0)
    return f"{size:.1f} {units[0]}" if size < 9.95 else f"{size:.0f} {units[0]}"


_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)  # long paths are many numbers

# --- A dataset: a folder of runs that share a bed, drawn from a grid of scenes and split by run ---------
# <folder>/dataset.yaml      what the runs are: base scene, draws, seed, split; written before the first run
# <folder>/runs.csv          the same for people: a line for each run with its part and what was drawn
# <folder>/runs/<name>.h5    one run each; a run that is there is complete


@dataclass(frozen=True)
class Campaign:
    """Runs to be made."""

    name: str
    path: Path
    scenes: dict[str, Scene]
    """Run name → scene."""
    split: dict[str, str]
    """Run name → train, validation or test."""
    drawn: dict[str, dict[str, Any]]
    """Run name → dotted key of the scene → value, as dataset.draw gives it; files by name."""
    effects: dict[str, Any]
    """What was asked for; scenes decide about what is `auto`, each for itself."""
    precision: str
    seed: int

    @cached_property
    def physics(self) -> dict[str, tuple[Effects, dict[str, Decision]]]:
        """Run name → its effects and the decision about each."""
        return {name: decided(scene, self.effects) for name, scene in self.scenes.items()}

    def describe(self) -> dict[str, Any]:
        """The contents of dataset.yaml."""
        return {
            "name": self.name,
            "seed": self.seed,
            "effects": dict(self.effects),
            "precision": self.precision,
            "split": {s: [n for n, where in self.split.items() if where == s] for s in SPLITS},
            "scenes": {name: scene.to_dict() for name, scene in self.scenes.items()},
        }

    def file(self, name: str) -> Path:
        """Where a run goes."""
        return self.path / "runs" / f"{name}.h5"

    def table(self) -> str:
        """The contents of runs.csv: a line for each run."""
        text = io.StringIO()
        keys = list(dict.fromkeys(key for values in self.drawn.values() for key in values))
        rows = csv.writer(text, lineterminator="\n")
        rows.writerow(["run", "split", *keys])
        for name, values in self.drawn.items():
            rows.writerow([name, self.split[name], *(values.get(key, "") for key in keys)])
        return text.getvalue()

    def record(self) -> None:
        """Write dataset.yaml and runs.csv, or check that the folder's own says the same."""
        file = self.path / "dataset.yaml"
        try:
            if not file.exists():
                # Of two campaigns that begin at once the second finds the first's.
                with file_lock(file, wait=True):
                    if not file.exists():
                        write_whole(self.path / "runs.csv", self.table())
                        write_whole(file, yaml.dump(self.describe(), Dumper=_DUMPER, sort_keys=False))
                        return
        except OSError as error:
            raise UserError(f"cannot write {file}: {error.strerror}") from None
        there, here = read_description(file), self.describe()
        if there == here:
            return
        advice = "give another dataset.path, or remove the folder to make this one"
        if isinstance(there, dict) and {**there, "effects": here["effects"]} == here:
            others = self._decided_otherwise(there.get("effects"))
            if others == 0:
                return
            if others:
                changed = _overrides(there["effects"], here["effects"])
                raise UserError(
                    f"{self.path} holds a dataset whose effects were asked for otherwise, so that {others} of its "
                    f"{len(self.scenes)} runs have other physics; {advice}"
                    + (f"; to go on with it: {changed}" if changed else "")
                )
        raise UserError(
            f"{self.path} holds a dataset made with other settings{_what_changed(there, here)}; {advice}"
        )

    def _decided_otherwise(self, asked: Any) -> int | None:
        """How many runs would have other effects if `asked` decided; None where it cannot.

        A dataset is its runs: a tolerance that has changed since, and decides all of them alike, makes no other one.
        """
        if not isinstance(asked, Mapping):
            return None
        try:
            return sum(
                decided(scene, asked)[0] != self.physics[name][0] for name, scene in self.scenes.items()
            )
        except (UserError, SceneError):
            return None


def _what_changed(there: Any, here: Mapping[str, Any]) -> str:
    """In what the contents of two dataset.yaml differ, in words: the first few settings."""
    scenes = there.get("scenes") if isinstance(there, Mapping) else None
    if not isinstance(scenes, Mapping) or not all(isinstance(one, Mapping) for one in scenes.values()):
        return ""
    own = {"dataset.name": "name", "seed": "seed", "solver.precision": "precision"}
    found = differences(*({key: one.get(name) for key, name in own.items()} for one in (there, here)))
    values = [_values(every) for every in (scenes, here["scenes"])]
    found |= {f"scene.{key}": pair for key, pair in differences(*values).items()}
    if not found and len(scenes) != len(here["scenes"]):
        found = {"the number of runs": (len(scenes), len(here["scenes"]))}
    elif not found and there.get("split") != here["split"]:
        found = {"dataset.split": (None, None)}
    words = [
        f"{key} is {_words(old)} there and {_words(new)} here"
        if _words(old) != _words(new)
        else f"{key} is another"
        for key, (old, new) in found.items()
    ]
    more = f" and {len(words) - 3} more" if len(words) > 3 else ""
    return f": {', '.join(words[:3])}{more}" if words else ""


def _values(scenes: Mapping[str, Any]) -> dict[str, list[str]]:
    """Dotted key → all values that the scenes have there."""
    values: dict[str, set[str]] = {}
    for scene in scenes.values():
        for key, value in flattened(scene).items():
            values.setdefault(key, set()).add(repr(value))
    return {key: sorted(every) for key, every in values.items()}


def _words(value: Any) -> str:
    """In few characters."""
    if not isinstance(value, list):
        return short(value)
    text = ", ".join(value)
    return text if len(text) <= _LONGEST_NAME else counted(len(value), "value")


def plan(
    settings: Mapping[str, Any], base: Mapping[str, Any], effects: dict[str, Any], precision: str, seed: int
) -> Campaign:
    """The runs of a campaign.

    Args:
        settings: the `dataset` group: name, path, draw, runs, split.
        base: a scene as nested data; `draw` replaces values in it.
        effects: which physics is asked for: effect → true, false or auto, and the group `tolerance`.
        precision: float32 or float64.
        seed: of the drawn combinations and the split.
    """
    asked = DatasetSettings.from_dict(settings)
    for key in ("name", "path", "draw"):
        if not getattr(asked, key):
            raise UserError(f"dataset.{key} is missing; a campaign needs name, path and draw")
    combinations = _combinations(asked.draw)
    count = asked.runs or len(combinations)
    if len(combinations) < 3:
        raise UserError(f"dataset.draw gives {len(combinations)} runs; a campaign needs 3 or more")
    if not 3 <= count <= len(combinations):
        raise UserError(
            f"dataset.runs is {count}, as given or as dataset={asked.name} has it; allowed: 3 to {len(combinations)}, "
            "the combinations of dataset.draw; dataset.runs=null takes all of them"
        )
    rng = np.random.default_rng(seed)
    chosen = sorted(rng.choice(len(combinations), size=count, replace=False).tolist())
    scenes: dict[str, Scene] = {}
    drawn: dict[str, dict[str, Any]] = {}
    grids: dict[int, list[str]] = {}
    for index in chosen:
        grid, values = combinations[index]
        data = replaced(base, values)
        if isinstance(data.get("tool"), dict):
            data["tool"].pop("digest", None)  # `draw` may name another file; these are the person's settings
        if missing := sorted(key for key, value in flattened(data).items() if value == "???"):
            raise UserError(
                f"scene.{missing[0]} is missing; give it, or its values in dataset.draw, such as {_EXAMPLE}"
            )
        name = _run_name(index, values)
        scenes[name], drawn[name] = scene_from_data(data), values
        grids.setdefault(grid, []).append(name)
    return Campaign(
        name=asked.name,
        path=Path(asked.path),
        scenes=scenes,
        drawn=drawn,
        split=split_runs(list(grids.values()), asked.split, rng),
        effects=effects,
        precision=precision,
        seed=seed,
    )


_FILES = ("path", "tool.file")
"""Keys of a scene whose values are files; draws may give them by pattern."""
_EXAMPLE = "{path: paths/*.csv}"
_LONGEST_NAME = 100


def _run_name(index: int, values: Mapping[str, Any]) -> str:
    """A run's name: its number among all combinations, and what it is if that is short."""
    words = [
        f"{key.split('.')[-1]}-{Path(value).stem if key in _FILES and isinstance(value, str) else value}"
        for key, value in values.items()
    ]
    name = "_".join([f"{index:04d}", *words])
    plain = name.isprintable() and not set(name) & set("/\\")
    return name if plain and len(name.encode()) <= _LONGEST_NAME else f"{index:04d}"


def _combinations(draw: Any) -> list[tuple[int, dict[str, Any]]]:
    """Number of the grid and combination, for every combination of one grid (key → values) or of several."""
    combinations = []
    for number, grid in enumerate(draw if isinstance(draw, list) else [draw]):
        drawn = {str(key).removeprefix("scene."): _drawn(key, values) for key, values in grid.items()}
        products = itertools.product(*drawn.values())
        combinations += [(number, dict(zip(drawn, values, strict=True))) for values in products]
    return combinations


def _drawn(key: Any, values: Any) -> list[Any]:
    """The values of a key of a grid; patterns of files as the files that fit them, in the order of their names."""
    of_files = str(key).removeprefix("scene.") in _FILES
    if of_files and isinstance(values, str):
        values = [values]
    if isinstance(values, str):
        raise UserError(f"dataset.draw.{key} is {values!r}; it must be a list of at least one value")
    if not of_files:
        return values
    found: list[Any] = []
    for value in values:
        if not isinstance(value, str) or Path(value).exists() or not glob.has_magic(value):
            found.append(value)
        elif files := sorted(glob.glob(value, recursive=True)):
            found += files
        else:
            raise UserError(f"dataset.draw.{key} is {value}; no file in {Path.cwd()} fits this pattern")
    return found


def split_runs(grids: list[list[str]], shares: tuple[float, ...], rng: np.random.Generator) -> dict[str, str]:
    """Each name's part, by chance within each grid, so that every part has its share of every grid."""
    part = {}
    for names in grids:
        validation, test = (max(round(s * len(names)), 1 if s > 0 else 0) for s in shares[1:])
        if len(grids) == 1 and shares[0] > 0:  # of few runs one is trained on
            validation = min(validation, len(names) - 1)
            test = min(test, len(names) - 1 - validation)
        for rank, index in enumerate(rng.permutation(len(names))):
            part[names[index]] = (
                "validation" if rank < validation else "test" if rank < validation + test else "train"
            )
    if len(grids) > 1 and "train" not in part.values():  # a few runs of many grids
        return split_runs([[name for names in grids for name in names]], shares, rng)
    return {name: part[name] for names in grids for name in names}


def _overrides(wanted: Mapping[str, Any], here: Mapping[str, Any]) -> str:
    """What on the command line turns the effects asked for here into those wanted."""
    now = flattened(dict(here))
    changed = {key: value for key, value in flattened(dict(wanted)).items() if now.get(key) != value}
    return " ".join(f"effects.{key}={str(value).lower()}" for key, value in changed.items())
