"""What does a network add to models whose coefficients follow from linear algebra?

    python experiments/ablation/closed_form.py --checkpoint <best.ckpt>
    python experiments/ablation/closed_form.py --published <folder with the authors' excavation/ and wheel/>

Fits linear and quadratic ridge regressions and sparse polynomials to the reduced training runs of a dataset, chooses
their settings by rollouts of the validation runs, and writes closed_form.csv beside this script, with the baselines
and the network of a checkpoint. With `--published` it does four folds over the authors' runs instead and writes
closed_form_published.csv.
"""

from __future__ import annotations

import argparse
import csv
import logging
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf

from sgns.data.dataset import Dataset
from sgns.data.published import PARTICLES, published_dataset
from sgns.model.checkpoint import load_surrogate
from sgns.model.dynamics import Dynamics
from sgns.model.features import moves_freely, varying_context
from sgns.model.settings import FitSettings, PolynomialSettings
from sgns.reduction.reduce import ReducedRun, reduce_dataset
from sgns.train.polynomial import (
    Moments,
    best_polynomial,
    candidates,
    moments,
    ridge,
    select,
    solved,
    unfitted,
)
from sgns.train.validation import RolloutScore, ValidationRollouts
from sgns.train.windows import TrainingWindows

HERE = Path(__file__).parent
HISTORY = 3  # d, as in conf/model
NUM_MODES = (2, 4, 8)
THRESHOLDS = (0.01, 0.03, 0.1)
# Degree and thresholds; a threshold of zero means ridge regression.
MODELS = ((1, (0.0,)), (2, (0.0, *THRESHOLDS)))
NAMES = {1: "linear", 2: "quadratic"}

FOLDS = 4
PUBLISHED_MODES = 8


class Totals:
    """Squared errors of one or more sets of rollouts.

    Args:
        particles: Soil particles that the modes stand for.
    """

    def __init__(self, particles: int) -> None:
        self.particles = particles
        self.runs = 0
        self.sums = dict.fromkeys(("frozen", "position", "at_rest", "truth", "force", "force_at_rest"), 0.0)

    def add(self, rollouts: ValidationRollouts, score: RolloutScore) -> None:
        """One more set."""
        frozen = rollouts.squares(rollouts.latent[:, HISTORY - 1, None] - rollouts.latent)
        truth = float(rollouts.force[rollouts.counted].square().sum())
        self.runs += len(rollouts.names)
        for name, value in (
            ("frozen", frozen),
            ("position", (1 - score.skill) * frozen),
            ("at_rest", (1 - score.skill_at_rest) * frozen),
            ("truth", truth),
            ("force", score.force_nrmse**2 * truth),
            ("force_at_rest", score.force_nrmse_at_rest**2 * truth),
        ):
            self.sums[name] += value

    def columns(self, split: str) -> dict[str, float]:
        """Skill against frozen, RMS error of all particles' positions by the modes' error [mm], force NRMSE."""
        s = self.sums
        mse = s["position"] / (self.runs * 3 * self.particles)
        return {
            f"{split}_skill": round(1 - s["position"] / s["frozen"], 3),
            f"{split}_skill_at_rest": round(1 - s["at_rest"] / s["frozen"], 3),
            f"{split}_rmse_mm": round(1e3 * mse**0.5, 3),
            f"{split}_force_nrmse": round((s["force"] / s["truth"]) ** 0.5, 3),
            f"{split}_force_nrmse_at_rest": round((s["force_at_rest"] / s["truth"]) ** 0.5, 3),
        }


def constant_velocity(rollouts: ValidationRollouts, still: RolloutScore) -> RolloutScore:
    """Score of modes that keep the velocity of the d true frames; from rest they do not move.

    Args:
        rollouts: Whose runs.
        still: Score of modes that do not move.
    """
    last, before = rollouts.latent[:, HISTORY - 1, None], rollouts.latent[:, HISTORY - 2, None]
    ahead = torch.arange(rollouts.latent.shape[1])[:, None, None] - (HISTORY - 1)
    errors = [last + ahead * (last - before) - rollouts.latent, last - rollouts.latent]
    moving, frozen = (rollouts.squares(error) for error in errors)
    return still._replace(skill=1 - moving / frozen)


def baselines(
    model: Dynamics, others: Sequence[ValidationRollouts]
) -> Iterator[tuple[dict[str, Any], list[RolloutScore]]]:
    """What needs no fit but the mean force, which polynomials without coefficients predict."""
    still = [rollouts.measure(model) for rollouts in others]
    yield {"model": "frozen, mean force"}, still
    moving = [constant_velocity(rollouts, score) for rollouts, score in zip(others, still, strict=True)]
    yield {"model": "constant velocity, mean force"}, moving


def scores(
    windows: TrainingWindows, others: Sequence[ValidationRollouts], settings: FitSettings
) -> Iterator[tuple[dict[str, Any], list[RolloutScore]]]:
    """Every baseline and fitted model with its scores on some rollouts, the first of which choose the settings."""
    yield from baselines(unfitted(windows, PolynomialSettings(HISTORY, 1, [])), others)
    for degree, thresholds in MODELS:
        began = time.perf_counter()
        model = unfitted(windows, PolynomialSettings(HISTORY, degree, []))
        known = {noise: moments(model, windows, noise, settings.draws) for noise in settings.noises}
        shared = time.perf_counter() - began
        for threshold in thresholds:
            began = time.perf_counter()
            found = candidates(known, settings.penalties)
            if threshold:
                found = {of: sparse(known[of.noise], of.penalty, threshold) for of in found}
            motion, _, force = select(model, found, others[0])
            about = {
                "model": NAMES[degree] + (", sparse" if threshold else " ridge"),
                "threshold": threshold,
                "noise": motion.noise,
                "penalty": motion.penalty,
                "force_noise": force.noise,
                "force_penalty": force.penalty,
                "library": len(model.terms),
                "terms": model.num_terms,
                "seconds": round(shared + time.perf_counter() - began, 1),
            }
            yield about, [rollouts.measure(model) for rollouts in others]


def sparse(known: Moments, penalty: float, threshold: float, rounds: int = 10) -> torch.Tensor:
    """Sequentially thresholded least squares (SINDy: Brunton, Proctor, Kutz 2016, doi:10.1073/pnas.1517384113): ridge
    regression of each output, repeated without the terms whose RMS in a normalised output is below a threshold until
    there is none; shape (m, o), most of them zero."""
    size = known.gram.diagonal().sqrt()
    weight = torch.full_like(size, penalty)
    weight[0] = 0.0
    full = ridge(known, penalty)
    found = torch.zeros_like(full)
    for column, values in enumerate(full.unbind(1)):
        kept = torch.arange(len(full))
        for _ in range(rounds):
            large = values.abs() * size[kept] > threshold
            if bool(large.all()):
                break
            kept = kept[large]
            gram = known.gram[kept][:, kept] + weight[kept].diag()
            values = solved(gram, known.target[kept, column, None])[:, 0]
        found[kept, column] = values
    return found


def own_rows(config: Any, settings: FitSettings, checkpoint: Path | None) -> Iterator[dict[str, Any]]:
    """All models at r = 2, 4, 8 on the validation and the test runs of a dataset."""
    reduced = reduce_dataset(Dataset.open(config.dataset.path), config.reduction)
    network = None if checkpoint is None else load_surrogate(checkpoint).dynamics
    for r in NUM_MODES:
        splits = ("validation", "test")
        rollouts = [ValidationRollouts(reduced.runs(split), r, HISTORY, "pose") for split in splits]
        windows = TrainingWindows(reduced.runs("train"), r, HISTORY, "pose")
        found = list(scores(windows, rollouts, settings))
        if network is not None and (network.num_modes, network.history) == (r, HISTORY):
            found.append(({"model": "network"}, [one.measure(network) for one in rollouts]))
        for about, measured in found:
            row = {"data": config.dataset.name, "num_modes": r, **about}
            for split, one, score in zip(splits, rollouts, measured, strict=True):
                totals = Totals(len(reduced.start_positions))
                totals.add(one, score)
                row |= totals.columns(split)
            yield row


def fold_scores(
    known: Sequence[ReducedRun],
    rollouts: ValidationRollouts,
    context: list[str],
    settings: FitSettings,
    degrees: Sequence[int],
) -> Iterator[tuple[dict[str, Any], RolloutScore]]:
    """Baselines and ridge regressions of some runs with their scores on others.

    Every third run chooses the settings for which the rest of them were fitted; then all of them are fitted.
    """
    wheel = moves_freely(known)
    told = tuple(varying_context(known, context))
    everything = TrainingWindows(known, PUBLISHED_MODES, HISTORY, "pose", context=told)
    for about, (score,) in baselines(
        unfitted(everything, PolynomialSettings(HISTORY, 1, context), told, wheel), [rollouts]
    ):
        yield about, score
    for degree in degrees:
        model = PolynomialSettings(HISTORY, degree, context)
        began = time.perf_counter()
        fitted = best_polynomial(known, known[::3], PUBLISHED_MODES, model, settings)
        about = {
            "model": f"{NAMES[degree]} ridge",
            "library": len(fitted.dynamics.terms),
            "seconds": time.perf_counter() - began,
        }
        yield about, rollouts.measure(fitted.dynamics)


def published_rows(
    folder: Path, context: list[str], settings: FitSettings, degrees: Sequence[int]
) -> Iterator[dict[str, Any]]:
    """Ridge regressions on the authors' runs, every run predicted by the models of the fold that leaves it out."""
    for kind, particles in PARTICLES.items():
        rows: dict[str, dict[str, Any]] = {}
        totals: dict[str, Totals] = {}
        for fold in range(FOLDS):
            dataset = published_dataset(
                {"path": folder / kind, "folds": FOLDS, "fold": fold}, PUBLISHED_MODES
            )
            known, left_out = dataset.runs("train"), dataset.runs("test")
            told = varying_context(known, context)
            rollouts = ValidationRollouts(left_out, PUBLISHED_MODES, HISTORY, "pose", told)
            for about, score in fold_scores(known, rollouts, context, settings, degrees):
                logging.info("%s, fold %d: %s, skill %.3f", kind, fold, about, score.skill)
                name = about["model"]
                # The settings differ from fold to fold: the table has the sums.
                row = {"data": f"published {kind}", "num_modes": PUBLISHED_MODES, "model": name}
                if "library" in about:
                    seconds = rows.get(name, {}).get("seconds", 0.0) + about["seconds"]
                    row |= {"threshold": 0.0, "library": about["library"], "seconds": round(seconds, 1)}
                rows[name] = row
                totals.setdefault(name, Totals(particles)).add(rollouts, score)
        for name, row in rows.items():
            yield row | totals[name].columns("test")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--checkpoint", type=Path, default=None, help="a network to show beside them")
    parser.add_argument("--published", type=Path, default=None, help="the authors' runs instead")
    parser.add_argument(
        "--degrees", type=int, nargs="+", choices=(1, 2), default=(1, 2), help="of the published runs' models"
    )
    parser.add_argument("overrides", nargs="*", help="for example dataset=quick")
    options = parser.parse_intermixed_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    torch.set_num_threads(1)
    with initialize_config_module("sgns.conf", version_base="1.3"):
        config = compose("train", ["model=polynomial", *options.overrides])
    plain = OmegaConf.to_container(config, resolve=True)
    settings = FitSettings.from_dict(plain["training"] | {"linear": False})
    if options.published is None:
        name, found = "closed_form.csv", own_rows(config, settings, options.checkpoint)
    else:
        context = plain["model"]["context"]
        name, found = (
            "closed_form_published.csv",
            published_rows(options.published, context, settings, options.degrees),
        )
    rows = []
    for row in found:
        logging.info("%s", row)
        rows.append(row)
    columns = dict.fromkeys(column for row in rows for column in row)
    with (HERE / name).open("w", newline="") as stream:
        writer = csv.DictWriter(stream, list(columns))
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
