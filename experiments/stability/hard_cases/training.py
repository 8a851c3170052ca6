"""Hard cases of the training and of the network alone."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from torch import nn

from sgns.model.network_dynamics import LatentDynamics
from sgns.settings import TrainingSettings
from sgns.simulator import Simulator
from sgns.train.lightning_module import SurrogateTraining
from sgns.train.validation import StepProgress
from sgns.train.windows import TrainingWindows

from .measures import unsaid
from .networks import fresh_data, new_folder, poisoned, synthetic_data, synthetic_network, train_synthetic


def content(path: Path) -> dict[str, Any]:
    """All of a checkpoint."""
    return torch.load(path, weights_only=True)


def poison(split: str, what: str) -> tuple[float, str]:
    """One number of one frame of one run is none."""
    name = {"train": "b", "validation": "f"}[split]
    words = f"reduced run {name}", "frame 7", f"sgns check {name}.h5"
    return unsaid(lambda: train_synthetic(poisoned(synthetic_data(), split, what), new_folder()), *words)


def exploding_rate(factor: float) -> tuple[float, str]:
    """The rate grows from step 12 on; step 10 was judged and saved, and nothing of it may be lost."""
    rate = TrainingSettings.rate

    def ill(settings: TrainingSettings, step: int) -> float:
        return rate(settings, step) * (factor if step > 11 else 1.0)

    output = new_folder()
    with patch.object(TrainingSettings, "rate", ill):
        lacking, note = unsaid(
            lambda: train_synthetic(synthetic_data(), output, max_steps=60),
            "learning_rate", "at step 1", "best.ckpt",
        )  # fmt: skip
    steps = content(output / "best.ckpt")["global_step"]
    finite = np.isfinite(Simulator.load(output / "best.ckpt").rollout(a_path()).latent).all()
    return lacking + abs(steps - 10) + (not finite), note


def a_path() -> np.ndarray:
    """Poses of the test run."""
    return synthetic_data().runs("test")[0].pose


def far_too_high_rate() -> tuple[float, str]:
    training = {"learning_rate": 1e15, "final_learning_rate": 1e15, "gradient_clip": None, "warmup_steps": 0}
    output = new_folder()
    lacking, note = unsaid(
        lambda: train_synthetic(synthetic_data(), output, **training), "learning_rate", "at step"
    )
    return lacking + len(list(output.glob("*.ckpt"))), note


def spoilt_gradient() -> tuple[float, str]:
    """A gradient that is not finite in step 19; step 10 was saved and step 20 may not be."""
    clip = SurrogateTraining.configure_gradient_clipping

    def spoil(module: SurrogateTraining, *args: Any, **kw: Any) -> None:
        clip(module, *args, **kw)
        if module.global_step == 19:
            next(module.surrogate.dynamics.network.parameters()).grad[0] = math.nan

    output = new_folder()
    with patch.object(SurrogateTraining, "configure_gradient_clipping", spoil):
        act = partial(train_synthetic, synthetic_data(), output, max_steps=30)
        lacking, note = unsaid(act, "the weights", "after step 20")
    steps = [content(output / f"{name}.ckpt")["global_step"] for name in ("best", "last")]
    return lacking + sum(step != 10 for step in steps), note


class Interrupted(Exception):
    """In place of a key or a power cut."""


def resumed(stops: tuple[int, ...], **training: Any) -> tuple[float, str]:
    def run(output: Path) -> float:
        return train_synthetic(synthetic_data(), output, max_steps=24, validate_every=6, **training)

    output = new_folder()
    whole = run(output / "whole")
    for stop in stops:

        def interrupt(callback: Any, trainer: Any, *args: Any, at: int = stop) -> None:
            if trainer.global_step == at:
                raise Interrupted

        try:
            with patch.object(StepProgress, "on_train_batch_end", interrupt):
                run(output / "parts")
        except Interrupted:
            continue
        return math.nan, f"it was not interrupted at step {stop}"
    difference = abs(run(output / "parts") - whole)
    a, b = (content(output / name / "last.ckpt") for name in ("whole", "parts"))
    for key in ("state_dict", "optimizer_states", "lr_schedulers", "global_step", "first_loss"):
        difference = max(difference, unlike(a[key], b[key]))
    return difference, f"interrupted after steps {', '.join(map(str, stops))}"


def unlike(a: Any, b: Any) -> float:
    """Largest difference between two nested values; infinite where they are of another shape or not numbers."""
    if isinstance(a, dict):
        return max((unlike(a[key], b[key]) for key in a), default=0.0) if a.keys() == b.keys() else math.inf
    if isinstance(a, (list, tuple)):
        return max(map(unlike, a, b), default=0.0) if len(a) == len(b) else math.inf
    if isinstance(a, torch.Tensor):
        same = a.shape == b.shape and bool(((a == b) | (a.isnan() & b.isnan())).all())
        return 0.0 if same else float((a.double() - b.double()).abs().max())
    return 0.0 if a == b else math.inf


def no_variance() -> tuple[float, str]:
    """Largest normalised feature or target of any window of runs that are all the same and whose tool never turns."""
    data = fresh_data(scene={"depth": 0.05, "speed": 0.1, "rake": 0.0, "motion": "ramp"})
    output = new_folder()
    skill = train_synthetic(data, output, max_steps=60, validate_every=60, learning_rate=5e-3)
    dynamics = Simulator.load(output / "best.ckpt").dynamics
    windows = TrainingWindows(data.runs("train"), 4, 3, "pose", 0)
    batch = windows.windows(windows.targets)
    values = [
        dynamics._mode_features(batch.history),
        dynamics.body_features(batch.shown_body),
        dynamics.force.normalise(batch.force),
        dynamics.torque.normalise(batch.torque),
        dynamics.change.normalise(batch.latent[:, -1] - batch.latent[:, -2]),
    ]
    largest = max(float(value.abs().max()) for value in values)
    return largest if math.isfinite(skill) else math.nan, f"validation skill {skill:.3f}"


def no_force() -> tuple[float, str]:
    data = synthetic_data()
    runs = {
        name: [replace(run, force=0 * run.force, torque=0 * run.torque) for run in data.runs(name)]
        for name in ("train", "validation", "test")
    }
    output = new_folder()
    train_synthetic(replace(data, _runs=runs), output, max_steps=150, validate_every=150, learning_rate=5e-3)
    found = Simulator.load(output / "best.ckpt").rollout(a_path())
    return float(np.abs(found.force).max()), ""


def coinciding_nodes() -> float:
    """Gradients that are not finite where two modes are at one place, over a horizon of three steps: the length of an
    edge of no length has no direction."""
    data = synthetic_data()
    with patch.object(SurrogateTraining, "losses", spy := Losses(SurrogateTraining.losses)):
        train_synthetic(data, new_folder(), max_steps=3, horizon=3, validate_every=3, noise=0.0)
    return spy.bad


class Losses:
    """Takes a loss on a batch whose modes all are at one place, and counts gradients that are not finite."""

    def __init__(self, losses: Callable[..., dict[str, torch.Tensor]]) -> None:
        self.losses = losses
        self.bad = 0.0

    def __get__(self, module: SurrogateTraining, kind: type) -> Callable[[Any], dict[str, torch.Tensor]]:
        return lambda batch: self.checked(module, batch)

    def checked(self, module: SurrogateTraining, batch: Any) -> dict[str, torch.Tensor]:
        # The edges see normalised positions: at their means all modes are at zero.
        place = module.surrogate.dynamics.position.mean
        together = batch._replace(latent=place.expand_as(batch.latent).clone())
        losses = self.losses(module, together)
        gradients = torch.autograd.grad(sum(losses.values()), list(module.parameters()), allow_unused=True)
        self.bad += sum(float((~g.isfinite()).sum()) for g in gradients if g is not None)
        return self.losses(module, batch)


def few_frames(**training: Any) -> tuple[float, str]:
    """Every run has four frames, one of them two: a few windows each."""
    skill = train_synthetic(fresh_data(frames=4), new_folder(), max_steps=4, validate_every=4, **training)
    return 0.0 if np.isfinite(skill) else math.nan, f"skill {skill:.3f}"


def horizon_too_long() -> tuple[float, str]:
    return unsaid(
        lambda: train_synthetic(synthetic_data(), new_folder(), horizon=200),
        "training.horizon=200",
        "201 frames",
    )


class Cast(nn.Module):
    """A network computed in another precision."""

    def __init__(self, network: nn.Module, dtype: torch.dtype) -> None:
        super().__init__()
        self.network = copy.deepcopy(network).to(dtype)
        self.dtype = dtype

    def forward(self, nodes: torch.Tensor, edges: torch.Tensor, index: torch.Tensor) -> torch.Tensor:
        return self.network(nodes.to(self.dtype), edges.to(self.dtype), index).to(nodes.dtype)


def precision(dtype: torch.dtype) -> tuple[float, str]:
    run = synthetic_data().runs("test")[0]
    paths = {}
    for kind in (torch.float64, dtype):
        simulator = Simulator.load(synthetic_network())
        dynamics: LatentDynamics = simulator.dynamics
        dynamics.network = Cast(dynamics.network, kind)
        # Through `advance`: the fast stepper multiplies weights out itself.
        paths[kind] = stepped(simulator, run.pose)
    exact = paths[torch.float64]
    moved = float(np.sqrt(np.square(exact - exact[:1]).mean()))
    return 100 * float(np.sqrt(np.square(paths[dtype] - exact).mean())) / moved, ""


def stepped(simulator: Simulator, path: np.ndarray) -> np.ndarray:
    """Modes (T, r, 3) along a path and its copy side by side, which takes the way of batches."""
    return simulator.rollouts(np.stack([path, path])).latent[0]


def unfit_checkpoint() -> tuple[float, str]:
    output = new_folder()
    held = content(synthetic_network())
    name = next(name for name in held["state_dict"] if name.endswith("weight"))
    held["state_dict"][name].view(-1)[0] = math.inf
    torch.save(held, output / "bad.ckpt")
    return unsaid(lambda: Simulator.load(output / "bad.ckpt"), "bad.ckpt", "not finite")


def wrong_modes() -> tuple[float, str]:
    return unsaid(lambda: Simulator.load(synthetic_network(), num_modes=5), "num_modes is 5", "1 to 4")


MEASURES = {
    "NaN in a mode": partial(poison, "train", "latent"),
    "NaN in a force": partial(poison, "train", "force"),
    "NaN in a pose": partial(poison, "train", "pose"),
    "NaN in a validation run": partial(poison, "validation", "latent"),
    "learning rate 1e3 times too high from step 12": partial(exploding_rate, 1000.0),
    "learning rate 1e8 times too high from step 12": partial(exploding_rate, 100000000.0),
    "learning rate 1e15 from the start": far_too_high_rate,
    "a gradient that is not finite": spoilt_gradient,
    "interrupted once": partial(resumed, (15,)),
    "interrupted three times, twice before the first save": partial(resumed, (3, 5, 19)),
    "interrupted with a horizon and fewer modes": partial(resumed, (8, 13), horizon=3, fewer_modes=0.5),
    "runs that are all the same": no_variance,
    "a tool that feels nothing": no_force,
    "all modes at one place": coinciding_nodes,
    "runs of four frames, batches of 512": partial(few_frames, batch_size=512),
    "horizon longer than the runs": horizon_too_long,
    "network in float32": partial(precision, torch.float32),
    "network in bfloat16": partial(precision, torch.bfloat16),
    "a weight that is not finite": unfit_checkpoint,
    "more modes than trained": wrong_modes,
}
