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

import numpy as np
import torch
from hydra import compose, initialize_config_module
from torch import Tensor

from sgns.campaign import Dataset
from sgns.learning.body import BodyTrack
from sgns.learning.closed_form_fit import candidates, choose, fit, moments, unfitted
from sgns.learning.data import TrainingWindows
from sgns.learning.surrogate import load_surrogate
from sgns.learning.validation import RolloutScore, ValidationRollouts
from sgns.published import PublishedRun, read_published, wheel_case
from sgns.reduction.reduced import ReducedRun, reduce_dataset

HERE = Path(__file__).parent
HISTORY = 3  # d, as in conf/model
NUM_MODES = (2, 4, 8)
NOISES = (0.1, 0.3, 1.0)
PENALTIES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)
THRESHOLDS = (0.01, 0.03, 0.1)
# Degree and thresholds; a threshold of zero means ridge regression.
MODELS = ((1, (0.0,)), (2, (0.0, *THRESHOLDS)))
RIDGE = ((1, (0.0,)), (2, (0.0,)))

FOLDS = 4
# Soil particles of the published bases (which are not published themselves).
PARTICLES = {"excavation": 4880, "wheel": 6005}
BIN_SIZE = (0.8, 0.6, 0.15)  # of the excavation runs [m]; for the wheel no more than a shift of the origin


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


def scores(
    windows: TrainingWindows,
    validation: ValidationRollouts,
    others: Sequence[ValidationRollouts],
    models: Sequence[tuple[int, Sequence[float]]],
    everything: TrainingWindows | None = None,
) -> Iterator[tuple[dict[str, Any], list[RolloutScore]]]:
    """Every baseline and fitted model with its scores on some rollouts.

    Args:
        windows: What to fit to.
        validation: What chooses the settings.
        others: What the scores are of.
        models: Degrees and thresholds.
        everything: What to fit to again once the settings are chosen.
    """
    baseline = unfitted(everything or windows, 1)
    still = [rollouts.measure(baseline) for rollouts in others]
    yield {"model": "frozen, mean force"}, still
    moving = [constant_velocity(rollouts, score) for rollouts, score in zip(others, still, strict=True)]
    yield {"model": "constant velocity, mean force"}, moving
    for degree, thresholds in models:
        began = time.perf_counter()
        model = unfitted(windows, degree)
        known = {noise: moments(model, windows, noise) for noise in NOISES}
        shared = time.perf_counter() - began
        for threshold in thresholds:
            began = time.perf_counter()
            motion, force = choose(model, candidates(known, PENALTIES, threshold), validation)
            chosen = fit(everything, degree, motion, force) if everything else model
            about = {
                "model": ("linear", "quadratic")[degree - 1] + (", sparse" if threshold else " ridge"),
                "threshold": threshold,
                "noise": motion.noise,
                "penalty": motion.penalty,
                "force_noise": force.noise,
                "force_penalty": force.penalty,
                "library": len(chosen.terms),
                "terms": chosen.num_terms,
                "seconds": round(shared + time.perf_counter() - began, 1),
            }
            yield about, [rollouts.measure(chosen) for rollouts in others]


def own_rows(overrides: Sequence[str], checkpoint: Path | None) -> Iterator[dict[str, Any]]:
    """All models at r = 2, 4, 8 on the validation and the test runs of a dataset."""
    with initialize_config_module("sgns.conf", version_base="1.3"):
        config = compose("train", list(overrides))
    reduced = reduce_dataset(Dataset.open(config.dataset.path), config.reduction)
    network = None if checkpoint is None else load_surrogate(checkpoint).dynamics
    for r in NUM_MODES:
        splits = ("validation", "test")
        rollouts = [ValidationRollouts(reduced.runs(split), r, HISTORY, "pose") for split in splits]
        windows = TrainingWindows(reduced.runs("train"), r, HISTORY, "pose")
        found = list(scores(windows, rollouts[0], rollouts, MODELS))
        if network is not None and (network.num_modes, network.history) == (r, HISTORY):
            found.append(({"model": "network"}, [one.measure(network) for one in rollouts]))
        for about, measured in found:
            row = {"data": config.dataset.name, "num_modes": r, **about}
            for split, one, score in zip(splits, rollouts, measured, strict=True):
                totals = Totals(len(reduced.start_positions))
                totals.add(one, score)
                row |= totals.columns(split)
            yield row


def planar_poses(run: PublishedRun, kind: str) -> np.ndarray:
    """Poses of a body that turns about the lateral axis only, from its points, shape (T, 7).

    A blade's place is the middle of its lowest row and its direction that of a column; a wheel's are the mean of its
    points and the direction of one of them.
    """
    points = run.body_points
    if kind == "excavation":
        lowest = np.isclose(points[0, :, 2], points[0, :, 2].min(), atol=1e-3)
        place = points[:, lowest].mean(axis=1)
        arm = points[:, ~lowest].mean(axis=1) - place
    else:
        place = points.mean(axis=1)
        arm = points[:, 0] - place
    half = 0.5 * np.arctan2(arm[:, 0], arm[:, 2])
    zero = np.zeros_like(half)
    return np.column_stack([place, zero, np.sin(half), zero, np.cos(half)])


def published_runs(folder: Path, kind: str) -> tuple[list[ReducedRun], Tensor]:
    """The authors' runs as reduced runs, and what else is known of each, shape (runs, k): of a wheel gravity
    [m/s^2], friction angle [degrees], load [N] and diameter [m], of a blade nothing."""
    runs = read_published(folder / kind, BIN_SIZE)
    reduced = [
        ReducedRun(
            f"case_{run.case:03d}",
            run.latent,
            np.arange(len(run.latent)) / 60.0,
            planar_poses(run, kind),
            run.body_points,
            run.force,
            np.zeros_like(run.force),
            {},
        )
        for run in runs
    ]
    context = [
        [*run.context[0], *([wheel_case(run.case)["diameter"]] if kind == "wheel" else [])] for run in runs
    ]
    return reduced, torch.tensor(context, dtype=torch.float64)


def with_context(body: BodyTrack, context: Tensor) -> BodyTrack:
    """A track that also tells what is constant in a run, behind the orientation.

    Args:
        body: (..., N, ...).
        context: Of every frame, shape (..., k).
    """
    told = context[..., None, :].expand(*body.orientation.shape[:-1], context.shape[-1])
    return body._replace(orientation=torch.cat([body.orientation, told], dim=-1))


def windows_of(runs: Sequence[ReducedRun], context: Tensor) -> TrainingWindows:
    """Training windows that show the context."""
    windows = TrainingWindows(runs, runs[0].latent.shape[1], HISTORY, "pose")
    frames = torch.tensor([HISTORY - 1 + len(run.latent) for run in runs])
    windows.body = with_context(windows.body, context.repeat_interleave(frames, dim=0))
    return windows


def rollouts_of(runs: Sequence[ReducedRun], context: Tensor) -> ValidationRollouts:
    """Rollouts that show the context."""
    rollouts = ValidationRollouts(runs, runs[0].latent.shape[1], HISTORY, "pose")
    rollouts.body = with_context(rollouts.body, context[:, None])
    rollouts.body_at_rest = with_context(rollouts.body_at_rest, context[:, None])
    return rollouts


def published_rows(folder: Path) -> Iterator[dict[str, Any]]:
    """All models on the authors' runs, every run predicted by the models of the fold that leaves it out.

    In a fold, every third of the other runs chooses the settings for which the rest of them were fitted; then all of
    them are fitted.
    """
    for kind, particles in PARTICLES.items():
        runs, context = published_runs(folder, kind)
        rows: dict[tuple[str, float], dict[str, Any]] = {}
        totals: dict[tuple[str, float], Totals] = {}
        for fold in range(FOLDS):
            known = [i for i in range(len(runs)) if i % FOLDS != fold]
            choosing = known[::3]
            training, choice, test, everything = (
                ([runs[i] for i in group], context[group])
                for group in (
                    [i for i in known if i not in choosing],
                    choosing,
                    list(range(fold, len(runs), FOLDS)),
                    known,
                )
            )
            rollouts = rollouts_of(*test)
            for about, measured in scores(
                windows_of(*training),
                rollouts_of(*choice),
                [rollouts],
                RIDGE,
                windows_of(*everything),
            ):
                logging.info("%s, fold %d: %s, skill %.3f", kind, fold, about, measured[0].skill)
                key = (about["model"], about.get("threshold", 0.0))
                # The settings differ from fold to fold: the table has the sums.
                row = {"data": f"published {kind}", "num_modes": runs[0].latent.shape[1], "model": key[0]}
                if "threshold" in about:
                    seconds = rows.get(key, {}).get("seconds", 0.0) + about["seconds"]
                    row |= {"threshold": key[1], "library": about["library"], "seconds": round(seconds, 1)}
                rows[key] = row
                totals.setdefault(key, Totals(particles)).add(rollouts, measured[0])
        for key, row in rows.items():
            yield row | totals[key].columns("test")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--checkpoint", type=Path, default=None, help="a network to show beside them")
    parser.add_argument("--published", type=Path, default=None, help="the authors' runs instead")
    parser.add_argument("overrides", nargs="*", help="for example dataset=quick")
    options = parser.parse_intermixed_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    torch.set_num_threads(1)
    if options.published is None:
        name, found = "closed_form.csv", own_rows(options.overrides, options.checkpoint)
    else:
        name, found = "closed_form_published.csv", published_rows(options.published)
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
