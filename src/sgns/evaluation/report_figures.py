"""Which pictures a report shows, of which runs, with which words."""

from __future__ import annotations

import re
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sgns.evaluation import figures
from sgns.evaluation.report_words import describe, titled
from sgns.evaluation.sideview import side_views, view_times
from sgns.evaluation.surface import surface_grid
from sgns.runs import Run

if TYPE_CHECKING:
    from sgns.evaluation.results import EvaluatedRun, Evaluation

__all__ = ["ReportFigure", "report_figures"]

# More panels than this in one picture cannot be read.
MOST_PANELS = 9


@dataclass(frozen=True)
class ReportFigure:
    """A picture of the report.

    Attributes:
        name: of its file, without ending.
        group: heading that it stands under.
        title: a few words.
        caption: what to see in it.
        png: the picture.
    """

    name: str
    group: str
    title: str
    caption: str
    png: bytes


def file_name(text: str) -> str:
    """The text with everything but letters, digits, - and _ replaced."""
    return re.sub(r"[^A-Za-z0-9_-]+", "-", text)


def report_figures(evaluation: Evaluation) -> list[ReportFigure]:
    """Draws every picture of the report."""
    ranked = sorted(evaluation.runs, key=lambda run: run.scores.mse["total"])
    typical, worst = ranked[(len(ranked) - 1) // 2], ranked[-1]
    drawn = comparison(evaluation, typical, "Typical run" if typical is not worst else "Run")
    if worst is not typical:
        drawn += comparison(evaluation, worst, "Worst run")
    drawn += histories(evaluation)
    drawn += reduction(evaluation)
    for path in evaluation.new_rollouts:
        with Run(path) as run:
            drawn += new_path(evaluation, run)
    return drawn


def comparison(evaluation: Evaluation, chosen: EvaluatedRun, label: str) -> list[ReportFigure]:
    """Side views and surface of one run, truth beside prediction."""
    with ExitStack() as stack:
        truth = stack.enter_context(Run(chosen.truth))
        prediction = stack.enter_context(Run(chosen.rollout))
        frames = view_times(truth, evaluation.history)
        words = titled(chosen.label, truth.scene)
        group = f"{label}: side view and surface"
        runs = {"simulated (MPM)": truth, "network": prediction}
        view = side_views(runs, frames, evaluation.start)
        profile = figures.profile_figure(runs, frames, surface_grid(evaluation.start))
    return [
        ReportFigure(
            f"side_{file_name(chosen.name)}",
            group,
            words,
            "Soil within a slice at mid-width, coloured by speed; the arrow is the force by the soil on "
            "the tool, same scales left and right.",
            figures.png(view),
        ),
        ReportFigure(
            f"surface_{file_name(chosen.name)}",
            group,
            f"{chosen.label}: surface along mid-width",
            "Height of the highest particle of every column.",
            figures.png(profile),
        ),
    ]


def histories(evaluation: Evaluation) -> list[ReportFigure]:
    """Force and position error through time of the runs of the split."""
    shown = list(evaluation.runs)[:MOST_PANELS]
    more = len(evaluation.runs) - len(shown)
    note = f" {more} more runs are in the tables only." if more else ""
    forces: list[figures.ForceHistory] = []
    for run in shown:
        with Run(run.truth) as truth, Run(run.rollout) as prediction:
            start = float(truth.time[evaluation.history])
            forces.append(
                figures.ForceHistory(
                    titled(run.label, truth.scene), truth.time, prediction.force, truth.force, start
                )
            )
    return [
        ReportFigure(
            "force",
            "Force through time",
            "Draft and vertical force",
            f"Frame means, not smoothed; dashed: the mean of the training runs.{note}",
            figures.png(figures.force_figure(forces, evaluation.mean_force)),
        ),
        ReportFigure(
            "error",
            "Position error through time",
            "Position error",
            "Dashed: nothing moves after the given frames. Dotted: every particle goes on at its last "
            "given speed (may leave the picture). PCA alone: the least error any prediction in this "
            f"subspace can have.{note}",
            figures.png(figures.error_figure({run.label: run.errors for run in shown})),
        ),
    ]


def reduction(evaluation: Evaluation) -> list[ReportFigure]:
    """Energy of the modes and reconstruction error."""
    curves = evaluation.curves
    network = evaluation.total.rmse_mm("total")
    return [
        ReportFigure(
            "energy",
            "Subspace",
            "Energy that the modes leave out",
            "The paper's energy counts the layout of the bed unless every particle is centred; "
            "displacement energy counts motion only.",
            figures.png(
                figures.energy_figure(curves.energy, curves.displacement_energy, evaluation.num_modes)
            ),
        ),
        ReportFigure(
            "reconstruction",
            "Subspace",
            "Reconstruction error",
            f"Projection of the {evaluation.split} runs on r modes and back; the horizontal line is the "
            f"rollout's error with {evaluation.num_modes} modes.",
            figures.png(
                figures.reconstruction_figure(curves.held_out, curves.training, evaluation.num_modes, network)
            ),
        ),
    ]


def new_path(evaluation: Evaluation, run: Run) -> list[ReportFigure]:
    """Side views and force of a path that was never simulated."""
    name = run.path.stem
    words = describe(run.scene)
    frames = view_times(run, 1)
    group = f"A path that was never simulated: {name}"
    force = figures.ForceHistory(
        titled(name, run.scene), run.time, run.force, start=float(run.time[min(1, run.frame_count - 1)])
    )
    return [
        ReportFigure(
            f"new_side_{file_name(name)}",
            group,
            words or name,
            "Predicted soil at mid-width, coloured by speed, and the predicted force on the tool. There "
            "is no truth to compare with.",
            figures.png(side_views({"network": run}, frames, evaluation.start)),
        ),
        ReportFigure(
            f"new_force_{file_name(name)}",
            group,
            f"{name}: predicted force",
            "Frame means; dashed: the mean of the training runs.",
            figures.png(figures.force_figure([force], evaluation.mean_force)),
        ),
    ]
