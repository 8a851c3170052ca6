"""A dataset: a folder of runs that share a bed, drawn from a grid of scenes and split by run.

<folder>/dataset.yaml      what the runs are: base scene, draws, seed, split; written before the first run
<folder>/runs/<name>.h5    one run each; a run that is there is complete
"""

from __future__ import annotations

import itertools
import math
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from omegaconf import OmegaConf

from mpm_warp import Decision, Effects, Scene, SceneError
from sgns.claim import claimed
from sgns.errors import UserError
from sgns.scene_effects import decided
from sgns.settings import flattened
from sgns.smallfile import read_text
from sgns.wholefile import write_whole
from sgns.yaml_text import parse_yaml

__all__ = ["SPLITS", "Campaign", "Dataset", "plan"]

SPLITS = ("train", "validation", "test")
_MOST_BYTES = 1 << 26
"""Of dataset.yaml: thousands of scenes, or a hundred with a long path each."""


@dataclass(frozen=True)
class Campaign:
    """Runs to be made."""

    name: str
    path: Path
    scenes: dict[str, Scene]
    """Run name → scene."""
    split: dict[str, str]
    """Run name → train, validation or test."""
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

    def record(self) -> None:
        """Write dataset.yaml, or check that the folder's own says the same."""
        file = self.path / "dataset.yaml"
        try:
            while not file.exists():
                with claimed(
                    file
                ) as ours:  # of two campaigns that begin at once the second finds the first's
                    if ours and not file.exists():
                        write_whole(file, yaml.safe_dump(self.describe(), sort_keys=False))
                        return
                time.sleep(0.05)
        except OSError as error:
            raise UserError(f"cannot write {file}: {error.strerror}") from None
        there, here = _read(file), self.describe()
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
        raise UserError(f"{self.path} holds a dataset made with other settings; {advice}")

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
    for key in ("name", "path", "draw"):
        if settings.get(key) is None:
            raise UserError(f"dataset.{key} is missing; a campaign needs name, path and draw")
    combinations = _combinations(settings["draw"])
    count = settings.get("runs") or len(combinations)
    if not 3 <= count <= len(combinations):
        raise UserError(
            f"dataset.runs is {count}; allowed: 3 to {len(combinations)}, the combinations of dataset.draw"
        )
    rng = np.random.default_rng(seed)
    chosen = sorted(rng.choice(len(combinations), size=count, replace=False).tolist())
    scenes: dict[str, Scene] = {}
    grids: dict[int, list[str]] = {}
    for index in chosen:
        grid, values = combinations[index]
        data = OmegaConf.create(dict(base))
        for key, value in values.items():
            OmegaConf.update(data, key, value, force_add=True)
        plain = OmegaConf.to_container(data, resolve=True)
        if isinstance(plain.get("tool"), dict):
            plain["tool"].pop("digest", None)  # `draw` may name another file; these are the person's settings
        name = f"{index:04d}_" + "_".join(f"{key.split('.')[-1]}-{value}" for key, value in values.items())
        scenes[name] = Scene.from_dict(plain)
        grids.setdefault(grid, []).append(name)
    return Campaign(
        name=settings["name"],
        path=Path(settings["path"]),
        scenes=scenes,
        split=_split(list(grids.values()), settings.get("split", [0.8, 0.1, 0.1]), rng),
        effects=effects,
        precision=precision,
        seed=seed,
    )


def _combinations(draw: Any) -> list[tuple[int, dict[str, Any]]]:
    """Number of the grid and combination, for every combination of one grid (key → values) or of several."""
    combinations = []
    for number, grid in enumerate(draw if isinstance(draw, list) else [draw]):
        if not isinstance(grid, Mapping) or not grid:
            raise UserError(
                f"dataset.draw holds {grid!r}; it must be a grid, key: [values], or a list of such grids"
            )
        for key, values in grid.items():
            if not isinstance(values, list) or not values:
                raise UserError(f"dataset.draw.{key} is {values!r}; it must be a list of at least one value")
        products = itertools.product(*grid.values())
        combinations += [(number, dict(zip(grid, values, strict=True))) for values in products]
    return combinations


def _split(grids: list[list[str]], shares: list[float], rng: np.random.Generator) -> dict[str, str]:
    """Each name's part, by chance within each grid, so that every part has its share of every grid."""
    if len(shares) != 3 or min(shares) < 0 or abs(sum(shares) - 1.0) > 1e-6:
        raise UserError(
            f"dataset.split is {shares}; it needs three shares (train, validation, test) that sum to 1"
        )
    part = {}
    for names in grids:
        validation, test = (max(round(s * len(names)), 1 if s > 0 else 0) for s in shares[1:])
        for rank, index in enumerate(rng.permutation(len(names))):
            part[names[index]] = (
                "validation" if rank < validation else "test" if rank < validation + test else "train"
            )
    return {name: part[name] for names in grids for name in names}


@dataclass(frozen=True)
class Dataset:
    """A campaign's runs on disk."""

    name: str
    path: Path
    split: dict[str, list[str]]

    @classmethod
    def open(cls, folder: str | os.PathLike[str], where: Mapping[str, Any] | None = None) -> Dataset:
        """The dataset in a folder.

        Args:
            folder: its folder.
            where: only runs of scenes with these values: dotted key of the scene → value, or list of allowed values.

        Raises:
            UserError: there is none, or it is not complete.
        """
        path = Path(folder)
        file = path / "dataset.yaml"
        if not file.exists():
            raise UserError(
                f"no dataset in {path}: dataset.yaml is missing; make one: sgns simulate dataset=<name>"
            )
        content = _read(file)
        split = content.get("split") if isinstance(content, dict) else None
        if not isinstance(split, dict) or not all(_are_names(split.get(s)) for s in SPLITS):
            raise UserError(f"{file} has no split into {', '.join(SPLITS)}; it was not made by sgns simulate")
        split = {part: split[part] for part in SPLITS}
        if where:
            scenes = content.get("scenes")
            if not isinstance(scenes, dict) or not all(isinstance(scene, dict) for scene in scenes.values()):
                raise UserError(f"{file} does not say what the scenes are, which dataset.where asks for")
            split = _chosen(split, scenes, where, file)
        dataset = cls(name=str(content.get("name", path.name)), path=path, split=split)
        missing = [run for s in SPLITS for run in dataset.runs(s) if not os.path.exists(run)]
        if missing:
            raise UserError(
                f"runs of {path} are missing: {len(missing)}, the first is {missing[0].name}; finish the dataset: "
                f"sgns simulate dataset={dataset.name}"
            )
        return dataset

    def runs(self, split: str) -> list[Path]:
        """Files of one split: train, validation or test."""
        if split not in SPLITS:
            raise UserError(f"split is {split!r}; allowed: {', '.join(SPLITS)}")
        return [self.path / "runs" / f"{name}.h5" for name in self.split[split]]


def _overrides(wanted: Mapping[str, Any], here: Mapping[str, Any]) -> str:
    """What on the command line turns the effects asked for here into those wanted."""
    now = flattened(dict(here))
    changed = {key: value for key, value in flattened(dict(wanted)).items() if now.get(key) != value}
    return " ".join(f"effects.{key}={str(value).lower()}" for key, value in changed.items())


def _are_names(names: Any) -> bool:
    """Whether these are names of files in one folder."""
    return isinstance(names, list) and all(
        isinstance(name, str) and name and not set(name) & {"/", os.sep, "\0"} for name in names
    )


def _chosen(
    split: dict[str, list[str]], scenes: Mapping[str, Any], where: Mapping[str, Any], file: Path
) -> dict[str, list[str]]:
    """The part of a split whose scenes have the values asked for."""
    known = {name: flattened(scenes.get(name, {})) for names in split.values() for name in names}
    for key, value in flattened(dict(where)).items():
        allowed = list(value) if isinstance(value, Sequence) and not isinstance(value, str) else [value]
        if lacking := [name for name, scene in known.items() if key not in scene]:
            raise UserError(
                f"dataset.where names {key}, which the scene of {lacking[0]} in {file} does not have"
            )
        there = {name: scene[key] for name, scene in known.items()}
        known = {name: scene for name, scene in known.items() if any(_same(there[name], a) for a in allowed)}
        if not known:
            values = ", ".join(sorted(set(map(str, there.values()))))
            raise UserError(f"dataset.where leaves no run: {key} is {allowed}; in {file} it is {values}")
    return {part: [name for name in names if name in known] for part, names in split.items()}


def _same(a: Any, b: Any) -> bool:
    """Whether two values of a scene are equal, numbers to six digits."""
    if isinstance(a, (int, float)) and isinstance(b, (int, float)):
        return math.isclose(a, b, rel_tol=1e-6, abs_tol=1e-12)
    return bool(a == b)


def _read(file: Path) -> Any:
    advice = "repair it, or make the dataset in another folder"
    text = read_text(file, "no dataset", advice, _MOST_BYTES)
    try:
        return parse_yaml(text)
    except ValueError as error:
        raise UserError(f"cannot read {file}: {str(error).splitlines()[0]}; {advice}") from None
