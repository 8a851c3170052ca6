"""What does each choice in the network and its training earn?

    python experiments/ablation/networks.py blade --workers 3
    python experiments/ablation/networks.py wheel --workers 3

Trains every variant, one change each against preset=default with model.predicts=acceleration (`base`), for the same
number of steps on one thread, and rolls the validation and test runs of dataset=quick (blade) or dataset=quick_wheel
(wheel) out. Writes <kind>.csv beside this script: medians over seeds, with least and most. A training that is complete
in `--output` is not repeated.
"""

from __future__ import annotations

import argparse
import csv
import json
import logging
import multiprocessing
import os
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import torch
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf

from sgns.data.dataset import Dataset
from sgns.model.checkpoint import load_surrogate
from sgns.reduction.reduce import ReducedDataset, ReducedRun, reduce_dataset
from sgns.train import lightning_module as learning
from sgns.train.command import train
from sgns.train.lightning_module import SurrogateTraining
from sgns.train.validation import RolloutScore, ValidationRollouts
from sgns.train.windows import Batch

HERE = Path(__file__).parent
DATASETS = {"blade": "quick", "wheel": "quick_wheel"}
POINTS = "model.body_nodes=points"

BLADE = {
    "base": [],
    "no next motion": ["model.next_motion=false"],
    "no positions": ["model.positions=false"],
    "modes share a vector": ["model.identity=type"],
    "scales pooled": ["training.scales=pooled"],
    "noise 0.1": ["training.noise=0.1"],
    "noise 0.3": ["training.noise=0.3"],
    "noise 2": ["training.noise=2"],
    "history 2": ["model.history=2"],
    "history 6": ["model.history=6"],
    "velocity": ["model.predicts=velocity"],
    "velocity, noise 0.3": ["model.predicts=velocity", "training.noise=0.3"],
    "horizon 2": ["training.horizon=2"],
    "horizon 4": ["training.horizon=4"],
    "star": ["model.edges=star"],
    "self loops": ["model.self_loops=true"],
    "no edge length": ["model.edge_length=false"],
    "2 message passing steps": ["model.message_passing_steps=2", "model.residual=true"],
    "layer norm, residual": ["model.layer_norm=true", "model.residual=true"],
    "width 64": ["model.hidden_width=64"],
    "width 256": ["model.hidden_width=256"],
    "silu": ["model.activation=silu"],
    "force as mean": ["model.force=mean"],
    "no torque": ["model.torque=false", "training.loss.torque=0"],
    "force weight 4": ["training.loss.force=4"],
    "fewer modes at times": ["training.fewer_modes=0.5"],
    "body points": [POINTS],
    "work and energy": ["+work=0.1"],
}
WHEEL = {
    "base": [],
    "no context": ["model.context=[]"],
    "velocity": ["model.predicts=velocity"],
    "no next motion": ["model.next_motion=false"],
    "points, rigid": [POINTS],
    "points, free": [POINTS, "model.rigid=false"],
    "horizon 2": ["training.horizon=2"],
    "horizon 4": ["training.horizon=4"],
    "each gravity for itself": ["+each=gravity"],
}


class WorkTraining(SurrogateTraining):
    """Adds a penalty where the soil would gain more energy than the tool does work.

    The tool's work in a frame is -F.dx - T.dtheta. It is at least what lifts the soil, the rest is friction. With an
    orthonormal basis the lift is a weighted sum of the modes' changes in z.
    """

    weight = 0.0

    def losses(self, batch: Batch) -> dict[str, torch.Tensor]:
        found = super().losses(batch)
        dynamics, scene = self.surrogate.dynamics, self.surrogate.card["scene"]
        step = dynamics.advance(
            batch.history, batch.shown_body.frames(slice(0, dynamics.history)), batch.context
        )
        bed, count = scene["bed"]["size"], len(self.surrogate.start_positions)
        mass = (
            bed[0]
            * bed[1]
            * bed[2]
            * scene["material"]["grain_density"]
            * scene["material"]["packing"]
            / count
        )
        lift = (step.latent - batch.latent[:, -2])[..., 2] @ self.surrogate.basis_modes.sum(0)
        motion = batch.body.motion[:, -1, 0]
        work = -(step.force * motion[:, :3]).sum(-1) - (step.torque * motion[:, 3:]).sum(-1)
        scale = (dynamics.force.scale.norm() * dynamics.body_motion.scale[:3].norm()).clamp_min(1e-12)
        excess = torch.relu((mass * scene["gravity"] * lift - work) / scale).square().mean().float()
        return found | {"change": found["change"] + self.weight * excess}


def settings(kind: str, overrides: Sequence[str], steps: int) -> dict[str, Any]:
    """All settings of `sgns train`, plain."""
    with initialize_config_module("sgns.conf", version_base="1.3"):
        config = compose(
            "train",
            [
                f"dataset={DATASETS[kind]}",
                f"training.max_steps={steps}",
                f"training.validate_every={max(1, steps // 8)}",
                "training.threads=1",
                "model.predicts=acceleration",
                *overrides,
            ],
        )
    config.output = ""
    plain = OmegaConf.to_container(config, resolve=True)
    assert isinstance(plain, dict)
    return plain


def task_rows(task: tuple[str, str, list[str], int, int, Path]) -> list[dict[str, Any]]:
    """Train one variant with one seed; its row, and those of other ways to roll it out."""
    kind, name, overrides, seed, steps, output = task
    torch.set_num_threads(1)
    config = settings(kind, overrides, steps)
    where = output / f"{kind}_{name.replace(' ', '_').replace(',', '')}_{seed}"
    dataset = Dataset.open(config["dataset"]["path"])
    reduced = reduce_dataset(dataset, config["reduction"], progress=False)
    if each := config.get("each"):
        found = parts(config, reduced, each, seed, where)
    else:
        found = [(reduced, trained(config, reduced, seed, where))]
    rows = [row(kind, name, seed, found, config)]
    if name == "fewer modes at times" or (kind == "blade" and name == "base"):
        rows += [row(kind, f"{name}, rolled out with {r}", seed, found, config, modes=r) for r in (4, 2)]
    if name == "body points":
        rows += [row(kind, f"{name}, {n} at rollout", seed, found, config, points=n) for n in (6, 30)]
    return rows


def trained(config: dict[str, Any], reduced: ReducedDataset, seed: int, where: Path) -> Path:
    """The folder of a complete training."""
    if not (where / "training.json").exists():
        usual = learning.SurrogateTraining
        try:
            if "work" in config:
                learning.SurrogateTraining = type("Work", (WorkTraining,), {"weight": config["work"]})
            train(
                reduced,
                num_modes=config["reduction"]["num_modes"],
                model=config["model"],
                training=config["training"] | {"resume": False},
                output=where,
                seed=seed,
            )
        finally:
            learning.SurrogateTraining = usual
    return where


def parts(
    config: dict[str, Any], reduced: ReducedDataset, key: str, seed: int, where: Path
) -> list[tuple[ReducedDataset, Path]]:
    """One network for each value of a key of the scene, as `dataset.where` would make; the steps are shared out. They
    keep the basis of all runs, so that errors can be compared."""
    splits = {split: reduced.runs(split) for split in ("train", "validation", "test")}
    values = sorted({run.scene[key] for run in splits["train"]})
    config = config | {"training": dict(config["training"])}
    for name in ("max_steps", "validate_every"):
        config["training"][name] //= len(values)
    found = []
    for value in values:
        own = {split: [r for r in runs if r.scene[key] == value] for split, runs in splits.items()}
        part = replace(reduced, _runs=own)
        found.append((part, trained(config, part, seed, where.with_name(f"{where.name}_{value}"))))
    return found


def row(
    kind: str,
    name: str,
    seed: int,
    found: Sequence[tuple[ReducedDataset, Path]],
    config: dict[str, Any],
    modes: int | None = None,
    points: int | None = None,
) -> dict[str, Any]:
    """Scores of the networks on their runs; of several networks the mean, weighted by squares as for one."""
    values: dict[str, Any] = {"variant": name, "seed": seed, "steps": config["training"]["max_steps"]}
    seconds, count, step_ms = 0.0, 0, 0.0
    for split in ("validation", "test"):
        squares = frozen = force = truth = body = runs = 0.0
        for reduced, where in found:
            dynamics = load_surrogate(where / "best.ckpt").dynamics
            own = [with_points(run, points) for run in reduced.runs(split)]
            if not own:
                continue
            if modes:
                dynamics = dynamics.with_modes(modes)
            rollouts = ValidationRollouts(
                own, dynamics.num_modes, dynamics.history, dynamics.settings.body_nodes, dynamics.context_keys
            )
            began = time.process_time()
            score = rollouts.measure(dynamics)
            step_ms = 1e3 * (time.process_time() - began) / (2 * rollouts.latent.shape[1] * len(own))
            lost, still = errors(rollouts, score)
            squares, frozen, runs = squares + lost, frozen + still, runs + len(own)
            true = float(rollouts.force[rollouts.counted].square().sum())
            force, truth = force + score.force_nrmse**2 * true, truth + true
            body += score.body_rmse**2 * len(own)
            if split == "test":
                seconds += json.loads((where / "training.json").read_text())["seconds"]
                count += sum(p.numel() for p in dynamics.parameters())
        values |= {
            f"{split}_skill": 1 - squares / frozen,
            f"{split}_force_nrmse": (force / truth) ** 0.5,
        }
        if kind == "wheel":
            values[f"{split}_body_mm"] = 1e3 * (body / runs) ** 0.5
    return values | {"parameters": count, "training_s": seconds, "cpu_ms_per_step_of_a_run": step_ms}


def errors(rollouts: ValidationRollouts, score: RolloutScore) -> tuple[float, float]:
    """Sums over runs of the mean squares: of the rollout, and of a soil that stays as it is."""
    still = rollouts.squares(rollouts.latent[:, rollouts.history - 1 : rollouts.history] - rollouts.latent)
    return (1 - score.skill) * still, still


def with_points(run: ReducedRun, count: int | None) -> ReducedRun:
    """The run with another number of points on its body: some of them, or points between them as well."""
    if count is None:
        return run
    points = run.body_points
    have = points.shape[1]
    if count <= have:
        index = torch.linspace(0, have - 1, count).round().long().numpy()
        return replace(run, body_points=points[:, index])
    between = 0.5 * (points + points[:, [*range(1, have), 0]])
    return replace(
        run, body_points=torch.cat([torch.tensor(points), torch.tensor(between)], 1).numpy()[:, :count]
    )


def gathered(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """One row of several seeds: medians, and the range of skill and force error on the test runs."""
    found: dict[str, Any] = {"variant": rows[0]["variant"], "steps": rows[0]["steps"], "seeds": len(rows)}
    for key in rows[0]:
        if key in ("variant", "seed", "steps"):
            continue
        values = [r[key] for r in rows]
        found[key] = median(values) if key == "parameters" else round(median(values), 4)
        if key in ("test_skill", "test_force_nrmse"):
            found[f"{key}_least"], found[f"{key}_most"] = round(min(values), 4), round(max(values), 4)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kind", choices=list(DATASETS))
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1])
    parser.add_argument("--workers", type=int, default=max(1, (os.cpu_count() or 2) - 1))
    parser.add_argument("--only", nargs="*", help="names of variants")
    parser.add_argument("--output", type=Path, default=Path("outputs/ablation"))
    options = parser.parse_args()
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    variants = {"blade": BLADE, "wheel": WHEEL}[options.kind]
    names = options.only or list(variants)
    # Once before the processes start, so that they find the basis.
    config = settings(options.kind, [], options.steps)
    reduce_dataset(Dataset.open(config["dataset"]["path"]), config["reduction"])
    tasks = [
        (options.kind, name, variants[name], seed, options.steps, options.output)
        for seed in options.seeds
        for name in names
    ]
    rows: dict[str, list[dict[str, Any]]] = {}
    with multiprocessing.get_context("spawn").Pool(options.workers, maxtasksperchild=1) as pool:
        for done in pool.imap(task_rows, tasks):
            for one in done:
                rows.setdefault(one["variant"], []).append(one)
                print(one, flush=True)
    if options.only is None:
        table = [gathered(found) for found in rows.values()]
        with (HERE / f"{options.kind}.csv").open("w", newline="") as stream:
            writer = csv.DictWriter(stream, table[0])
            writer.writeheader()
            writer.writerows(table)


if __name__ == "__main__":
    main()
