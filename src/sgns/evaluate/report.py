"""One self-contained HTML page about an evaluation: words, tables, pictures; the words follow from the numbers."""

from __future__ import annotations

import base64
import itertools
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment, PackageLoader
from matplotlib.figure import Figure

from sgns.data.files import whole_file, write_whole
from sgns.data.run import Run
from sgns.evaluate.figures import (
    energy_figure,
    error_panels,
    force_panels,
    histogram_figure,
    history_figure,
    latent_path,
    png,
    profile_figure,
    reconstruction_figure,
    subspace_view,
    torque_panels,
    training_figure,
)
from sgns.evaluate.metrics import surface_grid
from sgns.evaluate.results import EvaluatedRun, Evaluation, seen_warning
from sgns.evaluate.side_view import common_scales, side_view, view_times
from sgns.evaluate.solid_view import solid_views
from sgns.evaluate.tables import cost_columns, example_columns, force_columns, soil_columns
from sgns.evaluate.words import describe, fixed, number, summary, titled

PAGES = Environment(loader=PackageLoader("sgns", "."), autoescape=True, trim_blocks=True, lstrip_blocks=True)
"""Templates of pages, by their path in the package."""
PAGES.filters |= {
    "base64": lambda data: base64.b64encode(data).decode("ascii"),
    "consecutive": lambda items, name: [
        (value, list(same)) for value, same in itertools.groupby(items, key=lambda item: getattr(item, name))
    ],
    "fixed": fixed,
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
    note: str  # what to see in them
    figures: Sequence[ReportFigure]  # the pictures


# --- The page -------------------------------------------------------------------------------------------


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
        summary=summary(evaluation),
        warning=seen_warning(evaluation),
        boxes=main_numbers(evaluation),
        tables={
            "soil": soil_columns(evaluation),
            "force": force_columns(evaluation),
            "examples": example_columns(evaluation),
            "costs": cost_columns(evaluation),
        },
        groups=groups,
    )


def main_numbers(evaluation: Evaluation) -> list[tuple[str, str]]:
    """The four numbers that matter most, with words."""
    total = evaluation.total
    ratio = total.solver_rate / evaluation.timing.rollout
    if math.isnan(ratio):
        speed = "–", "speed beside the solver, whose time is not recorded"
    elif ratio >= 1.0:
        speed = f"{number(ratio, 2)} ×", "faster than the solver, one thread"
    else:
        speed = f"{number(1.0 / ratio, 2)} ×", "slower than the solver, one thread"
    return [
        (fixed(total.skill("frozen")), "position skill against a bed in which nothing moves"),
        (
            f"{number(total.rmse_mm('total'), 2)} mm",
            f"position error; frozen {number(total.rmse_mm('frozen'), 2)} mm",
        ),
        (
            fixed(total.force.overall_nrmse),
            f"force NRMSE; mean force {fixed(total.mean_force.overall_nrmse)}",
        ),
        speed,
    ]


# --- Which pictures it shows, of which runs, with which words -------------------------------------------


def file_name(text: str) -> str:
    """The text with everything but letters, digits, - and _ replaced."""
    return re.sub(r"[^A-Za-z0-9_-]+", "-", text)


def picture(name: str, title: str, caption: str, figure: Figure) -> ReportFigure:
    """A picture with its words; the name becomes that of a file."""
    return ReportFigure(file_name(name), title, caption, png(figure))


@contextmanager
def both_runs(chosen: EvaluatedRun) -> Iterator[tuple[Run, Run]]:
    """The simulated and the predicted run, open."""
    with Run(chosen.truth) as truth, Run(chosen.rollout) as prediction:
        yield truth, prediction


def report_figures(evaluation: Evaluation) -> list[FigureGroup]:
    """Draws every picture of the report."""
    ranked = sorted(evaluation.runs, key=lambda run: run.scores.mse["total"])
    typical, worst = ranked[(len(ranked) - 1) // 2], ranked[-1]
    groups = [side_views_of(evaluation, typical, "Typical run" if typical is not worst else "Run")]
    if worst is not typical:
        groups.append(side_views_of(evaluation, worst, "Worst run"))
    others = [run for run in evaluation.runs if run not in (typical, worst)][:MOST_SIDE_VIEWS]
    groups += [
        half_way(evaluation, others),
        in_space(evaluation, typical),
        *histories(evaluation),
        by_particle(evaluation),
        in_subspace(evaluation, typical),
        reduction(evaluation),
        training(evaluation),
    ]
    for path in evaluation.new_rollouts:
        with Run(path) as run:
            groups.append(new_path(evaluation, run))
    return [group for group in groups if group.figures]


def side_views_of(evaluation: Evaluation, chosen: EvaluatedRun, label: str) -> FigureGroup:
    """Side views and surface of one run at several moments, truth and prediction."""
    with both_runs(chosen) as (truth, prediction):
        runs = {MPM: truth, NETWORK: prediction}
        frames = view_times(truth, evaluation.history)
        scales = common_scales([truth, prediction], frames, evaluation.start)
        figures = [
            picture(
                f"side_{chosen.name}_{count}",
                f"{chosen.label}: side view at {truth.time[frame]:.2f} s",
                "Simulated above, predicted below.",
                side_view(runs, frame, scales),
            )
            for count, frame in enumerate(frames, start=1)
        ]
        surface = picture(
            f"surface_{chosen.name}",
            f"{chosen.label}: surface along mid-width",
            "Height of the highest particle of every column: black simulated, blue predicted.",
            profile_figure(runs, frames, surface_grid(evaluation.start)),
        )
        return FigureGroup(
            f"{label}: side view and surface",
            f"{titled(chosen.label, truth.scene)}. Soil within a slice at mid-width, coloured by speed; the arrow is "
            "the force by the soil on the tool. Simulated above, predicted below, with the same scales at all times: "
            "look at the shape of the pile before the tool, at how far the dark zone reaches, and at the arrows.",
            [*figures, surface],
        )


def half_way(evaluation: Evaluation, chosen: Sequence[EvaluatedRun]) -> FigureGroup:
    """Side views of more runs, at one moment each."""
    figures = []
    for run in chosen:
        with both_runs(run) as (truth, prediction):
            frame = view_times(truth, evaluation.history)[1]
            scales = common_scales([truth, prediction], [frame], evaluation.start)
            figures.append(
                picture(
                    f"side_{run.name}",
                    f"{run.label}: side view at {prediction.time[frame]:.2f} s",
                    f"Simulated above, predicted below. {run.words}",
                    side_view({MPM: truth, NETWORK: prediction}, frame, scales),
                )
            )
    return FigureGroup(
        "More runs, half-way",
        "As above, at one moment of each run. Colours and arrows have scales of their own in every picture.",
        figures,
    )


def in_space(evaluation: Evaluation, chosen: EvaluatedRun) -> FigureGroup:
    """The whole bed in three dimensions at one moment."""
    with both_runs(chosen) as (truth, prediction):
        frame = view_times(truth, evaluation.history)[1]
        views = solid_views(truth, prediction, frame, evaluation.start)
        figures = [
            picture(
                f"solid_{chosen.name}_{count}",
                f"{chosen.label} in three dimensions: {title}",
                f"All particles and the tool in three dimensions at {truth.time[frame]:.2f} s.",
                figure,
            )
            for count, (title, figure) in enumerate(views.items(), start=1)
        ]
    return FigureGroup(
        f"The whole bed: run {chosen.label}",
        "Every particle, coloured by how far it has moved, simulated and predicted with one scale; then by how far the "
        "prediction is from the simulated place: dark spots are where it is wrong. The arrow is the force on "
        "the tool, from its centre of mass.",
        figures,
    )


def histories(evaluation: Evaluation) -> list[FigureGroup]:
    """Force, torque and errors through time of the runs of the split."""
    shown = list(evaluation.runs)[:MOST_RUNS]
    left_out = len(evaluation.runs) - len(shown)
    more = f" {left_out} more runs are in the tables only." if left_out else ""
    forces, torques, errors = [], [], []
    for run in shown:
        with both_runs(run) as (truth, prediction):
            both = (truth, prediction, evaluation.history)
            nrmse = fixed(run.scores.force.overall_nrmse)
            for figures, name, caption, panels in (
                (forces, "force", f"NRMSE {nrmse}. {run.words}", force_panels(*both, evaluation.mean_force)),
                (
                    torques,
                    "torque",
                    f"NRMSE {fixed(run.scores.torque.overall_nrmse)}.",
                    torque_panels(*both, evaluation.mean_torque),
                ),
                (
                    errors,
                    "error",
                    f"Position RMSE {number(run.scores.rmse_mm('total'))} mm, force NRMSE {nrmse}.",
                    error_panels(run.errors, *both, evaluation.mean_force),
                ),
            ):
                if panels:
                    title = f"{run.label}: {name} through time"
                    figures.append(picture(f"{name}_{run.name}", title, caption, history_figure(panels)))
    return [
        FigureGroup(
            "Force through time",
            "By the soil on the tool, frame means, not smoothed: black simulated, blue predicted, dashed the mean of "
            f"the training runs. A wheel's sinkage stands below its forces.{more}",
            forces,
        ),
        FigureGroup(
            "Torque through time",
            "About the tool's centre of mass, likewise; axes about which there is next to none are left out.",
            torques,
        ),
        FigureGroup(
            "Error through time",
            "Positions: the network should stay near “PCA alone”, the least error any prediction in this subspace can "
            "have, and far below the grey guesses: nothing moves (dashed), every particle goes on at its last given "
            "speed (dotted; it may leave the picture). Force: length of the error vector, beside that of the "
            f"training runs' mean.{more}",
            errors,
        ),
    ]


def by_particle(evaluation: Evaluation) -> FigureGroup:
    """How the errors are spread over particles."""
    particles = [run.errors.particles for run in evaluation.runs if run.errors.particles is not None]
    figures = [
        picture(
            "particles",
            "Error by particle",
            f"{len(particles)} runs together; dotted: the median. Below 1 µm counts as 1 µm.",
            histogram_figure(particles),
        )
    ]
    return FigureGroup(
        "Error by particle",
        "Mean square over time of every particle's position error, on a logarithmic axis: what the reduction "
        "leaves out, and what the network adds within the subspace. Most particles hardly move; the bars far to "
        "the right are the soil that the tool carries.",
        figures,
    )


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
    return FigureGroup(
        f"What the network steps: the subspace of run {chosen.label}",
        "Every mode is a point with three coordinates; these points, numbered, and the body are all that the network "
        "sees. Lines are the ways they have come; where blue dots fill the black rings, the prediction is right. "
        "Arrows: force on the body, which is drawn at its true place and size.",
        figures,
    )


def reduction(evaluation: Evaluation) -> FigureGroup:
    """Energy of the modes and reconstruction error."""
    curves = evaluation.curves
    network = evaluation.total.rmse_mm("total")
    return FigureGroup(
        "What the subspace can hold",
        "The more modes, the less is lost. If the network's line lies near the curve at its number of modes, "
        "more modes would help it; if far above, a better network would.",
        [
            picture(
                "energy",
                "Energy that the modes leave out",
                "The paper's energy counts the layout of the bed unless every particle is centred; "
                "displacement energy counts motion only.",
                energy_figure(curves.energy, curves.displacement_energy, evaluation.num_modes),
            ),
            picture(
                "reconstruction",
                "Reconstruction error",
                f"Projection of the {evaluation.split} runs on r modes and back; the horizontal line is the "
                f"rollout's error with {evaluation.num_modes} modes.",
                reconstruction_figure(curves.held_out, curves.training, evaluation.num_modes, network),
            ),
        ],
    )


def training(evaluation: Evaluation) -> FigureGroup:
    """How the losses fell and the rollouts got better."""
    figures = []
    if evaluation.training_log:
        caption = "Losses of the training batches on a logarithmic axis; skill and force NRMSE of the validation runs."
        figures.append(picture("training", "Training", caption, training_figure(evaluation.training_log)))
    return FigureGroup(
        "How it was trained",
        "The loss is of single steps, the skill of whole rollouts of the validation runs, within the subspace: low "
        "losses alone are no proof. The checkpoint with the highest skill is kept.",
        figures,
    )


def new_path(evaluation: Evaluation, run: Run) -> FigureGroup:
    """Side views and force of a path that was never simulated."""
    name = run.path.stem
    frames = view_times(run, 1)
    scales = common_scales([run], frames, evaluation.start)
    figures = [
        picture(
            f"new_side_{name}_{count}",
            f"{name}: side view at {run.time[frame]:.2f} s",
            "Predicted soil at mid-width, coloured by speed, and the predicted force.",
            side_view({NETWORK: run}, frame, scales),
        )
        for count, frame in enumerate(frames, start=1)
    ]
    force = picture(
        f"new_force_{name}",
        f"{name}: predicted force",
        "Frame means; dashed: the mean of the training runs.",
        history_figure(force_panels(None, run, min(1, run.frame_count - 1), evaluation.mean_force)),
    )
    return FigureGroup(
        f"A path that was never simulated: {name}",
        f"{describe(run.scene) or name}. There is no truth to compare with.",
        [*figures, force],
    )
