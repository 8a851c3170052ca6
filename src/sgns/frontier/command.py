"""`sgns frontier`: measure what accuracy costs in time."""

from __future__ import annotations

import importlib
import logging
import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from sgns.config import UserError
from sgns.data.files import file_lock, require_replaceable
from sgns.frontier.observation import Observation, compare, errors
from sgns.frontier.page import PAGE, write_study
from sgns.frontier.point import Point
from sgns.frontier.study import AXES, Study, StudyScene

log = logging.getLogger(__name__)


# --- Errors of the points that are there, and which of them nobody beats --------------------------------

TOO_FAR = "left the range: not finite"


def gathered(study: Study) -> list[Point]:
    """All points of a study with their errors against the reference of their scene, fastest last.

    Raises:
        UserError: no reference has been measured.
    """
    found: list[Point] = []
    there = study.store.points()
    for scene in study.scenes:
        points = [(point, cases) for point, cases in there if point.scene == scene.name]
        if not points:
            continue
        reference = reference_runs(study, scene)
        if reference is None:
            log.warning(
                "%s: the reference (%s) is not there yet, so nothing can be judged; sgns frontier axis=solver",
                scene.name,
                scene.reference.label,
            )
            continue
        found += [judged(study, scene, point, cases, reference) for point, cases in points]
    if not found:
        raise UserError(
            f"{study.folder} holds no points with a reference; measure some: sgns frontier "
            f"study={study.name} output={study.folder}"
        )
    order = {scene.name: number for number, scene in enumerate(study.scenes)}
    cost = {id(p): math.inf if math.isnan(p.cost) else p.cost for p in found}
    return sorted(found, key=lambda point: (order[point.scene], -cost[id(point)], point.label))


def reference_runs(study: Study, scene: StudyScene) -> dict[str, Observation] | None:
    """Case → the most accurate run; None if it has not been made."""
    if not study.store.has(scene.name, "solver", scene.reference.label):
        return None
    point = Point(study.name, scene.name, "solver", "reference", scene.reference.label)
    return {case: study.store.observation(point, case) for case in scene.cases}


def judged(
    study: Study,
    scene: StudyScene,
    point: Point,
    cases: Iterable[str],
    reference: Mapping[str, Observation],
) -> Point:
    """A point with its errors; without any if it is the reference or did not finish."""
    if point.axis == "reference":
        return point
    runs = {case: study.store.observation(point, case) for case in cases if case in reference}
    if not runs or point.note.startswith("stopped"):
        return point
    if not all(run.finite for run in runs.values()):
        return replace(point, note=point.note or TOO_FAR)
    compared = [compare(run, reference[case]) for case, run in runs.items()]
    return replace(point, **errors(compared, free_body=scene.free_body))


# --- `sgns frontier`: measure what accuracy costs in time, and gather it into a table, figures and a page

# Axis → module and function that measures the points of a study that are missing.
MEASURES = {
    "solver": ("sgns.frontier.solver_points", "measure_solver"),
    "reduction": ("sgns.frontier.solver_points", "measure_reduction"),
    "surrogate": ("sgns.frontier.surrogate_points", "measure_surrogates"),
}


def main(cfg: DictConfig) -> None:
    """The command."""
    study = Study.from_settings(OmegaConf.to_container(cfg.study, resolve=True), Path(cfg.output))
    axes = axes_of(cfg.axis)
    folder = study.folder
    measured = (*(folder / "points").glob("*.json"), *(folder / "observations").glob("*.npz"))
    require_replaceable(
        *(folder / name for name in ("study.yaml", "points.csv", PAGE)),
        *(folder / "figures").glob("*.png"),
        *(file for file in measured if not file.is_file()),  # those that are there are read only
    )
    if axes:
        with file_lock(folder / "study.yaml", wait=True):  # what it says is read and added to
            study.record()
    for axis in axes:
        module, function = MEASURES[axis]
        getattr(importlib.import_module(module), function)(study)
    if axes and not any(study.store.has(s.name, "solver", s.reference.label) for s in study.scenes):
        # Another process is still at it; what was measured here is kept.
        log.info("no reference is there yet, so nothing can be judged; later: sgns frontier axis=none")
        return
    with file_lock(folder / PAGE, wait=True):  # of several that gather at once the last sees all points
        page = write_study(study, gathered(study))
    log.info("%s and the table and figures beside it", page)


def axes_of(asked: str | None) -> tuple[str, ...]:
    """The axes that one command measures."""
    if asked is None or asked == "all":
        return AXES
    if asked == "none":
        return ()
    if asked not in AXES:
        raise UserError(f"axis is {asked!r}; allowed: {', '.join(AXES)}, all, none (only gather)")
    return (asked,)
