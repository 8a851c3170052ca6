"""Errors of the points that are there, and which of them nobody beats."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping
from dataclasses import replace

from sgns.errors import UserError
from sgns.frontier.comparison import compare, errors
from sgns.frontier.observation import Observation
from sgns.frontier.point import Point
from sgns.frontier.study import Study, StudyScene

__all__ = ["effective_error", "front", "gathered", "usable"]

log = logging.getLogger(__name__)

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


def usable(point: Point) -> bool:
    """Whether a point can stand in for a simulation: it finished, and needs no run of the solver as its input."""
    return point.kind != "reduction" and not math.isnan(point.cost)


def effective_error(point: Point, column: str, bands: Mapping[str, float]) -> float:
    """An error, but never less than what the reference itself may be wrong by; NaN if it is not known."""
    band = bands.get(column, 0.0)
    if point.axis == "reference":
        return band if column in bands else math.nan
    return max(getattr(point, column), band) if not math.isnan(getattr(point, column)) else math.nan


def front(points: Iterable[Point], column: str, bands: Mapping[str, float]) -> list[Point]:
    """The points that no faster point equals in an error, fastest first (Pareto)."""
    best, found = math.inf, []
    for point in sorted(filter(usable, points), key=lambda point: point.cost):
        error = effective_error(point, column, bands)
        if error < best:
            best = error
            found.append(point)
    return found
