"""Coefficients of `PolynomialDynamics`: ridge regression (dynamic mode decomposition with control: Proctor, Brunton,
Kutz 2016, doi:10.1137/15M1013857).

It needs only the moments of monomials and outputs, summed once over all windows and noise draws. What one step
cannot tell, the noise and the penalty, is selected by rollouts of validation runs.

Letters: B batch, r modes, p inputs, m monomials, f free axes of the body, o = 3r + f + 6 outputs.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from sgns.config import UserError
from sgns.model.checkpoint import Surrogate
from sgns.model.dynamics import Standardiser
from sgns.model.features import moves_freely, varying_context
from sgns.model.polynomial import PolynomialDynamics, normalised
from sgns.numbers import elapsed
from sgns.settings import FitSettings, PolynomialSettings
from sgns.train import Fit, Fitted, Task
from sgns.train.validation import RolloutScore, ValidationRollouts
from sgns.train.windows import Batch, TrainingWindows, generator, random_walk

if TYPE_CHECKING:
    from sgns.reduction.basis import Basis
    from sgns.reduction.reduce import ReducedRun

log = logging.getLogger(__name__)


# Windows whose monomials are in memory at once.
_CHUNK = 2048
# An input with less deviation than this after normalisation is fixed, or zero by symmetry: no use as a factor.
_STILL = 0.01


_bar = partial(tqdm, unit="fit", leave=False, disable=None, delay=3.0)


class Setting(NamedTuple):
    """How coefficients are found."""

    noise: float  # deviation of the velocity noise on the history, share of each mode's velocity scale [1]
    penalty: float  # of the squares of the coefficients, beside the mean square of the normalised outputs [1]
    linear: bool = False  # whether products of inputs are left out


class Selection(NamedTuple):
    """How the coefficients of each group of outputs are found."""

    motion: Setting  # of the modes
    body: Setting  # of a body's free axes
    force: Setting  # of force and torque


class Moments(NamedTuple):
    """Means over windows."""

    gram: Tensor  # products of monomials [1], shape (m, m)
    target: Tensor  # products of monomials and normalised outputs [1], shape (m, o)
    linear: int  # how many monomials, the first ones, are no products of inputs: p + 1


def unfitted(
    windows: TrainingWindows,
    settings: PolynomialSettings,
    context: tuple[str, ...] = (),
    predicts_body: bool = False,
    floor: float = 0.01,
) -> PolynomialDynamics:
    """Polynomials with the statistics of the training windows and all coefficients zero.

    They predict that nothing moves and that the force is the training runs' mean. `context` are the keys of the scene
    whose numbers the windows hold; no scale is below the share `floor` of the quantity's largest.
    """
    batch = windows.windows(windows.targets)
    modes = batch.latent.shape[2]
    blank = PolynomialDynamics(settings, modes, context, predicts_body, ())
    groups = blank.raw_inputs(batch.history, batch.body, batch.context)
    # Velocities and motions keep their zero, which means rest. What is free of a body moves little beside what is
    # prescribed, and the numbers of the context have nothing in common: no floor for these.
    centred = (True, False, True, True, False, False, True, False, True)
    floors = (floor,) * 6 + (0.0,) * 3
    inputs = Standardiser.cat(map(Standardiser.fit, groups, floors, centred))
    values = normalised(inputs, groups)
    used = (values.std(0) > _STILL).nonzero()[:, 0]
    model = PolynomialDynamics(settings, modes, context, predicts_body, used.tolist())
    model.inputs = inputs
    model.bounds = torch.stack([values[:, used].amin(0), values[:, used].amax(0)])
    velocity, rise, force, torque = true_outputs(model, batch)
    model.velocity = Standardiser.fit(velocity, floor, centred=False)
    model.body_displacement = Standardiser.fit(rise, centred=False)
    model.force = Standardiser.fit(force, floor)
    model.torque = Standardiser.fit(torque, floor)
    return model


def true_outputs(model: PolynomialDynamics, batch: Batch) -> list[Tensor]:
    """Velocities [m], the body's displacement along free axes [m], force [N] and torque [N m], each (B, width).

    The true velocity whatever error the history has: errors of the velocity are corrected and those of the position
    left, as the network is taught.
    """
    velocity = batch.latent[:, -1] - batch.latent[:, -2]
    rise = batch.body.motion[:, -1, 0, :3][:, model.free]
    return [velocity.flatten(1), rise, batch.force[:, 0], batch.torque[:, 0]]


def moments(
    model: PolynomialDynamics, windows: TrainingWindows, noise: float = 0.0, draws: int = 2
) -> Moments:
    """Moments of a model's monomials and outputs over all windows, taken `draws` times with other noise each time (see
    `Setting`); the model's coefficients do not matter."""
    scale = noise * model.velocity.scale.unflatten(0, (-1, 3))
    body_scale = torch.zeros(1, 3, dtype=torch.float64)
    body_scale[:, model.free] = noise * model.body_displacement.scale
    outputs = Standardiser.cat(model.outputs())
    gram = torch.zeros(2 * model.weights.shape[:1], dtype=torch.float64)
    target = torch.zeros_like(model.weights)
    for draw in range(draws):
        source, body_source = (generator(windows.seed, draw, stream) for stream in (1, 2))
        for targets in windows.targets.split(_CHUNK):
            shape = len(targets), windows.history
            walks = random_walk(scale, shape, source), random_walk(body_scale, shape, body_source)
            batch = windows.windows(targets, walks)
            monomials = model.monomials(batch.history, batch.shown_body, batch.context)
            gram += monomials.T @ monomials
            target += monomials.T @ normalised(outputs, true_outputs(model, batch))
    count = draws * len(windows)
    return Moments(gram / count, target / count, len(model.used) + 1)


def ridge(known: Moments, penalty: float) -> Tensor:
    """Least squares with a penalty on the squares of all coefficients but the constants', shape (m, o)."""
    gram = known.gram.clone()
    gram.diagonal()[1:] += penalty
    return solved(gram, known.target)


def solved(gram: Tensor, target: Tensor) -> Tensor:
    """Solution of the normal equations; the smallest one where they do not determine it."""
    factor, failed = torch.linalg.cholesky_ex(gram)
    if int(failed):
        return torch.linalg.lstsq(gram, target, driver="gelsd").solution
    return torch.cholesky_solve(target, factor)


def coefficients(known: Moments, setting: Setting) -> Tensor:
    """`ridge` with a setting's penalty, zero for the products that it leaves out; shape (m, o)."""
    if not setting.linear:
        return ridge(known, setting.penalty)
    n = known.linear
    found = torch.zeros_like(known.target)
    found[:n] = ridge(Moments(known.gram[:n, :n], known.target[:n], n), setting.penalty)
    return found


def candidates(
    known: Mapping[float, Moments], penalties: Sequence[float], linear: bool = False
) -> dict[Setting, Tensor]:
    """Coefficients for every penalty and every noise that the moments of a model are known for; with `linear`
    also those without products of inputs."""
    settings = [Setting(noise, penalty) for noise in known for penalty in penalties]
    if linear:
        settings += [setting._replace(linear=True) for setting in settings]
    return {
        setting: coefficients(known[setting.noise], setting)
        for setting in _bar(settings, desc="coefficients")
    }


def select(
    model: PolynomialDynamics, found: Mapping[Setting, Tensor], rollouts: ValidationRollouts
) -> Selection:
    """Give a model the best coefficients: of the modes by the skill of rollouts, then of a free body by its error
    along the rollouts of these modes, then of force and torque by the force error along those of both."""

    def score(*selection: Setting) -> RolloutScore:
        take(model, *(found[setting] for setting in selection))
        return rollouts.measure(model)

    motion = body = max(
        _bar(found, desc="rollouts"), key=lambda setting: score(setting, setting, setting).skill
    )
    if model.predicts_body:
        body = min(found, key=lambda setting: score(motion, setting, motion).body_rmse)
    force = min(found, key=lambda setting: score(motion, body, setting).force_nrmse)
    take(model, found[motion], found[body], found[force])
    return Selection(motion, body, force)


def take(model: PolynomialDynamics, motion: Tensor, body: Tensor, force: Tensor) -> None:
    """Coefficients of the modes, of a free body, and of force and torque from a matrix each."""
    modes = 3 * model.num_modes
    model.weights.copy_(torch.cat([motion[:, :modes], body[:, modes:-6], force[:, -6:]], dim=1))


def refitted(
    model: PolynomialDynamics, windows: TrainingWindows, selection: Selection, draws: int = 2
) -> None:
    """Give a model the coefficients of settings that `select` found on a part of these windows."""
    known = {noise: moments(model, windows, noise, draws) for noise in {of.noise for of in selection}}
    take(model, *(coefficients(known[setting.noise], setting) for setting in selection))


# --- From runs to a checkpoint ----------------------------------------------------------------------------


class FittedPolynomial(NamedTuple):
    """Fitted polynomials, and what chose noise and penalty of each group of outputs."""

    dynamics: PolynomialDynamics
    selection: Selection
    score: RolloutScore  # on the runs that chose these

    def about(self) -> dict[str, Any]:
        """What training.json says of it beside the score."""
        found: dict[str, Any] = {"coefficients": self.dynamics.num_terms}
        for group, setting in self.selection._asdict().items():
            degree = 1 if setting.linear else self.dynamics.settings.degree
            if group != "body" or self.dynamics.predicts_body:
                found[group] = {"degree": degree, "noise": setting.noise, "penalty": setting.penalty}
        return found


def best_polynomial(
    runs: Sequence[ReducedRun],
    choosing: Sequence[ReducedRun],
    num_modes: int,
    model: PolynomialSettings,
    settings: FitSettings,
    seed: int = 0,
    basis: Basis | None = None,
) -> FittedPolynomial:
    """Fit polynomials for every noise and penalty and take what follows some runs best.

    The rollouts of the runs in `choosing` choose. Where they are among those for training, they are first left out of
    the fit; the score is that of the fit without them, the result that of the fit with them. `seed` is of the noise;
    without the `basis` the score is that in the subspace.
    """
    context, free = tuple(varying_context(runs, model.context)), moves_freely(runs)

    def begun(some: Sequence[ReducedRun]) -> tuple[TrainingWindows, PolynomialDynamics]:
        windows = TrainingWindows(some, num_modes, model.history, model.body_nodes, seed, context=context)
        return windows, unfitted(windows, model, context, free, settings.normalisation_floor)

    names = {run.name for run in choosing}
    # A single run has to do for both.
    fitting = [run for run in runs if run.name not in names] or list(runs)
    windows, dynamics = begun(fitting)
    log.info("%d windows, %d monomials of %d inputs", len(windows), len(dynamics.terms), len(dynamics.used))
    if len(dynamics.terms) > len(windows):
        log.warning(
            "there are more coefficients of each output (%d) than windows of training runs (%d): fitting takes long "
            "and the penalty decides most; use more runs, fewer reduction.num_modes or model.degree=1",
            len(dynamics.terms),
            len(windows),
        )
    known = {
        noise: moments(dynamics, windows, noise, settings.draws)
        for noise in _bar(settings.noises, desc="sums")
    }
    rollouts = ValidationRollouts(choosing, num_modes, model.history, model.body_nodes, context, basis)
    found = candidates(known, settings.penalties, settings.linear and model.degree > 1)
    selection = select(dynamics, found, rollouts)
    score = rollouts.measure(dynamics)
    if len(fitting) < len(runs):
        windows, dynamics = begun(runs)
        refitted(dynamics, windows, selection, settings.draws)
    return FittedPolynomial(dynamics, selection, score)


def fit_polynomial(task: Task) -> Fitted:
    """Fit polynomials and write their checkpoint; nothing of before is of use to them."""
    if task.start_from is not None:
        raise UserError(
            f"checkpoint is {task.start_from}, but polynomials start from nothing; use checkpoint=null"
        )
    if task.device != "cpu":
        raise UserError(f"device is {task.device}, but polynomials are fitted on the CPU; use device=cpu")
    began = time.perf_counter()
    best = best_polynomial(
        task.reduced.runs("train"),
        task.validation_runs,
        task.num_modes,
        task.model,
        task.settings,
        task.seed,
        task.reduced.of_modes(task.num_modes),
    )
    seconds = elapsed(began, time.perf_counter())
    surrogate = Surrogate.of(best.dynamics, task.reduced, task.card)
    surrogate.save(task.output / "best.ckpt")
    return Fitted(surrogate, best.score, seconds, best.about())


POLYNOMIAL = Fit(slice(None, None, 3), "every third training run chooses noise and penalty", fit_polynomial)
