"""Measure the plugs: latency and energy of the coupling, steps per second of the environments, a path that is learned.

python experiments/plugs/run.py coupling|envs|learned

Each writes its table and figure beside this file.
"""

from __future__ import annotations

import csv
import runpy
import socket
import sys
import threading
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

import sgns
from mpm_warp import Scene, Solver
from mpm_warp.poses import sampled_poses
from sgns.coupling import BETWEEN, Coupling
from sgns.data.surface import soil_surface
from sgns.envs import EFFORT, DigEnvs

HERE = Path(__file__).parent
REPEATS = 5
"""Times that a cut is driven, and speeds are measured; the best counts for speeds."""


def write(name: str, rows: list[dict[str, object]]) -> None:
    """A table, also on the screen."""
    with open(HERE / name, "w", newline="") as file:
        table = csv.DictWriter(file, rows[0])
        table.writeheader()
        table.writerows(rows)
    for row in rows:
        print(*(f"{key}={value}" for key, value in row.items()))


def driven(between: str, times: np.ndarray, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Forces [N], wall and processor time of every call [s], (T, 2), and whether a frame was due, along a cut."""
    soil = Coupling(sgns.Simulator.pretrained("excavation"), between)
    soil.reset(poses[0])
    force, spent, due = np.zeros((len(times), 3)), np.zeros((len(times), 2)), np.zeros(len(times), bool)
    for i, (t, pose) in enumerate(zip(times, poses, strict=True)):
        frame, begin = soil.state.frame, np.array([time.perf_counter(), time.thread_time()])
        force[i] = soil.step(t, pose).force
        spent[i] = [time.perf_counter(), time.thread_time()] - begin
        due[i] = soil.state.frame > frame
    return force, spent, due


def datagrams(count: int = 5000) -> np.ndarray:
    """Round trips of a pose and a wrench over UDP on this machine [s]."""
    here, there = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    there.bind(("127.0.0.1", 0))

    def echo() -> None:
        for _ in range(count):
            data, address = there.recvfrom(64)
            there.sendto(data[:48], address)

    threading.Thread(target=echo, daemon=True).start()
    spent = np.zeros(count)
    for i in range(count):
        begin = time.perf_counter()
        here.sendto(bytes(64), there.getsockname())
        here.recvfrom(48)
        spent[i] = time.perf_counter() - begin
    return spent


def coupling() -> None:
    """Latency at 1 kHz, and the work that is felt beside that of the frames."""
    torch.set_num_threads(1)
    simulator = sgns.Simulator.pretrained("excavation")
    cut = replace(Scene.from_dict(simulator.scene), depth=0.06, speed=0.1).body_poses()
    clock = np.arange(len(cut)) / 60
    times = np.arange(0.0, clock[-1], 1e-3)
    poses = sampled_poses(np.column_stack([clock, cut]), times)
    frames = simulator.rollout(cut).force
    truth = -(frames[1:] * np.diff(cut[:, :3], axis=0)).sum()
    # What a controller would feel if every frame's mean was known from its beginning.
    ideal = frames[np.minimum((times * 60).astype(int) + 1, len(frames) - 1)]
    rows: list[dict[str, object]] = []
    felt = {}
    for between in BETWEEN:
        force, spent, due = driven(between, times, poses)
        for _ in range(REPEATS - 1):
            again = driven(between, times, poses)
            spent, due = np.concatenate([spent, again[1]]), np.concatenate([due, again[2]])
        felt[between] = force
        work = -(force[:-1] * np.diff(poses[:, :3], axis=0)).sum()
        rows.append(
            {
                "between": between,
                "work_error_percent": f"{100 * (work / truth - 1):.2f}",
                "force_rms_error_percent": f"{100 * np.sqrt(((force - ideal) ** 2).sum() / (ideal**2).sum()):.1f}",
                **{
                    f"{clock}_p{q}_us": f"{1e6 * np.percentile(spent[:, i], q):.0f}"
                    for i, clock in enumerate(("wall", "processor"))
                    for q in (50, 99, 99.9)
                },
                "processor_p50_with_frame_us": f"{1e6 * np.median(spent[due, 1]):.0f}",
            }
        )
    write("coupling.csv", rows)
    trips = 1e6 * np.percentile(datagrams(), [50, 99, 99.9])
    print(f"UDP round trips: {trips.round()} us (50, 99, 99.9 %); work {truth:.1f} J")
    figure = Figure((10.0, 3.6), layout="constrained")
    whole, near = figure.subplots(1, 2)
    for axes, window in ((whole, (0.0, 4.0)), (near, (1.0, 1.15))):
        shown = (times >= window[0]) & (times <= window[1])
        axes.plot(times[shown], ideal[shown, 0], color="0.75", lw=3, label="mean of the frame itself")
        for between in BETWEEN if axes is near else BETWEEN[:1]:
            axes.plot(times[shown], felt[between][shown, 0], lw=1, label=between)
        axes.set(xlabel="time [s]", ylabel="force along x [N]")
        axes.legend(fontsize=8)
    figure.savefig(HERE / "coupling.png", dpi=110)


def envs() -> None:
    """Steps of 1/60 s of soil in a second, of 256 beds, with observation and reward every sixth; in turn, the best."""
    rng = np.random.default_rng(0)
    cases = [(threads, half) for threads in (1, 2) for half in (False, True)]
    many = {half: DigEnvs(256, half=half) for half in (False, True)}
    for one in many.values():
        one.reset(seed=0)
        one.step(np.zeros((256, 2)))
    best = dict.fromkeys(cases, (np.inf, np.inf))
    for _ in range(REPEATS):
        for threads, half in cases:
            torch.set_num_threads(threads)
            actions = rng.uniform(-0.3, 0.3, (256, 2))
            begin = time.perf_counter(), time.process_time()
            many[half].step(actions)
            spent = time.perf_counter() - begin[0], time.process_time() - begin[1]
            best[threads, half] = min(best[threads, half][0], spent[0]), min(best[threads, half][1], spent[1])
    steps = 256 * many[False].frames
    write(
        "envs.csv",
        [
            {
                "threads": threads,
                "half": half,
                "steps_per_second": round(steps / best[threads, half][0], -2),
                "steps_per_processor_second": round(steps / best[threads, half][1], -2),
            }
            for threads, half in cases
        ],
    )


def learned() -> None:
    """The example's learning curve, and its path in the solver."""
    torch.set_num_threads(1)
    sys.argv = ["learn_to_dig.py", "14", "96"]
    found = runpy.run_path(str(HERE.parents[1] / "examples" / "learn_to_dig.py"))
    curve, mean, target, knots = (found[name] for name in ("curve", "mean", "target", "knots"))
    one = DigEnvs(1, seconds=3.0)
    one.reset(options={"target": target})
    solver = Solver(one.scene)
    state = solver.reset()
    earned, work, poses = 0.0, 0.0, [one.start]
    step = one.beds.step

    def noted(pose: np.ndarray, which: np.ndarray | None = None) -> None:
        poses.append(pose[0].copy())
        step(pose, which)

    one.beds.step = noted  # type: ignore[method-assign]
    for t in found["when"]:
        before = min(int(t), knots - 2)
        share = t - before
        _, reward, *_ = one.step(((1 - share) * mean[before] + share * mean[before + 1])[None])
        earned += reward[0]
    for last, pose in pairwise(poses):
        state = solver.step(pose)
        work -= float(np.dot(state.force, pose[:3] - last[:3]))
    latent = one.simulator.basis.transform(state.position.astype(np.float64))
    heights = one.profile(latent[None])[0]
    # The modes hide something: what do the highest of all particles say?
    surface = soil_surface(state.position, one.scene.to_dict())
    middle = np.abs(surface.y - 0.5 * one.scene.bed.size[1]) < 0.04
    highest = np.interp(one.profile.x, surface.x, np.nanmean(surface.z[:, middle], axis=1))
    dug = target < 0.0
    in_solver, by_particles = (
        1.0 - np.abs(found - target)[dug].mean() / one.to_dig[0] - EFFORT * work
        for found in (heights, highest)
    )
    row = {"network": earned, "solver": in_solver, "solver_by_highest_particles": by_particles}
    write("learned.csv", [{key: f"{value:.3f}" for key, value in row.items()} | {"rounds": str(len(curve))}])
    figure = Figure((10.0, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(np.arange(1, len(curve) + 1), curve, label=["middle of the paths", "best of 96"])
    left.axhline(in_solver, color="0.5", ls="--", label="last middle, in the solver")
    left.set(xlabel="round", ylabel="return [1]")
    left.legend(fontsize=8)
    x = one.profile.x
    right.plot(x, 100 * target, "k--", label="target")
    right.plot(x, 100 * one.heights[0], label="network")
    right.plot(x, 100 * heights, label="solver, same path")
    right.plot(x, 100 * highest, ":", label="solver, highest particles")
    tip = np.array([[p[0] + one.beds.points[:, 0].max(), p[2] + one.beds.points[:, 2].min()] for p in poses])
    right.plot(tip[:, 0], 100 * tip[:, 1], color="0.7", lw=1, label="tool's edge")
    right.set(xlabel="x [m]", ylabel="height [cm]")
    right.legend(fontsize=8)
    figure.savefig(HERE / "learned.png", dpi=110)


if __name__ == "__main__":
    {"coupling": coupling, "envs": envs, "learned": learned}[sys.argv[1]]()
