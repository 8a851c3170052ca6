"""A dataset: a folder of runs that share a bed, split by run."""

from __future__ import annotations

import math
import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpm_warp.settings import short_repr
from sgns.config import UserError, flattened, parse_yaml
from sgns.data.files import read_text

SPLITS = ("train", "validation", "test")
IMPORTED = "imported"
"""Name of datasets whose runs are from another simulator."""
_MOST_BYTES = 1 << 26
"""Of dataset.yaml: thousands of scenes, or a hundred with a long path each."""


@dataclass(frozen=True)
class Dataset:
    """A campaign's runs on disk."""

    __repr__ = short_repr

    name: str
    path: Path
    split: dict[str, list[str]]

    @property
    def title(self) -> str:
        """What it is called: by its folder. One of another name was made from the settings of `name`, with others."""
        return self.path.resolve().name or self.name

    @property
    def command(self) -> str:
        """What makes it; what was changed in its settings is not known."""
        if self.name == IMPORTED:
            return f"sgns import ... {shlex.quote(str(self.path))}"
        place = "" if self.title == self.name else f" dataset.path={shlex.quote(str(self.path))}"
        return f"sgns simulate dataset={self.name}{place}"

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
                f"no dataset in {path}: dataset.yaml is missing; make one (sgns simulate dataset=<name>), or name "
                "another: dataset=<name> or dataset.path=<folder>"
            )
        content = read_description(file)
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
                f"runs of {path} are missing: {len(missing)}, the first is {missing[0].name}; finish the dataset "
                f"with the command that began it: {dataset.command} ..."
            )
        return dataset

    def runs(self, split: str) -> list[Path]:
        """Files of one split: train, validation or test."""
        if split not in SPLITS:
            raise UserError(f"split is {split!r}; allowed: {', '.join(SPLITS)}")
        return [self.path / "runs" / f"{name}.h5" for name in self.split[split]]


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


def read_description(file: Path) -> Any:
    """Content of a dataset.yaml."""
    advice = "repair it, or make the dataset in another folder"
    text = read_text(file, "no dataset", advice, _MOST_BYTES)
    try:
        return parse_yaml(text)
    except ValueError as error:
        raise UserError(f"cannot read {file}: {str(error).splitlines()[0]}; {advice}") from None
