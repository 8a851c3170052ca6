"""How `sgns train model=polynomial` comes to its coefficients."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from sgns.errors import UserError
from sgns.learning.context import varying_context
from sgns.learning.data import TrainingWindows
from sgns.learning.polynomial import PolynomialDynamics
from sgns.learning.polynomial_fit import Choice, candidates, choose, moments, refitted, unfitted
from sgns.learning.polynomial_settings import FitSettings, PolynomialSettings
from sgns.learning.validation import RolloutScore, ValidationRollouts

if TYPE_CHECKING:
    from sgns.reduction.reduced import ReducedRun

__all__ = ["Fitted", "check_start", "fit_polynomial"]

log = logging.getLogger(__name__)


class Fitted(NamedTuple):
    """Fitted polynomials.

    Attributes:
        dynamics: The polynomials.
        choice: Noise and penalty of each group of outputs.
        score: On the runs that chose these.
    """

    dynamics: PolynomialDynamics
    choice: Choice
    score: RolloutScore

    def about(self) -> dict[str, Any]:
        """What training.json says of it beside the score."""
        groups = ("motion", "body", "force") if self.dynamics.predicts_body else ("motion", "force")
        found: dict[str, Any] = {"coefficients": self.dynamics.num_terms}
        for group in groups:
            setting = getattr(self.choice, group)
            degree = 1 if setting.linear else self.dynamics.settings.degree
            found[group] = {"degree": degree, "noise": setting.noise, "penalty": setting.penalty}
        return found


def fit_polynomial(
    runs: Sequence[ReducedRun],
    choosing: Sequence[ReducedRun],
    num_modes: int,
    model: PolynomialSettings,
    settings: FitSettings,
    predicts_body: bool,
    seed: int = 0,
) -> Fitted:
    """Fit polynomials for every noise and penalty and take what follows some runs best.

    Args:
        runs: For training.
        choosing: Runs whose rollouts choose noise and penalty. Where they are among those for training, they are first
            left out of the fit; the score is that of the fit without them, the result that of the fit with them.
        num_modes: r.
        model: What to fit.
        settings: How.
        predicts_body: Whether the body's height is predicted.
        seed: Of the noise.
    """
    context = tuple(varying_context(runs, model.context))

    def windows_of(some: Sequence[ReducedRun]) -> TrainingWindows:
        return TrainingWindows(some, num_modes, model.history, model.body_nodes, seed, context=context)

    def blank(windows: TrainingWindows) -> PolynomialDynamics:
        return unfitted(windows, model, context, predicts_body, settings.normalisation_floor)

    names = {run.name for run in choosing}
    # A single run has to do for both.
    fitting = [run for run in runs if run.name not in names] or list(runs)
    windows = windows_of(fitting)
    dynamics = blank(windows)
    known = {noise: moments(dynamics, windows, noise, settings.draws) for noise in settings.noises}
    log.info("%d windows, %d monomials of %d inputs", len(windows), len(dynamics.terms), len(dynamics.used))
    rollouts = ValidationRollouts(choosing, num_modes, model.history, model.body_nodes, context)
    linear = settings.linear and model.degree > 1
    found = candidates(known, settings.penalties, linear=linear)
    choice = choose(dynamics, found, rollouts)
    score = rollouts.measure(dynamics)
    if len(fitting) < len(runs):
        windows = windows_of(runs)
        dynamics = blank(windows)
        refitted(dynamics, windows, choice, settings.draws)
    return Fitted(dynamics, choice, score)


def check_start(start_from: str | Path | None, device: str) -> None:
    """Refuses what polynomials have no use for."""
    if start_from is not None:
        raise UserError(
            f"checkpoint is {start_from}, but polynomials start from nothing; use checkpoint=null"
        )
    if device != "cpu":
        raise UserError(f"device is {device}, but polynomials are fitted on the CPU; use device=cpu")
