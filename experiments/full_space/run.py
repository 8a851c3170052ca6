"""What the subspace saves: the network on every particle beside the network on a few modes.

    python experiments/full_space/run.py --minutes 10

Needs the runs of `sgns simulate dataset=quick`. Every case runs in a fresh process bound to one core, torch on one
thread. First the cost: time of a training step and of a rollout, and the memory that training adds. Then the errors on
the test runs, for two networks trained for at most a given processor time. Every case adds its line to table.csv
beside this script, and a line that is there is not made again; bars.png is drawn last.
"""

from __future__ import annotations

import argparse
import logging
import multiprocessing
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

sys.path.insert(1, str(Path(__file__).resolve().parents[1]))

import matplotlib.pyplot as plt
import numpy as np
import torch
from common import read_rows, training_settings, write_rows
from torch import Tensor

from sgns.data.dataset import Dataset
from sgns.data.run import Run
from sgns.evaluate.costs import forget_peak, peak_memory
from sgns.evaluate.full_space import (
    FullSpaceDynamics,
    FullSpaceRun,
    FullSpaceWindows,
    box_surface,
    full_space_cost,
    losses,
)
from sgns.evaluate.metrics import VectorErrors, mean_prediction, skill
from sgns.model.dynamics import Standardiser
from sgns.model.features import BodyTrack
from sgns.reduction.reduce import reduce_dataset
from sgns.settings import ModelSettings, TrainingSettings
from sgns.simulator import Simulator
from sgns.train.command import train as train_subspace
from sgns.train.lightning_module import SurrogateTraining, prepared

TABLE = Path(__file__).with_name("table.csv")
SPACING = 0.015  # of the particles of dataset=quick, and the largest of the body nodes [m]
RADIUS = 0.020  # of the neighbourhood [m]: 6 neighbours in the bed at rest, about 10 where it is disordered
STEPPED = {"body_nodes": "points", "layer_norm": True, "residual": True}
FULL_SPACE = {  # changes to conf/model
    "full space, 128 wide, 1 step": {"body_nodes": "points"},
    "full space, 128 wide, 5 steps": STEPPED | {"message_passing_steps": 5},
    "full space, 32 wide, 3 steps": STEPPED | {"message_passing_steps": 3, "hidden_width": 32},
}
TRAINED = "full space, 32 wide, 3 steps"
SUBSPACE = "subspace, 8 modes"
BATCH = 2  # windows of a training step when its cost is measured, the paper's, in every case
# Steps are few, so each has one window (of 21 200 particles); the subspace network has the batch of its preset.
FULL_SPACE_TRAINING = {"batch_size": 1, "noise": 0.5, "learning_rate": 2e-3, "warmup_steps": 20}


def settings(path: Path, model: dict[str, Any] | None = None, **training: Any) -> dict[str, Any]:
    """`conf/train` as plain values, with changes."""
    plain = training_settings(f"dataset.path={path}")
    plain["model"] |= model or {}
    plain["training"] |= {"threads": 1} | training
    return plain


def full_space(path: Path, model: dict[str, Any], split: str) -> tuple[FullSpaceDynamics, list[FullSpaceRun]]:
    """An untrained network and the runs of a split."""
    torch.manual_seed(0)
    paths = Dataset.open(path).runs(split)
    with Run(paths[0]) as run:
        blade = run.scene["blade"]
    nodes = box_surface(np.array([blade["thickness"], blade["width"], blade["length"]]) / 2, SPACING)
    runs = [FullSpaceRun(file, nodes) for file in paths]
    return FullSpaceDynamics(ModelSettings(**model), RADIUS, runs[0].bin_size), runs


def fit_normalisation(
    dynamics: FullSpaceDynamics, windows: FullSpaceWindows, noise: float, floor: float, samples: int = 64
) -> Tensor:
    """Give the dynamics the statistics of windows spread evenly over the training runs.

    All particles share one scale per axis: what a particle does must not depend on its number. `noise` is a share of
    the velocity's scale, `floor` the least scale as a share of the largest. Returns the velocity noise [m], shape (3,).
    """
    chosen = torch.linspace(0, len(windows) - 1, min(samples, len(windows))).long().unique().tolist()
    read = [windows.window(index) for index in chosen]
    dynamics.velocity = Standardiser.fit(
        torch.cat([(w.position[0, -1] - w.position[0, -2]) for w in read]), floor, centred=False
    )
    noise_scale = noise * dynamics.velocity.scale
    clean = Standardiser.fit(torch.cat([w.acceleration[0] for w in read]), floor, centred=False)
    # The target contains the correction of the velocity's noise.
    dynamics.acceleration = Standardiser(clean.mean, (clean.scale.square() + noise_scale.square()).sqrt())
    motion = torch.cat([run.track.motion[1:].flatten(0, 1) for run in windows.runs])
    dynamics.body_motion = Standardiser.fit(motion, floor, centred=False)
    dynamics.force = Standardiser.fit(torch.cat([run.force[1:] for run in windows.runs]), floor)
    return noise_scale


def train(
    dynamics: FullSpaceDynamics, windows: FullSpaceWindows, settings: TrainingSettings, noise_scale: Tensor
) -> list[tuple[float, float]]:
    """Optimise as the latent dynamics, without torque and validation; `noise_scale` is that of `fit_normalisation`.

    Returns the losses of acceleration and force of every step [1].
    """
    optimiser = torch.optim.AdamW(
        dynamics.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay
    )
    schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, settings.rate)
    record = []
    for step in range(settings.max_steps):
        acceleration, force = losses(dynamics, windows.batch(step, settings.batch_size, noise_scale))
        loss = settings.loss.change * acceleration + settings.loss.force * force
        if not bool(torch.isfinite(loss)):
            raise ValueError(
                f"the loss is {float(loss.detach())} at step {step}; lower training.learning_rate"
            )
        optimiser.zero_grad()
        loss.backward()
        if settings.gradient_clip is not None:
            torch.nn.utils.clip_grad_norm_(dynamics.parameters(), settings.gradient_clip)
        optimiser.step()
        schedule.step()
        record.append((float(acceleration.detach()), float(force.detach())))
    return record


def unroll(dynamics: FullSpaceDynamics, soil: Tensor, body: BodyTrack) -> tuple[Tensor, Tensor]:
    """Follow whole tool paths, feeding predictions back.

    Args:
        dynamics: Trained.
        soil: The first d positions of each path [m], shape (B, d, n, 3).
        body: The tool at all T frames, (B, T, N, ...).

    Returns:
        Positions [m] (B, T, n, 3) whose first d frames are the given ones, and force [N] (B, T, 3), zero in the
        first d frames; float64.
    """
    d, frames = dynamics.history, body.position.shape[1]
    states = soil.new_empty((soil.shape[0], frames, *soil.shape[2:]))
    states[:, :d] = soil
    force = soil.new_zeros((soil.shape[0], frames, 3))
    for t in range(d, frames):
        window = body.frames(slice(t - d + 1, t + 1))
        states[:, t], force[:, t] = dynamics.advance(states[:, t - d : t], window)
    return states, force


def timed(action: Callable[[], object], repeats: int) -> list[float]:
    """Processor times after one call to warm up [s]."""
    action()
    found = []
    for _ in range(repeats):
        began = time.process_time()
        action()
        found.append(time.process_time() - began)
    return found


def cost_full_space(path: Path, name: str, repeats: int) -> dict[str, Any]:
    """Of a network on all particles; memory is the most that training adds to the process."""
    forget_peak()
    before = peak_memory()
    model = ModelSettings(**settings(path, FULL_SPACE[name])["model"])
    cost = full_space_cost(Dataset.open(path).runs("train")[0], model, repeats)
    return {
        "parameters": cost.parameters,
        "training_s_per_step": cost.training_step,
        "training_memory_MB": (cost.peak_bytes - before) / 2**20,
        "rollout_s_per_simulated_s": cost.rollout,
        "repeats": repeats,
    }


def cost_subspace(path: Path, repeats: int) -> dict[str, Any]:
    """Of the default network on modes."""
    plain = settings(path, batch_size=BATCH)
    reduced = reduce_dataset(Dataset.open(path), plain["reduction"], progress=False)
    training = TrainingSettings.from_dict(plain["training"])
    card: dict[str, Any] = {}
    surrogate, data = prepared(
        reduced, plain["reduction"]["num_modes"], ModelSettings(**plain["model"]), training, 0, card, None
    )
    module = SurrogateTraining(surrogate, training)
    optimiser = torch.optim.AdamW(module.parameters(), lr=1e-5, fused=True)
    window = data.training_windows.windows(data.training_windows.targets[100:101])

    def step() -> None:
        losses = module.losses(data.training_windows.batch(0, BATCH, data.noise))
        optimiser.zero_grad()
        sum(getattr(training.loss, key) * value for key, value in losses.items()).backward()
        torch.nn.utils.clip_grad_norm_(module.parameters(), 1.0)
        optimiser.step()

    forget_peak()
    before = peak_memory()
    # Not inference_mode: the network keeps its edges, and those made there cannot be trained with.
    with torch.no_grad():
        frames = timed(lambda: surrogate.dynamics.advance(window.history, window.shown_body), 20 * repeats)
    steps = timed(step, 20 * repeats)
    return {
        "parameters": sum(p.numel() for p in surrogate.dynamics.network.parameters()),
        "training_s_per_step": statistics.median(steps),
        "training_memory_MB": (peak_memory() - before) / 2**20,
        "rollout_s_per_simulated_s": statistics.median(frames) * float(reduced.frame_rate),
        "repeats": 20 * repeats,
    }


def errors(path: Path, predict: Callable[[Path], tuple[np.ndarray, np.ndarray]], d: int) -> dict[str, float]:
    """Skill and force NRMSE over the test runs of a dataset, d frames given, beside the baselines.

    `predict` gives positions [m] (T, n, 3) and force [N] (T, 3) of a run.
    """
    forces, paths = [], Dataset.open(path).runs("test")
    for file in Dataset.open(path).runs("train"):
        with Run(file) as run:
            forces.append(run.force)
    mean = mean_prediction(forces, d)
    mse: dict[str, list[float]] = {"total": [], "frozen": [], "constant velocity": []}
    force, constant = [], []
    for file in paths:
        positions, predicted = predict(file)
        with Run(file) as run:
            truth, true_force = run.positions().astype(np.float64), run.force
        ahead = np.arange(1, len(truth) - d + 1)[:, None, None]
        velocity = truth[d - 1] - truth[d - 2]
        for key, guess in (
            ("total", positions[d:]),
            ("frozen", truth[d - 1]),
            ("constant velocity", truth[d - 1] + ahead * velocity),
        ):
            mse[key].append(float(np.mean((guess - truth[d:]) ** 2)))
        logging.warning("%s: skill %.3f", file.stem, 1 - mse["total"][-1] / mse["frozen"][-1])
        force.append(VectorErrors.compare(true_force[d:], predicted[d:]))
        constant.append(VectorErrors.compare(true_force[d:], mean))
    return {
        "test_runs": len(paths),
        "position_rmse_mm": 1e3 * float(np.sqrt(np.mean(mse["total"]))),
        "frozen_rmse_mm": 1e3 * float(np.sqrt(np.mean(mse["frozen"]))),
        "skill_frozen": skill(mse["total"], mse["frozen"]),
        "skill_constant_velocity": skill(mse["total"], mse["constant velocity"]),
        "force_nrmse": sum(force[1:], force[0]).overall_nrmse,
        "mean_force_nrmse": sum(constant[1:], constant[0]).overall_nrmse,
    }


def learn_full_space(path: Path, minutes: float) -> dict[str, Any]:
    """Train for a processor time and predict test runs."""
    plain = settings(path, FULL_SPACE[TRAINED], **FULL_SPACE_TRAINING)
    dynamics, training_runs = full_space(path, plain["model"], "train")
    windows = FullSpaceWindows(training_runs, dynamics.history)
    given = plain["training"]
    noise_scale = fit_normalisation(dynamics, windows, given["noise"], given["normalisation_floor"])
    slow = {"max_steps": 4, "warmup_steps": 0, "learning_rate": 1e-8, "final_learning_rate": 1e-8}
    short = TrainingSettings.from_dict(given | slow)
    per_step = statistics.median(timed(lambda: train(dynamics, windows, short, noise_scale), 1)) / 4
    steps = max(1, round(60 * minutes / per_step))
    began = time.process_time()
    record = train(dynamics, windows, TrainingSettings.from_dict(given | {"max_steps": steps}), noise_scale)
    taken = time.process_time() - began
    last = max(1, steps // 10)
    logging.warning(
        "%s: %d steps; mean loss of the last tenth: acceleration %.3f, force %.3f",
        TRAINED, steps, *map(statistics.fmean, zip(*record[-last:], strict=True)),
    )  # fmt: skip
    _, predicted = full_space(path, plain["model"], "test")
    by_path = {run.path: run for run in predicted}

    def predict(file: Path) -> tuple[np.ndarray, np.ndarray]:
        run = by_path[file]
        body = BodyTrack(*(part[None] for part in run.track))
        with torch.inference_mode():
            positions, force = unroll(dynamics, run.soil(slice(0, dynamics.history))[None], body)
        return positions[0].numpy(), force[0].numpy()

    found = errors(path, predict, dynamics.history)
    return {"trained_processor_s": taken, "trained_steps": steps} | found


def learn_subspace(path: Path, minutes: float) -> dict[str, Any]:
    """The same for the network on modes, with `sgns.train`."""
    plain = settings(path)
    reduced = reduce_dataset(Dataset.open(path), plain["reduction"], progress=False)
    modes = plain["reduction"]["num_modes"]

    def fit(steps: int, output: Path) -> float:
        changes = {"max_steps": steps, "validate_every": max(1, steps // 10)}
        began = time.process_time()
        training = plain["training"] | changes
        train_subspace(reduced, num_modes=modes, model=plain["model"], training=training, output=output)
        return time.process_time() - began

    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        # The pilot's start-up counts as well, so this errs towards a shorter training.
        steps = max(1, round(60 * minutes / ((fit(300, folder / "pilot")) / 300)))
        taken = fit(steps, folder / "training")
        simulator = Simulator.load(folder / "training" / "best.ckpt")
    by_name = {run.name: run for run in reduced.runs("test")}

    def predict(file: Path) -> tuple[np.ndarray, np.ndarray]:
        run = by_name[file.stem]
        rollout = simulator.rollout(run.pose, latent_history=run.latent[: simulator.history, :modes])
        return simulator.basis.inverse(torch.as_tensor(rollout.latent)).numpy(), rollout.force

    found = errors(path, predict, simulator.history)
    return {"trained_processor_s": taken, "trained_steps": steps} | found


def solver(path: Path) -> dict[str, Any]:
    """Wall time of the solver, as its runs recorded it."""
    found = []
    for file in (path / "runs").glob("*.h5"):
        with Run(file) as run:
            found.append(run.wall_time_s / float(run.time[-1]))
    return {"rollout_s_per_simulated_s": statistics.median(found), "repeats": len(found)}


def in_fresh_process(action: Callable[..., dict[str, Any]], *arguments: Any) -> dict[str, Any]:
    """Run in a process of its own, so that memory is this case's."""
    context = multiprocessing.get_context("spawn")
    # Not a Pool: it waits for ever for a process that was killed for its memory.
    with ProcessPoolExecutor(1, mp_context=context, initializer=single_threaded) as pool:
        return pool.submit(action, *arguments).result()


def single_threaded() -> None:
    torch.set_num_threads(1)
    logging.basicConfig(level=logging.WARNING, format="%(message)s")


def draw(rows: list[dict[str, str]], file: Path) -> None:
    """Times, memory and errors side by side."""
    panels = {
        "training_s_per_step": f"training, batch {BATCH} [s/step]",
        "rollout_s_per_simulated_s": "rollout [s per simulated s]",
        "training_memory_MB": "memory of training [MB]",
        "skill_frozen": "position skill, test runs",
        "force_nrmse": "force NRMSE, test runs",
    }
    figure, axes = plt.subplots(1, len(panels), figsize=(14, 2.6), layout="constrained", sharey=True)
    for axis, (key, label) in zip(axes, panels.items(), strict=True):
        values = [float(row.get(key) or "nan") for row in rows]
        bars = axis.barh([row["case"] for row in rows], values)
        axis.bar_label(bars, ["" if np.isnan(value) else f" {value:.2g}" for value in values])
        axis.set(xlabel=label, xscale="linear" if key in ("skill_frozen", "force_nrmse") else "log")
        axis.margins(x=0.3)
    axes[0].invert_yaxis()
    figure.savefig(file, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("data/quick"))
    parser.add_argument("--minutes", type=float, default=10.0, help="processor time of each training")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    os.environ["OMP_NUM_THREADS"] = "1"
    # Freed blocks are kept for the next step: otherwise a third of the time goes into getting zeroed pages anew.
    os.environ |= {"MALLOC_MMAP_THRESHOLD_": "4294967296", "MALLOC_TRIM_THRESHOLD_": "17179869184"}
    rows: dict[str, dict[str, Any]] = {row["case"]: row for row in read_rows(TABLE)}
    path, minutes, repeats = options.data, options.minutes, options.repeats
    costs = {"solver": (solver, path), SUBSPACE: (cost_subspace, path, repeats)}
    costs |= {name: (cost_full_space, path, name, repeats) for name in FULL_SPACE}
    for name, cost in costs.items():
        if name not in rows:
            rows[name] = {"case": name, **in_fresh_process(*cost)}
            write_rows(TABLE, rows.values())
    for name, learn in ((SUBSPACE, learn_subspace), (TRAINED, learn_full_space)):
        if not rows[name].get("trained_steps"):
            rows[name] |= in_fresh_process(learn, path, minutes)
            write_rows(TABLE, rows.values())
    draw(read_rows(TABLE), TABLE.with_name("bars.png"))


if __name__ == "__main__":
    main()
