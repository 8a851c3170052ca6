"""`sgns frontier`: measure what accuracy costs in time, and gather it into a table, figures and a page."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from sgns.config import UserError
from sgns.data.files import file_lock, require_replaceable, write_whole
from sgns.evaluate.report import PAGES, ReportFigure, write_figures
from sgns.frontier.figures import known, reduction_figure, scene_figure, through_time_figure, training_figure
from sgns.frontier.observation import Observation, compare, errors
from sgns.frontier.point import ERRORS, Point, front, write_points
from sgns.frontier.study import AXES, Study, StudyScene, composed, composed_scene

log = logging.getLogger(__name__)

PAGE = "frontier.html"
MOST_THROUGH_TIME = 14  # points of the fronts whose errors through the run are drawn


def main(cfg: DictConfig) -> None:
    """The command."""
    study = Study.from_settings(OmegaConf.to_container(cfg.study, resolve=True), Path(cfg.output))
    axes = {"all": AXES, "none": ()}.get(cfg.axis, (cfg.axis,))
    folder = study.folder
    measured = (*(folder / "points").glob("*.json"), *(folder / "observations").glob("*.npz"))
    require_replaceable(
        *(folder / name for name in ("study.yaml", "points.csv", PAGE)),
        *(folder / "figures").glob("*.png"),
        *(file for file in measured if not file.is_file()),  # those that are there are read only
    )
    if axes:
        for scene in study.scenes:  # what is wrong there is said now, not after hours
            composed("reduce", [f"dataset={scene.dataset}"])
            for overrides in scene.cases.values():
                composed_scene(overrides)
        with file_lock(folder / "study.yaml", wait=True):  # what it says is read and added to
            study.record()
        from sgns.frontier.measure import measure  # training takes seconds to import

        for axis in axes:
            measure(study, axis)
        if not any(study.file(s.name, "solver", s.reference.label).exists() for s in study.scenes):
            # Another process is still at it; what was measured here is kept.
            log.info("no reference is there yet, so nothing can be judged; later: sgns frontier axis=none")
            return
    with file_lock(folder / PAGE, wait=True):  # of several that gather at once the last sees all points
        page = write_study(study, points_with_errors(study))
    log.info("%s and the table and figures beside it", page)


def points_with_errors(study: Study) -> list[Point]:
    """All points of a study with their errors against the reference of their scene, fastest last.

    Raises:
        UserError: no reference has been measured.
    """
    found: list[Point] = []
    measured = study.points()
    for scene in study.scenes:
        points = [(point, cases) for point, cases in measured if point.scene == scene.name]
        label = scene.reference.label
        reference = next((p for p, _ in points if (p.kind, p.label) == ("solver", label)), None)
        if reference:
            runs = {case: study.observation(reference, case) for case in scene.cases}
            compared = [with_errors(study, scene, point, cases, runs) for point, cases in points]
            found += sorted(compared, key=lambda p: (-math.inf if math.isnan(p.cost) else -p.cost, p.label))
        elif points:
            log.warning(
                "%s: the reference (%s) is not there yet, so nothing can be judged; sgns frontier axis=solver",
                scene.name,
                label,
            )
    if not found:
        raise UserError(
            f"{study.folder} holds no points with a reference; measure some: sgns frontier "
            f"study={study.name} output={study.folder}"
        )
    return found


def with_errors(
    study: Study, scene: StudyScene, point: Point, cases: Iterable[str], reference: Mapping[str, Observation]
) -> Point:
    """A point with its errors; without any if it is the reference or did not finish."""
    runs = {case: study.observation(point, case) for case in cases if case in reference}
    if point.axis == "reference" or not runs or point.note.startswith("stopped"):
        return point
    if not all(run.finite for run in runs.values()):
        return replace(point, note=point.note or "left the range: not finite")
    compared = [compare(run, reference[case]) for case, run in runs.items()]
    columns: dict[str, Any] = errors(compared, free_body=scene.free_body)
    return replace(point, **columns)


# --- The gathered study as a table, figures, and one HTML page that needs nothing from outside ----------

TABLE = (  # heading, column of `Point`, what it is multiplied with
    ("with all particles, s per s", "decoded_cost", 1.0),
    ("pose by pose, s per s", "stepped_cost", 1.0),
    ("force NRMSE", "force_nrmse", 1.0),
    ("mean draft, %", "draft_mean_error", 100.0),
    ("mean vertical, %", "vertical_mean_error", 100.0),
    ("torque NRMSE", "torque_nrmse", 1.0),
    ("soil, mm", "position_rmse_mm", 1.0),
    ("surface, mm", "surface_rmse_mm", 1.0),
    ("sinkage, mm", "sinkage_error_mm", 1.0),
    ("own force NRMSE", "own_force_nrmse", 1.0),
    ("own soil, mm", "own_position_rmse_mm", 1.0),
    ("skill", "skill_frozen", 1.0),
    ("training, s", "training_s", 1.0),
    ("displacement energy, %", "energy", 100.0),
)


def write_study(study: Study, points: Sequence[Point]) -> Path:
    """Writes points.csv, figures/*.png and frontier.html into the study's folder; returns the page."""
    write_points(study.folder / "points.csv", points)
    scenes = []
    for scene in study.scenes:
        if chosen := [point for point in points if point.scene == scene.name]:
            figures = scene_figures(scene, chosen)
            write_figures(figures, study.folder / "figures")
            scenes.append((scene, figures, *scene_table(scene, chosen)))
    page = study.folder / PAGE
    text = PAGES.get_template("frontier/page.html.j2").render(
        title=f"What accuracy costs in time: study {study.name}",
        contents=[*((s[0].name, f"Scene: {s[0].name}") for s in scenes), ("made", "How this was made")],
        scenes=scenes,
        made=made(study, points),
        errors=ERRORS,
    )
    write_whole(page, text)
    return page


def scene_figures(scene: StudyScene, points: Sequence[Point]) -> list[ReportFigure]:
    """The pictures of a scene; those that would be empty are left out."""
    name = scene.name
    drawn = [
        (
            column.removesuffix("_mm"),
            words,
            "Every operating point; a star is one of the paper's. Left of the dashed line is faster than real time.",
            scene_figure(points, column, scene.bands, f"{name}: {words} over time"),
        )
        for column, words in ERRORS.items()
        if known(points, column)
    ]
    best = on_fronts(scene, points, ("force_nrmse", "position_rmse_mm"))
    if through_time := [p for p in best if not math.isnan(p.force_nrmse_q4)][:MOST_THROUGH_TIME]:
        caption = "Force: in each quarter. Soil: at the end of each quarter, where errors have added up."
        image = through_time_figure(through_time, f"{name}: errors through the run, points of the fronts")
        drawn.append(("through_time", "error through time", caption, image))
    if trained := [p for p in points if p.training_s > 0 and not math.isnan(p.own_force_nrmse)]:
        caption = (
            "Errors against the solver that made the training runs, on its held-out runs, over training time."
        )
        image = training_figure(trained, f"{name}: what training buys")
        drawn.append(("training", "error against training time", caption, image))
    if reduced := [p for p in points if p.kind == "reduction" and p.own_position_rmse_mm > 0]:
        caption = (
            "No simulation: held-out runs projected onto the modes. No surrogate with r modes is better."
        )
        image = reduction_figure(reduced, f"{name}: what r modes leave out")
        drawn.append(("reduction", "reduction alone", caption, image))
    return [
        ReportFigure(f"{name}_{suffix}", f"{name}: {words}", caption, image)
        for suffix, words, caption, image in drawn
    ]


def on_fronts(scene: StudyScene, points: Sequence[Point], columns: Iterable[str]) -> list[Point]:
    """The points that are on the front of one of these errors, each once."""
    found = [point for column in columns for point in front(points, column, scene.bands)]
    return list(dict.fromkeys(found))


def scene_table(scene: StudyScene, points: Sequence[Point]) -> tuple[list[str], list[tuple[bool, list[str]]]]:
    """Headings, and for each point whether it is on a front, and its cells; columns that say nothing are left out."""
    columns = {
        "point": [("★ " if p.paper else "") + p.label for p in points],
        "what is varied": [p.axis for p in points],
        "kind": [p.kind for p in points],
        "s per s": [digits(p.cost) + ("*" if p.shared else "") for p in points],
        "ratio": [digits(p.ratio) for p in points],
    }
    more = {heading: [digits(factor * getattr(p, name)) for p in points] for heading, name, factor in TABLE}
    for heading, cells in (more | {"note": [p.note for p in points]}).items():
        if any(cell not in ("", "–") for cell in cells):
            columns[heading] = cells
    best = on_fronts(scene, points, ERRORS)
    rows = zip(*columns.values(), strict=True)
    return list(columns), [(p in best, list(row)) for p, row in zip(points, rows, strict=True)]


def made(study: Study, points: Sequence[Point]) -> dict[str, str]:
    """Machine, commands, and what the times include."""

    def all_of(values: Iterable[str]) -> str:
        return "; ".join(dict.fromkeys(filter(None, values)))

    workloads = [p.workload_wall_s_per_simulated_s for p in points if p.workload_wall_s_per_simulated_s > 0]
    facts = {
        "study": study.name,
        "machine": all_of(sorted(f"one core of {p.machine}" for p in points if p.machine)),
        "commands": all_of(sorted(p.command for p in points)),
        "package": all_of(sorted(f"{p.version} {p.commit}".strip() for p in points if p.version)),
        "points": str(len(points)),
        "timing": "medians of repeats on one core and one thread, warm: kernels were compiled and files in memory "
        "before the clock started. The solver's repeats are stretches of its runs.",
        "reference workload": f"sgns simulate scene=excavation while the plate cuts, beside every point: "
        f"{digits(min(workloads))} to {digits(max(workloads))} s per simulated s in this study"
        if workloads
        else "",
    }
    for kind in dict.fromkeys(p.kind for p in points):
        facts[f"in the time, {kind}"] = all_of(p.includes for p in points if p.kind == kind)
    return {name: value for name, value in facts.items() if value}


def digits(value: float) -> str:
    """A number to three digits, – where there is none."""
    return "–" if math.isnan(value) else f"{value:.3g}"
