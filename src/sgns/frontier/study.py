"""What a study measures: its scenes, the cases each scene is judged on, and the points of its axes."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import yaml

from mpm_warp import Scene
from sgns.errors import UserError
from sgns.frontier.store import Store
from sgns.frontier.timing import composed_scene
from sgns.smallfile import read_text
from sgns.wholefile import write_whole
from sgns.yaml_text import parse_yaml

__all__ = ["AXES", "PointSettings", "Study", "StudyScene"]

AXES = ("solver", "reduction", "surrogate")
"""Groups of points that one command, or one process of several, measures."""

BANDS = ("force_nrmse", "position_rmse_mm", "surface_rmse_mm", "sinkage_error_mm")


@dataclass(frozen=True)
class PointSettings:
    """One entry of an axis in conf/study: what makes a point."""

    axis: str
    label: str
    set: tuple[str, ...] = ()
    """Overrides: of `sgns simulate` for the solver, of `sgns train` for surrogates."""
    paper: bool = False
    """It is an operating point of the paper."""
    more: Mapping[str, Any] | None = None
    """Further keys that only one axis knows."""

    @classmethod
    def from_dict(cls, data: Any, where: str) -> PointSettings:
        """From an entry of conf/study.

        Raises:
            UserError: it has no axis or no label.
        """
        if not isinstance(data, Mapping) or not data.get("axis") or not data.get("label"):
            raise UserError(f"{where} holds {data!r}; every point needs axis and label, and set: [overrides]")
        known = {key: data[key] for key in ("axis", "label", "paper") if key in data}
        changes = tuple(map(str, data.get("set") or ()))
        more = {key: value for key, value in data.items() if key not in (*known, "set")}
        return cls(**known, set=changes, more=more)


@dataclass(frozen=True)
class StudyScene:
    """One figure: a kind of scene, and the runs that every point of it is judged on."""

    name: str
    settings: Mapping[str, Any]

    @property
    def dataset(self) -> str:
        """Option of the group `dataset` that surrogates learn from; the cases are among its test runs."""
        return str(self.settings["dataset"])

    @property
    def bands(self) -> dict[str, float]:
        """Column of errors → how wrong the reference itself may be; no point can be shown to be better."""
        return {key: float(value) for key, value in (self.settings.get("bands") or {}).items()}

    @property
    def cases(self) -> dict[str, list[str]]:
        """Case → overrides of `sgns simulate` that make it with the settings of the dataset."""
        return {
            name: [f"scene={self.settings['scene']}", *map(str, changes)]
            for name, changes in self.settings["cases"].items()
        }

    def case_scene(self, case: str) -> Scene:
        """The scene of a case as in the dataset."""
        return composed_scene(self.cases[case])[0]

    @cached_property
    def free_body(self) -> bool:
        """Whether the soil carries the body."""
        return self.case_scene(next(iter(self.cases))).axle is not None

    @cached_property
    def reference(self) -> PointSettings:
        """The most accurate run."""
        return PointSettings.from_dict(
            {"axis": "reference"} | dict(self.settings["reference"]), f"study.scenes.{self.name}.reference"
        )

    def points(self, axis: str) -> list[PointSettings]:
        """Points of an axis, in the order in which they are measured."""
        where = f"study.scenes.{self.name}.{axis}"
        found = [PointSettings.from_dict(entry, where) for entry in self.settings.get(axis) or ()]
        labels = [point.label for point in found]
        if twice := {label for label in labels if labels.count(label) > 1}:
            raise UserError(f"{where} has two points with the label {min(twice)!r}")
        return found


@dataclass(frozen=True)
class Study:
    """A study and the folder of its points."""

    name: str
    scenes: tuple[StudyScene, ...]
    folder: Path

    @classmethod
    def from_settings(cls, settings: Mapping[str, Any], folder: Path) -> Study:
        """From conf/study.

        Raises:
            UserError: a scene lacks what it needs.
        """
        scenes = settings.get("scenes")
        if not isinstance(scenes, Mapping) or not scenes or not settings.get("name"):
            raise UserError("study needs name and scenes; see conf/study/quick.yaml")
        for name, scene in scenes.items():
            for key in ("scene", "dataset", "cases", "reference"):
                if not isinstance(scene, Mapping) or not scene.get(key):
                    raise UserError(f"study.scenes.{name}.{key} is missing; see conf/study/quick.yaml")
            if wrong := set(scene.get("bands") or ()) - set(BANDS):
                raise UserError(
                    f"study.scenes.{name}.bands has no key {min(wrong)!r}; allowed: {', '.join(BANDS)}"
                )
        return cls(str(settings["name"]), tuple(StudyScene(n, s) for n, s in scenes.items()), folder)

    @property
    def store(self) -> Store:
        """Where points are kept."""
        return Store(self.folder)

    def record(self) -> None:
        """Write what is asked for into the folder's study.yaml.

        Raises:
            UserError: the folder has a point of the same label that was asked for otherwise, so its results would be
                taken for this study's.
        """
        file, asked = self.folder / "study.yaml", self._asked()
        advice = "give another output"
        try:
            there = os.path.lexists(file)
            known = parse_yaml(read_text(file, "no text of a study", advice)) if there else {}
        except ValueError:
            known = None
        if not isinstance(known, dict):
            raise UserError(f"{file} does not say what was measured; {advice}")
        # Of what was never measured nothing can be taken for something else.
        measured = any((self.folder / "points").glob("*.json"))
        for key in known.keys() & asked.keys():
            if measured and known[key] != asked[key]:
                raise UserError(
                    f"{self.folder} holds {key} measured with {known[key]}, and {asked[key]} is asked for now; give "
                    "another output, or another label"
                )
        write_whole(file, yaml.safe_dump(known | asked, sort_keys=False, allow_unicode=True))

    def _asked(self) -> dict[str, Any]:
        """Everything that results depend on, by scene and label."""
        found = {}
        for scene in self.scenes:
            for key in ("scene", "dataset", "cases", "training", "reference"):
                found[f"{scene.name}, {key}"] = scene.settings.get(key)
            for axis in AXES:
                for entry, point in zip(scene.settings.get(axis) or (), scene.points(axis), strict=True):
                    found[f"{scene.name}, {axis}: {point.label}"] = entry
        return found
