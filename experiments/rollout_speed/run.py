"""How fast are training and rollout, and what do the rearrangements of the network gain?

    python experiments/rollout_speed/run.py [--threads 1 2 4]

On one thread its processor time is the clock, and everything is timed in turn in one process, so that other work on the
machine matters little; on several threads it is the wall clock, the best of several rounds. Weights and inputs are
random: time does not depend on them. Writes table.csv and bars.png beside this script.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from unittest.mock import patch

sys.path.insert(1, str(Path(__file__).resolve().parents[1]))

import matplotlib.pyplot as plt
import torch
from common import training_settings, write_rows
from torch import Tensor

from sgns.evaluate.costs import cpu_model
from sgns.model import network as formulas
from sgns.model.features import BodyTrack
from sgns.model.network_dynamics import LatentDynamics
from sgns.settings import ModelSettings

HERE = Path(__file__).parent
Row = dict[str, object]
Job = Callable[[], object]
MODES = 8
BODY_POINTS = 15
NETWORKS = {
    "paper's size": ["model.body_nodes=points"],
    "default": [],
    "fast": ["preset=fast"],
}


def dynamics_of(overrides: list[str]) -> LatentDynamics:
    """An untrained network without context, on 8 modes."""
    model = training_settings(*overrides)["model"] | {"context": []}
    torch.manual_seed(0)
    dynamics = LatentDynamics(ModelSettings(**model), MODES).requires_grad_(False)
    # Small changes: a path of random weights stays in the range of numbers of a trained one.
    dynamics.change.scale.fill_(1e-3)
    return dynamics


def track_of(dynamics: LatentDynamics, paths: int, frames: int) -> BodyTrack:
    """Bodies on random ways, (B, T, N, ...)."""
    pose = dynamics.settings.body_nodes == "pose"
    nodes = 1 if pose else BODY_POINTS
    motion = 0.01 * torch.randn(paths, frames, 1, 3).double().expand(-1, -1, nodes, -1)
    position = torch.randn(1, 1, nodes, 3).double() + motion.cumsum(1)
    if not pose:
        return BodyTrack(position, position[..., :0], motion)
    orientation = torch.randn(paths, frames, 1, 6).double()
    return BodyTrack(position, orientation, torch.cat([motion, torch.zeros_like(motion)], -1))


def in_turn(jobs: dict[str, Job], rounds: int, calls: int, wall: bool = False) -> dict[str, float]:
    """Time of a call [s], the jobs in turn: the median of processor times, or the shortest by the clock."""
    now = time.perf_counter if wall else time.thread_time
    times: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(rounds):
        for name, job in jobs.items():
            job()
            for _ in range(calls):
                began = now()
                job()
                times[name].append(now() - began)
    return {name: min(values) if wall else statistics.median(values) for name, values in times.items()}


def time_rollouts(name: str, dynamics: LatentDynamics, rounds: int) -> list[Row]:
    """Whole steps with features, force and torque: advance, a path, paths side by side."""
    frames, d = 123, dynamics.history
    latent = torch.randn(1, d, MODES, 3).double()
    track = track_of(dynamics, 1, frames)

    def advanced() -> None:
        states = latent.expand(1, d, MODES, 3)
        for t in range(d, frames):
            step = dynamics.advance(states, track.frames(slice(t - d + 1, t + 1)))
            states = torch.cat([states[:, 1:], step.latent[:, None]], 1)

    def plainly() -> None:
        with patch.object(dynamics.network, "forward", dynamics.network.plain):
            advanced()

    jobs: dict[str, Job] = {
        "advance, plain network": plainly,
        "advance": advanced,
        "a path": lambda: dynamics.unroll(latent, track),
    }
    with torch.inference_mode():
        whole = in_turn(jobs, rounds, 1)
        found = {job: seconds / (frames - d) for job, seconds in whole.items()}
        paths, steps = 256, 2
        many, start = track_of(dynamics, paths, d + steps), latent.expand(paths, -1, -1, -1)
        seconds = in_turn({"": lambda: dynamics.unroll(start, many)}, rounds, 1)[""]
        found[f"{paths} paths side by side"] = seconds / (steps * paths)
    plain = found["advance, plain network"]
    return [
        {
            "part": "rollout",
            "network": name,
            "what": job,
            "us": s * 1e6,
            "times_faster_than_plain": plain / s,
            "note": "per path and step, force and torque included",
        }
        for job, s in found.items()
    ]


def time_training(
    name: str, dynamics: LatentDynamics, threads: list[int], cores: set[int], rounds: int
) -> list[Row]:
    """Optimiser steps of the network, plain and as it is, with batches of 32: on one thread its processor time, the
    median; on more the wall clock, the best of the rounds."""
    network, batch = dynamics.network.requires_grad_(True), 32
    body = 1 if dynamics.settings.body_nodes == "pose" else BODY_POINTS
    edge_index = dynamics.edge_index(MODES, body, torch.device("cpu"))
    nodes = torch.randn(batch, MODES + body, network.encode_nodes.first.in_features)
    edges = torch.randn(batch, edge_index.shape[1], network.encode_edges.first.in_features)
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-4, fused=True)

    def trained(form: Callable[..., Tensor], fast_products: bool) -> None:
        with patch.object(formulas, "_AVAILABLE", fast_products and formulas._AVAILABLE):
            optimizer.zero_grad()
            form(nodes, edges, edge_index).square().mean().backward()
            optimizer.step()

    jobs: dict[str, Job] = {
        "plain": lambda: trained(network.plain, False),
        "oneDNN's products": lambda: trained(network, True),
    }
    rows: list[Row] = []
    for count in threads:
        torch.set_num_threads(count)
        os.sched_setaffinity(0, cores if count > 1 else {min(cores)})
        if count == 1:
            found, clock = in_turn(jobs, rounds, 2), "processor time, median"
        else:
            found, clock = in_turn(jobs, rounds, 3, wall=True), "wall clock, best round"
        rows += [
            {
                "part": "training",
                "network": name,
                "what": form,
                "threads": count,
                "samples_per_s": batch / seconds,
                "times_faster_than_plain": found["plain"] / seconds,
                "note": f"forward, backward, AdamW; batch 32; {clock}",
            }
            for form, seconds in found.items()
        ]
    torch.set_num_threads(1)
    os.sched_setaffinity(0, {min(cores)})
    return rows


def draw(rows: list[Row]) -> None:
    """Bars: whole steps and training of the three networks, on one core."""
    figure, axes = plt.subplots(1, 2, figsize=(12, 3.8), layout="constrained")
    panels = (
        ("rollout", "us", "whole step per path [µs]"),
        ("training", "samples_per_s", "training [samples/s]"),
    )
    for axis, (part, key, title) in zip(axes, panels, strict=True):
        shown = [row for row in rows if row["part"] == part and row.get("threads", 1) == 1]
        names = [f"{row['network']}: {row['what']}" for row in shown]
        colours = ["0.5" if "plain" in name else "C0" for name in names]
        bars = axis.barh(names, [row[key] for row in shown], color=colours)
        axis.bar_label(bars, fmt=" %.0f", fontsize=7)
        axis.set_title(title, fontsize=9)
        axis.margins(x=0.2)
        axis.tick_params(labelsize=7)
        axis.invert_yaxis()
    figure.savefig(HERE / "bars.png", dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--rounds", type=int, default=10)
    options = parser.parse_args()
    torch.set_num_threads(1)
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    rows: list[Row] = []
    for name, overrides in NETWORKS.items():
        dynamics = dynamics_of(overrides)
        rows += time_rollouts(name, dynamics, max(2, options.rounds // 3))
        rows += time_training(name, dynamics, options.threads, cores, options.rounds)
        print(name, *rows, sep="\n", flush=True)
    machine = f"{cpu_model()}, {len(cores)} of {os.cpu_count()} cores"
    write_rows(HERE / "table.csv", [{"threads": 1} | row | {"machine": machine} for row in rows])
    draw(rows)


if __name__ == "__main__":
    main()
