"""A study: which points of which scenes are measured, how they are timed, and the folder that keeps them."""

from __future__ import annotations

import json
import os
import re
import shlex
import statistics
import subprocess
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import yaml
from hydra import compose, initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig

from mpm_warp import Frame, Scene, Solver, effects_for
from mpm_warp.settings import build
from sgns import __version__
from sgns.config import UserError, parse_yaml
from sgns.data.files import read_json, read_text, write_whole
from sgns.evaluate.costs import command_line, cpu_model
from sgns.frontier.observation import Observation, read_observation
from sgns.frontier.point import ERRORS, Point, core_time
from sgns.numbers import elapsed
from sgns.rollout import single_thread
from sgns.settings import PointSettings, StudySceneSettings
from sgns.simulate.scene import scene_from_config

AXES = ("solver", "reduction", "surrogate")
"""Groups of points that one command, or one process of several, measures."""


def composed(command: str, overrides: Sequence[str]) -> DictConfig:
    """All settings of a command with these overrides."""
    if GlobalHydra.instance().is_initialized():
        return compose(command, list(overrides))
    with initialize_config_module("sgns.conf", version_base="1.3"):
        return compose(command, list(overrides))


def composed_scene(overrides: Sequence[str]) -> tuple[Scene, DictConfig]:
    """The scene and all settings of `sgns simulate` with these overrides."""
    cfg = composed("simulate", overrides)
    return scene_from_config(cfg), cfg


# --- What a study measures: its scenes, the cases each scene is judged on, and the points of its axes ---


def require_known(keys: Iterable[str], allowed: Collection[str], words: str) -> None:
    """Refuses keys that are not allowed."""
    if wrong := [key for key in keys if key not in allowed]:
        raise UserError(f"{words} {wrong[0]!r}; allowed: {', '.join(allowed)}")


def point_settings(data: Any, where: str) -> PointSettings:
    """An entry of conf/study.

    Raises:
        UserError: it has no axis or no label, or a key or value that is not allowed.
    """
    if not isinstance(data, Mapping) or not data.get("axis") or not data.get("label"):
        raise UserError(f"{where} holds {data!r}; every point needs axis and label, and set: [overrides]")
    found = build(PointSettings, dict(data), f"{where}, {data['label']!r}")
    assert isinstance(found, PointSettings)
    return found


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

    @cached_property
    def free_body(self) -> bool:
        """Whether the soil carries the body."""
        return composed_scene(next(iter(self.cases.values())))[0].axle is not None

    @cached_property
    def reference(self) -> PointSettings:
        """The most accurate run."""
        entry = {"axis": "reference"} | dict(self.settings["reference"])
        return point_settings(entry, f"study.scenes.{self.name}.reference")

    def points(self, axis: str) -> list[PointSettings]:
        """Points of an axis, in the order in which they are measured."""
        where = f"study.scenes.{self.name}.{axis}"
        found = [point_settings(entry, where) for entry in self.settings.get(axis) or ()]
        labels = [point.label for point in found]
        if twice := {label for label in labels if labels.count(label) > 1}:
            raise UserError(f"{where} has two points with the label {min(twice)!r}")
        return found


@dataclass(frozen=True)
class Study:
    """A study and the folder of its points, a file each, so that it goes on where it stopped:

    - points/<scene>_<kind>_<label>.json: a point without its errors; written last, whole
    - observations/<scene>_<kind>_<label>_<case>.npz: its runs
    - study.yaml: what the points were asked for with
    """

    name: str
    scenes: tuple[StudyScene, ...]
    folder: Path

    @classmethod
    def from_settings(cls, settings: Any, folder: Path) -> Study:
        """From conf/study.

        Raises:
            UserError: a scene lacks what it needs, or has a key that is not known.
        """
        scenes = settings.get("scenes")
        if not isinstance(scenes, Mapping) or not scenes or not isinstance(settings.get("name"), str):
            raise UserError("study needs name and scenes; see conf/study/quick.yaml")
        require_known(settings, ("name", "scenes"), "study has no key")
        needed = ("scene", "dataset", "cases", "reference")
        for name, scene in scenes.items():
            where = f"study.scenes.{name}"
            for key in needed:
                if not isinstance(scene, Mapping) or not scene.get(key):
                    raise UserError(f"{where}.{key} is missing; see conf/study/quick.yaml")
            build(StudySceneSettings, scene, where)
            require_known(scene.get("bands") or (), ERRORS, f"{where}.bands has no key")
        study = cls(settings["name"], tuple(StudyScene(n, s) for n, s in scenes.items()), folder)
        for one in study.scenes:
            assert one.reference  # read now, not after hours
            for axis in AXES:
                one.points(axis)
        return study

    def record(self) -> None:
        """Write what is asked for into the folder's study.yaml.

        Raises:
            UserError: the folder has a point of the same label that was asked for otherwise, so its results would be
                taken for this study's.
        """
        file = self.folder / "study.yaml"
        advice = "give another output"
        try:
            there = os.path.lexists(file)
            known = parse_yaml(read_text(file, "no text of a study", advice)) if there else {}
        except ValueError:
            known = None
        if not isinstance(known, dict):
            raise UserError(f"{file} does not say what was measured; {advice}")
        asked = {}  # all that results depend on, by scene and label
        for scene in self.scenes:
            for key in ("scene", "dataset", "cases", "reference"):
                asked[f"{scene.name}, {key}"] = scene.settings[key]
            for axis in AXES:
                for entry, point in zip(scene.settings.get(axis) or (), scene.points(axis), strict=True):
                    asked[f"{scene.name}, {axis}: {point.label}"] = entry
        # Of what was never measured nothing can be taken for something else.
        measured = any((self.folder / "points").glob("*.json"))
        for key in known.keys() & asked.keys():
            if measured and known[key] != asked[key]:
                raise UserError(
                    f"{self.folder} holds {key} measured with {known[key]}, and {asked[key]} is asked for now; give "
                    "another output, or another label"
                )
        write_whole(file, yaml.safe_dump(known | asked, sort_keys=False, allow_unicode=True))

    def file(self, scene: str, kind: str, label: str) -> Path:
        """Where a point is; it is there when it has been measured."""
        name = "_".join(re.sub(r"([^\w.+-]|_)+", "-", part) for part in (scene, kind, label))
        return self.folder / "points" / f"{name}.json"

    def save(self, point: Point, observations: Mapping[str, Observation]) -> None:
        """Keep a point with its run of every case; none for a point that left the range (say so in its note)."""
        for case, observation in observations.items():
            observation.save(self._observation(point, case))
        content = {"point": point.row(), "cases": list(observations)}
        file = self.file(point.scene, point.kind, point.label)
        file.parent.mkdir(parents=True, exist_ok=True)
        write_whole(file, json.dumps(content, indent=1, ensure_ascii=False))

    def points(self) -> list[tuple[Point, list[str]]]:
        """All points with the names of their cases, in the order of their files' names.

        Raises:
            UserError: a file is damaged.
        """
        found = []
        for file in sorted((self.folder / "points").glob("*.json")):
            advice = "remove it to make it again"
            content = read_json(file, "no operating point", advice)
            try:
                point, cases = Point.from_row(dict(content["point"])), list(content["cases"])
                if set("".join(cases)) & {"/", os.sep, "\0"}:
                    raise ValueError(f"{cases!r:.40} are no names of cases")
            except (ValueError, KeyError, TypeError, UserError) as error:
                raise UserError(f"{file} is no operating point ({error}); {advice}") from None
            found.append((point, cases))
        return found

    def observation(self, point: Point, case: str) -> Observation:
        """The run of a case of a point."""
        return read_observation(self._observation(point, case))

    def _observation(self, point: Point, case: str) -> Path:
        name = self.file(point.scene, point.kind, point.label).stem
        return self.folder / "observations" / f"{name}_{case}.npz"


# --- Wall times that can be compared: one core, warm, medians, beside a workload that is always the same
# The reference workload is the default scene of `sgns simulate` (the paper's bin at 20 mm, 4 particles per cell, half
# of it computed) while the plate cuts. Its time is taken just before and just after what is measured, on the same
# core, so that ratios to it hold on a machine whose speed changes.

FRAMES = 8  # of one stretch of the workload
STRETCHES = 2  # of which the median is taken, before and after each


@contextmanager
def one_core(last: bool = False) -> Iterator[None]:
    """This process on the first (or last) core it may use, and torch on one thread; as before afterwards."""
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_setaffinity") else None
    try:
        if cores:
            os.sched_setaffinity(0, {max(cores) if last else min(cores)})
        with single_thread():
            yield
    finally:
        if cores:
            os.sched_setaffinity(0, cores)


def stopwatch() -> Callable[[], tuple[float, float]]:
    """A function that tells the wall and the processor time since now [s]."""
    began, clock = time.perf_counter(), time.process_time()
    return lambda: (elapsed(began, time.perf_counter()), elapsed(clock, time.process_time()))


class Workload:
    """The reference workload, warm."""

    def __init__(self) -> None:
        self._scene = composed_scene(["scene=excavation"])[0]
        self._frames: Iterator[Frame] = iter(())

    def measure(self) -> list[float]:
        """Seconds of one core per simulated second, of each of a few stretches."""
        found: list[float] = []
        while len(found) < STRETCHES:
            watch = stopwatch()
            done = sum(1 for _ in zip(range(FRAMES), self._frames, strict=False))
            seconds = core_time(*watch())
            if done == FRAMES:
                found.append(seconds * self._scene.frame_rate / FRAMES)
            else:
                self._frames = Solver(self._scene, effects_for(self._scene)[0]).frames()
                for _ in range(2):  # the first frame loads kernels, the second is the first that computes
                    next(self._frames)
        return found


def cost_fields(rates: Sequence[float], workload: Sequence[float], processor_rate: float) -> dict[str, Any]:
    """The columns of `Point` that say what it costs, for the CPU.

    From wall seconds per simulated second, of each repeat and of the reference workload before and after, and processor
    seconds per simulated second.
    """
    median, reference = statistics.median(rates), statistics.median(workload)
    return {
        "wall_s_per_simulated_s": median,
        "wall_s_per_simulated_s_low": min(rates),
        "wall_s_per_simulated_s_high": max(rates),
        "processor_s_per_simulated_s": processor_rate,
        "repeats": float(len(rates)),
        "workload_wall_s_per_simulated_s": reference,
        "ratio": core_time(median, processor_rate) / reference,
        "processor": cpu_model(),
        "threads": 1.0,
        "device": "cpu",
    }


def made_here() -> dict[str, str]:
    """The columns of `Point` that say how and where it is measured; the command without its output folder."""
    words = shlex.split(command_line())
    return {
        "command": shlex.join(word for word in words if not word.startswith("output=")),
        "machine": cpu_model(),
        "version": __version__,
        "commit": commit(),
    }


@cache
def commit() -> str:
    """Short name of the commit this package runs from; empty if it is no checkout."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""
