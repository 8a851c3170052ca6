"""`sgns evaluate` for datasets of which only the modes are known, packed or published: a table, no pictures.

With an orthonormal basis the mean square over all particles is ‖ΔS′‖² / 3n all the same. What the reduction leaves out
is known of packed runs only.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from mpm_warp.poses import in_body_frame
from sgns.config import UserError
from sgns.data.dataset import SPLITS
from sgns.data.files import require_replaceable
from sgns.data.published import PARTICLES, fingerprint, published_runs
from sgns.evaluate.costs import provenance
from sgns.evaluate.metrics import PositionErrors, body_errors
from sgns.evaluate.results import Scores, aggregate, run_scores, write_csv, write_json
from sgns.reduction.basis import outside
from sgns.reduction.packed import packed_dataset
from sgns.reduction.reduce import ReducedRun
from sgns.rollout import single_thread
from sgns.simulator import Simulator

log = logging.getLogger(__name__)


def evaluate_modes(
    simulator: Simulator, settings: Mapping[str, Any], split: str, output: Path, checkpoint: Path
) -> float:
    """Roll out, print the table, write metrics.csv and metrics.json; returns the skill against frozen."""
    of_split = published_split if settings["format"] == "published" else packed_split
    runs = of_split(simulator, settings, split, checkpoint)
    require_replaceable(output / "metrics.csv", output / "metrics.json")
    mean_force = simulator.mean_force
    with single_thread():
        scores = [scored(simulator, run, mean_force) for run in runs]
    total = aggregate(scores)
    log.info("%s", "\n".join(score_lines([*scores, total])))
    output.mkdir(parents=True, exist_ok=True)
    write_csv(output / "metrics.csv", [score.row() for score in (*scores, total)])
    write_json(
        output / "metrics.json",
        {
            "aggregate": total.row(),
            "runs": [score.row() for score in scores],
            "mean_training_force_N": mean_force,
            "particles": _particles(simulator, runs[0]),
            "made": provenance(simulator, checkpoint),
        },
    )
    log.info("tables: %s", output)
    return total.skill()


def scored(simulator: Simulator, run: ReducedRun, mean_force: np.ndarray) -> Scores:
    """Scores of one run, rolled out from its first d true frames."""
    d = simulator.history
    truth = run.latent[:, : simulator.num_modes]
    rollout = simulator.rollout(
        run.pose, in_body_frame(run.pose[0], run.body_points[0]), latent_history=truth[:d], values=run.scene
    )
    size = 3 * _particles(simulator, run)

    def mean_square(latent: np.ndarray) -> np.ndarray:
        return ((latent - truth)[d:] ** 2).sum(axis=(1, 2)) / size

    elapsed = np.arange(len(truth))[:, None, None] - (d - 1)
    network = mean_square(rollout.latent)
    unknown = np.full(len(network), np.nan)
    reduction, missed, way = unknown, np.zeros(1), np.zeros(1)
    if run.unseen is not None:
        missed, way = (part[d:] / size for part in outside(run.latent[:, simulator.num_modes :], run.unseen))
        reduction = missed
        if closure := simulator.basis.closure:
            beyond = run.latent[:, simulator.num_modes :][:, : closure.num_modes]

            def gained(latent: np.ndarray) -> np.ndarray:
                found = closure.coordinates(torch.from_numpy(latent)).numpy()
                return (np.square(beyond) - np.square(found - beyond))[d:].sum(axis=(1, 2)) / size

            missed, reduction = missed - gained(rollout.latent), missed - gained(truth)
    errors = PositionErrors(
        time=run.time[d:],
        reduction=reduction,
        network=network,
        total=network + missed,
        frozen=mean_square(truth[d - 1][None]) + way,
        # What moves outside the modes has hardly begun to when the history ends.
        constant_velocity=mean_square(truth[d - 1] + elapsed * (truth[d - 1] - truth[d - 2])) + way,
        surface=unknown,
        surface_frozen=unknown,
    )
    simulated = SimpleNamespace(time=run.time, force=run.force, torque=run.torque, wall_time_s=0.0)
    body = body_errors(run, rollout.poses, d)
    return run_scores(run.name, errors, simulated, rollout, d, mean_force, np.zeros(3), body)


def _particles(simulator: Simulator, run: ReducedRun) -> int:
    """How many particles the modes move; of published runs the basis does not say it."""
    return PARTICLES[run.scene["kind"]] if run.unseen is None else simulator.basis.num_particles


def score_lines(scores: Sequence[Scores]) -> list[str]:
    """The table as text: position errors in 1e-4 m², force errors in per cent; x is forward, z up."""
    lines = [
        "                      position MSE [1e-4 m2]      skill against      force MPE [%]   force NRMSE",
        "run               network   frozen  const vel  frozen const vel      x       z     network  mean force",
    ]
    for score in scores:
        mse = [1e4 * score.mse[name] for name in ("network", "frozen", "constant_velocity")]
        lines.append(
            f"{score.name:<16} {mse[0]:8.4f} {mse[1]:8.4f} {mse[2]:10.4f} {score.skill():7.3f} "
            f"{score.skill('constant_velocity'):9.3f} {score.force.mpe[0]:7.1f} {score.force.mpe[2]:7.1f} "
            f"{score.force.overall_nrmse:9.3f} {score.mean_force.overall_nrmse:11.3f}"
        )
    absolute = scores[-1].force.absolute_mpe
    lines.append(f"mean |MPE|: x {absolute[0]:.1f} %, z {absolute[2]:.1f} %")
    return lines


def published_split(
    simulator: Simulator, settings: Mapping[str, Any], split: str, checkpoint: Path
) -> list[ReducedRun]:
    """The split "train" are the published runs that the simulator was trained on, any other are the others there."""
    trained = {name.rsplit(" ", 1)[-1] for name in simulator.basis.fitted_on or []}
    everything = [run for found in published_runs(settings["path"]).values() for run in found]
    kind = everything[0].scene["kind"]
    if simulator.arrangement_hash != f"published-{kind}":
        raise UserError(
            f"{checkpoint} was not trained on published {kind} runs; train one: sgns train dataset=published "
            f"dataset.path={settings['path']}"
        )
    runs = [run for run in everything if (fingerprint(run) in trained) == (split == "train")]
    if not runs:
        if split == "train":
            raise UserError(
                f"{checkpoint} was trained on none of the runs in {settings['path']}; use split=test"
            )
        log.warning("%s was trained on all of these runs: errors on new runs will be larger", checkpoint)
        runs = everything
    return runs


def packed_split(
    simulator: Simulator, settings: Mapping[str, Any], split: str, checkpoint: Path
) -> list[ReducedRun]:
    """The runs of a packed dataset that the simulator was trained on a part of."""
    reduced = packed_dataset(Path(settings["path"]), {"num_modes": simulator.num_modes})
    if not simulator.basis.same_modes(reduced.basis.modes[:, : simulator.num_modes]):
        raise UserError(
            f"{checkpoint} was not trained on {settings['path']}: its modes are others; train one: sgns train "
            f"dataset={settings['name']}"
        )
    if not (runs := reduced.runs(split)):
        raise UserError(f"{settings['path']} has no {split} runs; use another split: {', '.join(SPLITS)}")
    return runs
