"""One self-contained HTML page about an evaluation; its words follow from the numbers and stand in the template."""

from __future__ import annotations

import base64
import itertools
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader
from matplotlib.figure import Figure

from sgns.data.files import whole_file, write_whole
from sgns.data.run import Run
from sgns.data.surface import surface_grid
from sgns.evaluate.figures import (
    energy_figure,
    error_panels,
    force_panels,
    histogram_figure,
    history_figure,
    png,
    profile_figure,
    reconstruction_figure,
    torque_panels,
    training_figure,
)
from sgns.evaluate.results import EvaluatedRun, Evaluation, typical_and_worst
from sgns.evaluate.views import common_scales, latent_path, side_views, solid_views, subspace_view, view_times
from sgns.numbers import counted

# --- Numbers, runs and scenes in plain words -------------------------------------------------------------


def number(value: float, digits: int = 3) -> str:
    """A number with so many significant digits, no exponent where it can be helped; – if it means nothing."""
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    size = abs(value)
    if size >= 1e5 or 0.0 < size < 1e-4:
        text = f"{value:.{digits - 1}e}"
    else:
        decimals = digits if size == 0.0 else max(0, digits - 1 - math.floor(math.log10(size)))
        text = f"{float(f'{value:.{digits}g}') if size >= 1000 else value:.{min(decimals, 6)}f}"
    return text.replace("-", "−")


def fixed(value: float, decimals: int = 2, sign: bool = False) -> str:
    """A number with so many decimals; – if it means nothing."""
    if not math.isfinite(value):
        return number(value)
    value = round(value, decimals) + 0.0  # no minus before a zero
    return f"{value:{'+' if sign else ''}.{decimals}f}".replace("-", "−")


def quantity(value: float | None) -> str:
    """A number as people write it; whole ones with all their digits; nothing for None."""
    if value is None:
        return ""
    return f"{value:,}".replace(",", " ") if isinstance(value, int) else number(value)


def describe(scene: Mapping[str, Any]) -> str:
    """What the paper lists of a blade's or a wheel's scene, in a few words; empty for other scenes."""
    if scene.get("motion") == "path":
        return "on a path of its own"  # its depth, speed and rake are not used
    if all(key in scene for key in ("depth", "speed", "rake", "motion")):
        depth, speed, rake, motion = (scene[key] for key in ("depth", "speed", "rake", "motion"))
        return f"{100 * depth:.3g} cm deep, {100 * speed:.3g} cm/s, rake {rake:.3g}°, {motion} motion"
    if all(key in scene for key in ("diameter", "load", "slip")):
        load, turned = scene["load"], scene.get("slip_angle")
        words = f"{100 * scene['diameter']:.3g} cm wheel, "
        words += "load over time" if isinstance(load, list) else f"{load:.3g} N"
        words += f", slip {100 * scene['slip']:.3g} %" + (f", slip angle {turned:.3g}°" if turned else "")
        angle, gravity = scene.get("friction_angle"), scene.get("gravity")
        words += "" if angle is None else f", friction angle {angle:.3g}°"
        return words + ("" if gravity is None else f", gravity {gravity:.3g} m/s²")
    return ""


def short_names(names: Sequence[str]) -> list[str]:
    """The part of every name before its first underscore, if that still tells the names apart."""
    short = [name.partition("_")[0] or name for name in names]
    return short if len(set(short)) == len(set(names)) else list(names)


def forward_name(evaluation: Evaluation) -> str:
    """What the forward force is called: wheels pull, other bodies draw."""
    return "drawbar pull" if all(run.wheel for run in evaluation.runs) else "draft"


def seen_warning(evaluation: Evaluation) -> str:
    """One sentence if the evaluation is no clean test, else nothing."""
    count = len(evaluation.runs)
    parts = [
        f"{len(names)} of the {count} evaluated runs {verb} ({names[0]}{', …' if len(names) > 1 else ''})"
        for names, verb in (
            (evaluation.trained_on, "bear the names of runs that this checkpoint was trained on"),
            (evaluation.chosen_by, "bear the names of validation runs that chose this checkpoint"),
        )
        if names
    ]
    return f"{'; '.join(parts)}: for those the numbers are no test." if parts else ""


# --- The page -------------------------------------------------------------------------------------------

PAGES = Environment(loader=PackageLoader("sgns", "."), autoescape=True, trim_blocks=True, lstrip_blocks=True)
"""Templates of pages, by their path in the package."""
PAGES.filters |= {
    "base64": lambda data: base64.b64encode(data).decode("ascii"),
    "fixed": fixed,
    "number": number,
    "quantity": quantity,
}
# More runs than this fill pages that nobody reads; the tables hold all of them.
MOST_RUNS = 9
MOST_SIDE_VIEWS = 6
MPM, NETWORK = "simulated (MPM)", "network"


@dataclass(frozen=True)
class ReportFigure:
    """A picture of a page."""

    name: str  # of its file, without ending
    title: str  # a few words
    caption: str  # what is in this one
    png: bytes  # the picture


@dataclass(frozen=True)
class FigureGroup:
    """Pictures under one heading."""

    heading: str  # of the group
    note: str  # name of the note in the template: what to see in them
    figures: Sequence[ReportFigure]  # the pictures
    scene: str = ""  # what the note begins with: of which run they are


def write_report(evaluation: Evaluation, output: Path) -> Path:
    """Draws the figures into `figures/` and writes `report.html`; every file is complete or not there at all.

    Returns:
        Path of the page.
    """
    groups = report_figures(evaluation)
    write_figures(itertools.chain.from_iterable(group.figures for group in groups), output / "figures")
    path = output / "report.html"
    write_whole(path, render_report(evaluation, groups))
    return path


def write_figures(figures: Iterable[ReportFigure], folder: Path) -> None:
    """The pictures as PNG files."""
    folder.mkdir(parents=True, exist_ok=True)
    for figure in figures:
        with whole_file(folder / f"{figure.name}.png") as temporary:
            temporary.write_bytes(figure.png)


def render_report(evaluation: Evaluation, groups: Sequence[FigureGroup]) -> str:
    """The whole page as HTML, with some groups of pictures after the tables."""
    headings = ["Soil", "Force on the tool", "Test examples", "Time and memory"]
    headings += [*(group.heading for group in groups), "How this was made"]
    return PAGES.get_template("evaluate/report.html.j2").render(
        title=f"Predicted against simulated soil: {evaluation.dataset}, {evaluation.split} runs",
        contents=[(f"s{count}", heading) for count, heading in enumerate(headings, start=1)],
        e=evaluation,
        rows=[
            *((run.label, run.scores, run.words) for run in evaluation.runs),
            (evaluation.total.name, evaluation.total, ""),
        ],
        forward=forward_name(evaluation),
        warning=seen_warning(evaluation),
        nan=math.nan,
        left_out=len(evaluation.runs[MOST_RUNS:]),
        groups=groups,
    )


# --- Which pictures it shows, of which runs, with which words -------------------------------------------


def picture(name: str, title: str, caption: str, figure: Figure) -> ReportFigure:
    """A picture with its words; of its name everything but letters, digits, - and _ is replaced."""
    return ReportFigure(re.sub(r"[^A-Za-z0-9_-]+", "-", name), title, caption, png(figure))


@contextmanager
def both_runs(chosen: EvaluatedRun) -> Iterator[tuple[Run, Run]]:
    """The simulated and the predicted run, open."""
    with Run(chosen.truth) as truth, Run(chosen.rollout) as prediction:
        yield truth, prediction


def report_figures(evaluation: Evaluation) -> list[FigureGroup]:
    """Draws every picture of the report."""
    typical, worst = typical_and_worst(evaluation)
    groups = [whole_run(evaluation, typical, "Typical run" if typical is not worst else "Run")]
    if worst is not typical:
        groups.append(whole_run(evaluation, worst, "Worst run"))
    others = [run for run in evaluation.runs if run not in (typical, worst)][:MOST_SIDE_VIEWS]
    groups += [
        half_way(evaluation, others),
        in_space(evaluation, typical),
        *histories(evaluation),
        by_particle(evaluation),
        in_subspace(evaluation, typical),
        reduction(evaluation),
        training(evaluation),
        *(new_path(evaluation, path) for path in evaluation.new_rollouts),
    ]
    return [group for group in groups if group.figures]


def seen_from_the_side(
    evaluation: Evaluation,
    runs: Mapping[str, Run],
    frames: Sequence[int],
    name: str,
    label: str,
    caption: str,
) -> list[ReportFigure]:
    """Side views of runs by title, one above the other, at some frames with the same scales."""
    scales = common_scales(list(runs.values()), frames, evaluation.start)
    time = next(iter(runs.values())).time
    return [
        picture(
            f"{name}_{count}" if len(frames) > 1 else name,
            f"{label}: side view at {time[frame]:.2f} s",
            caption,
            side_views([[(title, run, frame)] for title, run in runs.items()], scales),
        )
        for count, frame in enumerate(frames, start=1)
    ]


def whole_run(evaluation: Evaluation, chosen: EvaluatedRun, label: str) -> FigureGroup:
    """Side views and surface of one run at several moments, truth and prediction."""
    with both_runs(chosen) as (truth, prediction):
        runs, frames = {MPM: truth, NETWORK: prediction}, view_times(truth, evaluation.history)
        caption = "Simulated above, predicted below."
        figures = seen_from_the_side(evaluation, runs, frames, f"side_{chosen.name}", chosen.label, caption)
        surface = picture(
            f"surface_{chosen.name}",
            f"{chosen.label}: surface along mid-width",
            "Height of the surface at mid-width: black simulated, blue predicted.",
            profile_figure(runs, frames, surface_grid(evaluation.start)),
        )
    own, median = (
        f"{number(mm)} mm, {fixed(nrmse)}" for mm, nrmse in (chosen.main_errors, evaluation.median_errors)
    )
    errors = f"Position error and force NRMSE: {own}; median of the runs: {median}"
    scene = ". ".join([": ".join(filter(None, (chosen.label, chosen.words))), errors])
    return FigureGroup(f"{label}: side view and surface", "whole run", [*figures, surface], scene)


def half_way(evaluation: Evaluation, chosen: Sequence[EvaluatedRun]) -> FigureGroup:
    """Side views of more runs, at one moment each."""
    figures = []
    for run in chosen:
        with both_runs(run) as (truth, prediction):
            frames = [view_times(truth, evaluation.history)[1]]
            runs = {MPM: truth, NETWORK: prediction}
            caption = f"Simulated above, predicted below. {run.words}"
            figures += seen_from_the_side(evaluation, runs, frames, f"side_{run.name}", run.label, caption)
    return FigureGroup("More runs, half-way", "half-way", figures)


def in_space(evaluation: Evaluation, chosen: EvaluatedRun) -> FigureGroup:
    """The whole bed in three dimensions at one moment."""
    with both_runs(chosen) as (truth, prediction):
        frame = view_times(truth, evaluation.history)[1]
        views = solid_views(truth, prediction, frame, evaluation.start)
        caption = f"All particles and the tool in three dimensions at {truth.time[frame]:.2f} s."
    name, label = f"solid_{chosen.name}", f"{chosen.label} in three dimensions"
    figures = [
        picture(f"{name}_{count}", f"{label}: {title}", caption, figure)
        for count, (title, figure) in enumerate(views.items(), start=1)
    ]
    return FigureGroup(f"The whole bed: run {chosen.label}", "whole bed", figures)


def histories(evaluation: Evaluation) -> list[FigureGroup]:
    """Force, torque and errors through time of the runs of the split."""
    drawn: dict[str, list[ReportFigure]] = {"force": [], "torque": [], "error": []}
    for run in evaluation.runs[:MOST_RUNS]:
        scores = run.scores
        nrmse, rmse = fixed(scores.force.overall_nrmse), number(scores.rmse_mm("total"))
        band = (
            ""
            if math.isnan(scores.coverage)
            else f"; {100 * scores.coverage:.0f} % of the true values in the band"
        )
        captions = {
            "force": f"NRMSE {nrmse}{band}. {run.words}",
            "torque": f"NRMSE {fixed(scores.torque.overall_nrmse)}.",
            "error": f"Position RMSE {rmse} mm, force NRMSE {nrmse}.",
        }
        with both_runs(run) as (truth, prediction):
            both = (truth, prediction, evaluation.history)
            panels = {
                "force": force_panels(*both, evaluation.mean_force),
                "torque": torque_panels(*both, evaluation.mean_torque),
                "error": error_panels(run.errors, *both, evaluation.mean_force),
            }
        for name in drawn:
            if panels[name]:
                title, figure = f"{run.label}: {name} through time", history_figure(panels[name])
                drawn[name].append(picture(f"{name}_{run.name}", title, captions[name], figure))
    return [FigureGroup(f"{name.title()} through time", name, figures) for name, figures in drawn.items()]


def by_particle(evaluation: Evaluation) -> FigureGroup:
    """How the errors are spread over particles."""
    particles = [run.errors.particles for run in evaluation.runs if run.errors.particles is not None]
    caption = f"{counted(len(particles), 'run')} together; dotted: the median. Below 1 µm counts as 1 µm."
    figures = [picture("particles", "Error by particle", caption, histogram_figure(particles))]
    return FigureGroup("Error by particle", "particles", figures)


def in_subspace(evaluation: Evaluation, chosen: EvaluatedRun) -> FigureGroup:
    """The modes as points in space."""
    with both_runs(chosen) as (truth, prediction):
        paths = (latent_path(truth, evaluation.basis), latent_path(prediction, evaluation.basis))
        figures = [
            picture(
                f"subspace_{chosen.name}_{count}",
                f"{chosen.label}: subspace at {truth.time[frame]:.2f} s",
                f"The {evaluation.num_modes} modes: rings simulated, blue predicted.",
                subspace_view(truth, prediction, paths, frame),
            )
            for count, frame in enumerate(view_times(truth, evaluation.history), start=1)
        ]
    heading = f"What the network steps: the subspace of run {chosen.label}"
    return FigureGroup(heading, "subspace", figures)


def reduction(evaluation: Evaluation) -> FigureGroup:
    """Energy of the modes and reconstruction error."""
    curves, modes = evaluation.curves, evaluation.num_modes
    rmse = evaluation.total.rmse_mm("total")
    energy = picture(
        "energy",
        "Energy that the modes leave out",
        "The paper's energy counts the layout of the bed unless every particle is centred; "
        "displacement energy counts motion only.",
        energy_figure(curves.energy, curves.displacement_energy, modes),
    )
    reconstruction = picture(
        "reconstruction",
        "Reconstruction error",
        f"Projection of the {evaluation.split} runs on r modes and back; the horizontal line is the "
        f"rollout's error with {modes} modes.",
        reconstruction_figure(curves.held_out, curves.training, modes, rmse),
    )
    return FigureGroup("What the subspace can hold", "reduction", [energy, reconstruction])


def training(evaluation: Evaluation) -> FigureGroup:
    """How the losses fell and the rollouts got better."""
    figures = []
    if evaluation.training_log:
        caption = "Losses of the training batches on a logarithmic axis; skill and force NRMSE of the validation runs."
        figures.append(picture("training", "Training", caption, training_figure(evaluation.training_log)))
    return FigureGroup("How it was trained", "training", figures)


def new_path(evaluation: Evaluation, path: Path) -> FigureGroup:
    """Side views and force of a path that was never simulated."""
    name, caption = path.stem, "Predicted soil at mid-width, coloured by speed, and the predicted force."
    with Run(path) as run:
        frames = view_times(run, 1)
        outside = run.extra.get("outside_training_words")
        words = (describe(run.scene) or name) + (f"; {outside}" if outside else "")
        figures = seen_from_the_side(evaluation, {NETWORK: run}, frames, f"new_side_{name}", name, caption)
        panels = force_panels(None, run, min(1, run.frame_count - 1), evaluation.mean_force)
    caption = "Frame means; dashed: the mean of the training runs."
    force = picture(f"new_force_{name}", f"{name}: predicted force", caption, history_figure(panels))
    return FigureGroup(f"A path that was never simulated: {name}", "new path", [*figures, force], words)
