"""What the same network would cost on every particle: the paper's comparison, measured on this machine.

Costs do not depend on what a network has learned, so an untrained one is timed.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from sgns.clock import elapsed
from sgns.evaluation.costs import forget_peak, peak_memory
from sgns.evaluation.results import FullSpaceCost
from sgns.full_space.body_surface import box_surface
from sgns.full_space.dynamics import FullSpaceDynamics
from sgns.full_space.training import losses
from sgns.full_space.windows import FullSpaceRun, FullSpaceWindows
from sgns.learning.model_settings import ModelSettings
from sgns.rollout import single_thread
from sgns.runs import Run

__all__ = ["full_space_cost"]

_BATCH = 2  # windows of a training step, the paper's
_REACH = 4 / 3  # radius of the neighbourhood in particle spacings: 6 neighbours in a bed at rest


def full_space_cost(path: Path, settings: ModelSettings, repeats: int) -> FullSpaceCost:
    """Time and memory of a step, with the tool half-way along a run.

    Args:
        path: the run.
        settings: of the network; its body has nodes on its surface whatever `body_nodes` says.
        repeats: timed steps, after one to warm up; medians count.
    """
    with Run(path) as run:
        spacing = float(np.prod(run.scene["bed"]["size"]) / run.particle_count) ** (1 / 3)
        blade = run.scene.get("blade")
    # Nodes of a blade as close together as particles, so that none slips between them; of other bodies as recorded.
    nodes = None
    if blade is not None:
        nodes = box_surface(np.array([blade["thickness"], blade["width"], blade["length"]]) / 2, spacing)
    one_run = FullSpaceRun(path, nodes)
    dynamics = FullSpaceDynamics(replace(settings, body_nodes="points"), _REACH * spacing, one_run.bin_size)
    windows = FullSpaceWindows([one_run], dynamics.history)
    window = windows.window(len(windows) // 2)
    still = torch.zeros(3, dtype=torch.float64)

    def training_step() -> None:
        dynamics.zero_grad()
        sum(losses(dynamics, windows.batch(0, _BATCH, still))).backward()

    with single_thread():
        with torch.inference_mode():
            frame = _wall_time(lambda: dynamics.advance(window.history, window.body), repeats)
        forget_peak()
        step = _wall_time(training_step, repeats)
    return FullSpaceCost(
        parameters=sum(weight.numel() for weight in dynamics.parameters()),
        training_step=step,
        batch_size=_BATCH,
        rollout=frame * one_run.frame_rate,
        peak_bytes=peak_memory(),
    )


def _wall_time(action: Callable[[], object], repeats: int) -> float:
    """Median after one call to warm up [s]."""
    action()
    found = []
    for _ in range(repeats):
        began = time.perf_counter()
        action()
        found.append(elapsed(began, time.perf_counter()))
    return statistics.median(found)
