"""How fast are training and rollout, and what does each rearrangement of the network gain?

    python experiments/rollout_speed/run.py [--threads 1 2 4]

On one thread its processor time is the clock, and everything is timed in turn in one process, so that other work on the
machine matters little; on several threads it is the wall clock, the best of several rounds. Weights and inputs are
random: time does not depend on them. Writes table.csv and bars.png beside this script.
"""

from __future__ import annotations

import argparse
import csv
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import matplotlib
import torch
from forms import forms_of, multiplications, onednn
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf
from torch import Tensor

from sgns.evaluate.costs import cpu_model
from sgns.model.fast_step import GraphStepper
from sgns.model.features import BodyTrack
from sgns.model.network import product
from sgns.model.network_dynamics import LatentDynamics
from sgns.model.settings import ModelSettings

matplotlib.use("Agg")
import matplotlib.pyplot as plt

HERE = Path(__file__).parent
MODES = 8
BODY_POINTS = 15
PARTICLES = 29_700
NETWORKS = {
    "paper's size": ["model.body_nodes=points"],
    "default": [],
    "fast": ["preset=fast"],
}


def dynamics_of(overrides: list[str]) -> LatentDynamics:
    """An untrained network without context, on 8 modes."""
    with initialize_config_module("sgns.conf", version_base="1.3"):
        model = OmegaConf.to_container(compose("train", overrides).model)
    torch.manual_seed(0)
    dynamics = LatentDynamics(ModelSettings(**(model | {"context": []})), MODES).requires_grad_(False)
    # Small changes: a path of random weights stays in the range of numbers of a trained one.
    dynamics.change.scale.fill_(1e-3)
    return dynamics


def track_of(dynamics: LatentDynamics, paths: int, frames: int, turning: bool = False) -> BodyTrack:
    """Bodies on random ways, (B, T, N, ...)."""
    pose = dynamics.settings.body_nodes == "pose"
    nodes = 1 if pose else BODY_POINTS
    motion = 0.01 * torch.randn(paths, frames, nodes if turning else 1, 3).double().expand(-1, -1, nodes, -1)
    position = torch.randn(1, 1, nodes, 3).double() + motion.cumsum(1)
    if not pose:
        return BodyTrack(position, position[..., :0], motion)
    return BodyTrack(
        position,
        torch.randn(paths, frames, 1, 6).double(),
        torch.cat([motion, torch.zeros_like(motion)], -1),
    )


def in_turn(
    jobs: dict[str, Callable[[], object]], rounds: int, calls: int, warm: int = 2
) -> dict[str, float]:
    """Median processor time of a call [s], the jobs in turn; after some calls that warm the caches."""
    times: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(rounds):
        for name, job in jobs.items():
            for _ in range(warm):
                job()
            for _ in range(calls):
                began = time.thread_time()
                job()
                times[name].append(time.thread_time() - began)
    return {name: statistics.median(values) for name, values in times.items()}


def best_by_the_clock(jobs: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Shortest time of a call [s], the jobs in turn."""
    best = dict.fromkeys(jobs, float("inf"))
    for _ in range(rounds):
        for name, job in jobs.items():
            job()
            for _ in range(3):
                began = time.perf_counter()
                job()
                best[name] = min(best[name], time.perf_counter() - began)
    return best


def time_forms(name: str, dynamics: LatentDynamics, rounds: int) -> list[dict[str, object]]:
    """One step of the network, form by form, beside dense products of as many multiplications."""
    network, body = dynamics.network, 1 if dynamics.settings.body_nodes == "pose" else BODY_POINTS
    edge_index = dynamics.edge_index(MODES, body, torch.device("cpu"))
    nodes = torch.randn(1, MODES + body, network.encode_nodes.first.in_features)
    edges = torch.randn(1, edge_index.shape[1], network.encode_edges.first.in_features)
    width, work = network.process[0].width, multiplications(network, MODES + body, edge_index.shape[1])
    rows = round(work / width**2)
    left, right, out = torch.randn(rows, width), torch.randn(width, width), torch.empty(rows, width)
    stepper = GraphStepper(network, edge_index, MODES + body, body)

    def without_onednn(job: Callable[[], object]) -> Callable[[], object]:
        def called() -> None:
            with onednn(False):
                job()

        return called

    jobs: dict[str, Callable[[], object]] = {
        form: without_onednn(lambda f=f: f(nodes, edges))
        for form, f in forms_of(network, edge_index, MODES + body).items()
    }
    with onednn(False):
        plain_stepper = GraphStepper(network, edge_index, MODES + body, body)
    jobs |= {
        "all matrices merged once, memory kept": lambda: plain_stepper(nodes[0], edges[0]),
        "oneDNN's products": lambda: stepper(nodes[0], edges[0]),
    }
    if body > 1:
        jobs["edges within the body kept"] = lambda: stepper(nodes[0], edges[0], same_body=True)
    jobs |= {
        "one dense product, torch.mm": lambda: torch.mm(left, right, out=out),
        "one dense product, oneDNN": lambda: product(left, right),
    }
    with torch.inference_mode():
        found = in_turn(jobs, rounds, 20)
    return [
        {
            "part": "network step",
            "network": name,
            "what": form,
            "us": seconds * 1e6,
            "times_faster_than_plain": found["plain"] / seconds,
            "times_torch_mm": seconds / found["one dense product, torch.mm"],
            "times_onednn_product": seconds / found["one dense product, oneDNN"],
            "note": f"{2e-6 * work:.1f} MFLOP",
        }
        for form, seconds in found.items()
    ]


def time_rollouts(name: str, dynamics: LatentDynamics, rounds: int) -> list[dict[str, object]]:
    """Whole steps with features, force and torque: advance, a path, a path whose body turns, paths side by side."""
    frames, d = 123, dynamics.history
    latent = torch.randn(1, d, MODES, 3).double()
    track = track_of(dynamics, 1, frames)
    turning = track_of(dynamics, 1, frames, turning=True)

    def advanced() -> None:
        states = latent.expand(1, d, MODES, 3)
        for t in range(d, frames):
            step = dynamics.advance(states, track.frames(slice(t - d + 1, t + 1)))
            states = torch.cat([states[:, 1:], step.latent[:, None]], 1)

    def plainly() -> None:
        forward, dynamics.network.forward = dynamics.network.forward, dynamics.network.plain
        try:
            advanced()
        finally:
            dynamics.network.forward = forward

    jobs: dict[str, Callable[[], object]] = {
        "advance, plain network": plainly,
        "advance": advanced,
        "a path": lambda: dynamics.unroll(latent, track),
    }
    if dynamics.settings.body_nodes == "points":
        jobs["a path, body turning"] = lambda: dynamics.unroll(latent, turning)
    with torch.inference_mode():
        whole = in_turn(jobs, rounds, 1, warm=1)
        found = {job: seconds / (frames - d) for job, seconds in whole.items()}
        for paths, steps in ((16, 5), (256, 2), (4096, 1)):
            many = track_of(dynamics, paths, d + steps)
            start = latent.expand(paths, -1, -1, -1)
            job = {"": lambda start=start, many=many: dynamics.unroll(start, many)}
            seconds = in_turn(job, 1 if paths == 4096 else rounds, 1, warm=int(paths < 4096))[""]
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
) -> list[dict[str, object]]:
    """Optimiser steps of the network with batches of 32: on one thread its processor time, form by form, the median; on
    more the wall clock, plain and fast, the best of the rounds."""
    network = dynamics.network.requires_grad_(True)
    body = 1 if dynamics.settings.body_nodes == "pose" else BODY_POINTS
    edge_index = dynamics.edge_index(MODES, body, torch.device("cpu"))
    batch = 32
    nodes = torch.randn(batch, MODES + body, network.encode_nodes.first.in_features)
    edges = torch.randn(batch, edge_index.shape[1], network.encode_edges.first.in_features)
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-4, fused=True)

    def trained(form: Callable[[Tensor, Tensor], Tensor], fast_products: bool) -> None:
        with onednn(fast_products):
            optimizer.zero_grad()
            form(nodes, edges).square().mean().backward()
            optimizer.step()

    jobs: dict[str, Callable[[], object]] = {
        form: lambda f=f: trained(f, False) for form, f in forms_of(network, edge_index, MODES + body).items()
    }
    jobs["oneDNN's products"] = lambda: trained(lambda *x: network(*x, edge_index), True)
    rows: list[dict[str, object]] = []
    for count in threads:
        torch.set_num_threads(count)
        os.sched_setaffinity(0, cores if count > 1 else {min(cores)})
        if count == 1:
            found, clock = in_turn(jobs, rounds, 2, warm=1), "processor time, median"
        else:
            ends = {form: jobs[form] for form in ("plain", "oneDNN's products")}
            found, clock = best_by_the_clock(ends, rounds), "wall clock, best round"
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


def time_with_basis(dynamics: LatentDynamics, device: str, rounds: int) -> dict[str, object]:
    """The paper's variant: particles to modes and back in every step, on `device`."""
    dynamics = dynamics.to(device)
    basis = torch.linalg.qr(torch.randn(PARTICLES, MODES))[0].to(device)
    mean = torch.randn(PARTICLES, 3, device=device)
    track = BodyTrack(*(part.to(device) for part in track_of(dynamics, 1, dynamics.history)))
    stepper = dynamics.stepper(BODY_POINTS)
    history = torch.randn(1, dynamics.history, MODES, 3, device=device).double()

    def step() -> None:
        following = stepper.advance(history, track).latent[0].float()
        soil = basis @ following + mean
        latent = basis.T @ (soil - mean)
        if device == "cuda":
            torch.cuda.synchronize()
        assert latent.shape == (MODES, 3)

    with torch.inference_mode():
        seconds = best_by_the_clock({"": step}, 10 * rounds)[""]
    dynamics.to("cpu")
    return {
        "part": "with PCA and inverse",
        "network": "paper's size",
        "what": f"one step, {device}",
        "us": 1e6 * seconds,
        "note": f"{PARTICLES} particles, wall clock, best round",
    }


def draw(rows: list[dict[str, object]]) -> None:
    """Bars: forms of the step at the paper's size, training there, whole steps of the three networks."""
    figure, axes = plt.subplots(1, 3, figsize=(15, 3.8), layout="constrained")
    panels = (
        ("network step, paper's size, one core [µs]", "network step", "us", lambda r: r["network"] == "paper's size"),
        ("training, paper's size, one thread [samples/s]", "training", "samples_per_s",
         lambda r: r["network"] == "paper's size" and r["threads"] == 1),
        ("whole step per path, one core [µs]", "rollout", "us", lambda r: True),
    )  # fmt: skip
    for axis, (title, part, key, chosen) in zip(axes, panels, strict=True):
        shown = [row for row in rows if row["part"] == part and chosen(row)]
        prefix = part == "rollout"
        names = [f"{row['network']}: {row['what']}" if prefix else str(row["what"]) for row in shown]
        values = [float(row[key]) for row in shown]
        colours = ["0.5" if "dense" in n or "plain" in n else "C0" for n in names]
        axis.bar_label(axis.barh(names, values, color=colours), fmt=" %.0f", fontsize=7)
        axis.set_title(title, fontsize=9)
        axis.set_xlim(0, 1.2 * max(values))
        axis.tick_params(labelsize=7)
        axis.invert_yaxis()
    figure.savefig(HERE / "bars.png", dpi=130)


def in_digits(row: dict[str, object]) -> dict[str, object]:
    """Numbers with four digits."""
    return {key: f"{value:.4g}" if isinstance(value, float) else value for key, value in row.items()}


def told(rows: list[dict[str, object]]) -> list[dict[str, object]]:
    """The rows, printed."""
    for row in rows:
        print(*(f"{key}={value}" for key, value in in_digits(row).items() if key != "note"), flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--rounds", type=int, default=10)
    options = parser.parse_args()
    torch.set_num_threads(1)
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    rows: list[dict[str, object]] = []
    for name, overrides in NETWORKS.items():
        dynamics = dynamics_of(overrides)
        rows += told(time_forms(name, dynamics, options.rounds))
        rows += told(time_rollouts(name, dynamics, max(2, options.rounds // 3)))
        if name == "paper's size":
            for device in ("cpu", *(["cuda"] if torch.cuda.is_available() else [])):
                rows += told([time_with_basis(dynamics, device, options.rounds)])
        rows += told(time_training(name, dynamics, options.threads, cores, options.rounds))
    machine = f"{cpu_model()}, {len(cores)} of {os.cpu_count()} cores"
    with (HERE / "table.csv").open("w", newline="") as stream:
        keys = ["part", "network", "what", "threads", "us", "samples_per_s", "times_faster_than_plain",
                "times_torch_mm", "times_onednn_product", "note", "machine"]  # fmt: skip
        writer = csv.DictWriter(stream, keys)
        writer.writeheader()
        for row in rows:
            writer.writerow({"threads": 1} | in_digits(row) | {"machine": machine})
    draw(rows)


if __name__ == "__main__":
    main()
