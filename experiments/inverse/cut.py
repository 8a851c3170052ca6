"""The cut that moves the most soil per joule: by gradients and without, verified in the solver.

python experiments/inverse/cut.py    # rows of table.csv, cuts.csv
"""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.optimize import differential_evolution
from torch import Tensor

from mpm_warp import Excavation, Scene
from sgns import Run, Simulator, TorchSimulator
from sgns.gradients import TorchPath, tool_poses
from sgns.model.training_range import NOTEWORTHY

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
from common import read_rows, write_rows  # noqa: E402

DURATION = 2.5  # of a cut [s]
LEAST = 2.0  # soil that has to be moved [l]
KNOTS = 6  # of depth and of speed, evenly in time
RATE = 0.05  # of Adam, in shares of the parameters' ranges


class Problem:
    """What is asked: cuts by parameters from 0 to 1, and what they are worth."""

    def __init__(self) -> None:
        self.simulator = Simulator.pretrained("excavation")
        self.torch = TorchSimulator(self.simulator)
        scene = Scene.from_dict(self.simulator.scene)
        assert isinstance(scene, Excavation)
        self.scene = scene
        self.time = (
            torch.arange(round(DURATION * scene.frame_rate) + 1, dtype=torch.float64) / scene.frame_rate
        )

    def poses(self, x: Tensor, z: Tensor, rake: Tensor) -> Tensor:
        """Of a plate whose tip has moved by x and z (B, T) [m], at a rake (B, 1) [degrees]; shape (B, T, 7)."""
        turn = torch.deg2rad(-rake).expand_as(x)
        none = torch.zeros_like(turn)
        place = self.scene.start * self.scene.bed.size[0] + x, self.scene.clearance + z
        # The centre of mass from the tip.
        half, thick = 0.5 * self.scene.blade.length, 0.5 * self.scene.blade.thickness
        arm = half * turn.sin() - thick * turn.cos(), half * turn.cos() + thick * turn.sin()
        centre = place[0] + arm[0], none + 0.5 * self.scene.bed.size[1], place[1] + arm[1]
        return tool_poses(torch.stack(centre, -1), torch.stack([none, turn, none], -1))

    def measures(self, path: TorchPath) -> tuple[Tensor, Tensor, Tensor]:
        """Soil moved [l], work [J], and how far every frame is outside of the training range [1]."""
        moved = 1e3 * self.torch.moved_volume(path.latent)
        return moved, self.torch.work(path).sum(-1), self.torch.outside(path)

    def loss(self, path: TorchPath) -> Tensor:
        """Smallest for the best cut, shape (B,)."""
        moved, work, outside = self.measures(path)
        short = (1.0 - moved / LEAST).clamp_min(0.0)
        beyond = (outside - NOTEWORTHY).clamp_min(0.0).square().mean(-1)
        return torch.log(work.clamp_min(0.1) / moved) + 100.0 * short.square() + 400.0 * beyond


class Trained(Problem):
    """Half ellipses, as the network was trained on: depth, speed, rake."""

    name, steps = "cut of the trained kind", 40
    low, high = (0.04, 0.04, 0.0), (0.10, 0.15, 45.0)  # [m], [m/s], [degrees]
    guesses: ClassVar = {
        "deep": (0.10, 0.05, 0.0),
        "fast": (0.07, 0.14, 5.0),
        "steep": (0.05, 0.06, 0.0),
    }

    def cuts(self, parameters: Tensor) -> Tensor:
        low, high = torch.tensor([self.low, self.high], dtype=torch.float64)
        depth, speed, rake = (low + parameters * (high - low)).split(1, dim=-1)
        period = 0.4 / speed
        time = torch.minimum(self.time[1:], 0.95 * period)  # the slope at the start is infinite
        fallen = 2.0 * depth / period * (time * (period - time)).sqrt()
        pad = torch.nn.functional.pad
        return self.poses(pad(speed * time, (1, 0)), pad(-fallen, (1, 0)), rake)


class Free(Problem):
    """Any depth and speed at every knot, with a smooth curve between them, and a rake."""

    name, steps = "free cut", 30
    low = (0.0,) * (2 * KNOTS + 1)
    high = (0.09,) * KNOTS + (0.15,) * KNOTS + (45.0,)
    guesses: ClassVar = {
        "deep": (0.09,) * KNOTS + (0.06,) * KNOTS + (0.0,),
        "ramp": (0.01, 0.02, 0.04, 0.05, 0.07, 0.08) + (0.10,) * KNOTS + (10.0,),
        "slow": (0.05,) * KNOTS + (0.03,) * KNOTS + (20.0,),
    }

    def __init__(self) -> None:
        super().__init__()
        ends, time = np.linspace(0.0, DURATION, KNOTS + 1), self.time.numpy()
        # Both are linear in the knots; the depth begins at 0.
        depth = CubicSpline(ends, np.eye(KNOTS + 1)[:, 1:])(time)
        speed = CubicSpline(ends[1:], np.eye(KNOTS))
        way = np.stack([speed.integrate(0.0, t) for t in time])
        self.depth, self.way = torch.from_numpy(depth), torch.from_numpy(way)

    def cuts(self, parameters: Tensor) -> Tensor:
        depths, speeds, rake = (parameters * torch.tensor(self.high, dtype=torch.float64)).split(
            [KNOTS, KNOTS, 1], dim=-1
        )
        return self.poses(speeds @ self.way.T, -depths @ self.depth.T, rake)


Trace = list[tuple[float, float]]
"""Processor time [s] and the smallest loss until then."""


def by_gradient(problem: Trained | Free, starts: np.ndarray) -> tuple[np.ndarray, list[Trace]]:
    """Parameters of the best cut from every start (B, any), all followed side by side; time is that of each."""
    given = torch.tensor(starts, requires_grad=True)
    optimizer = torch.optim.Adam([given], lr=RATE)
    best, found = np.full(len(starts), np.inf), starts.copy()
    traces: list[Trace] = [[] for _ in starts]
    began = time.process_time()
    for _ in range(problem.steps):
        optimizer.zero_grad()
        loss = problem.loss(problem.torch.rollout(problem.cuts(given), segment=len(problem.time)))
        loss.sum().backward()
        spent = (time.process_time() - began) / len(starts)
        for i, value in enumerate(loss.tolist()):
            if value < best[i]:
                best[i], found[i] = value, given[i].detach().numpy()
            traces[i].append((spent, best[i]))
        optimizer.step()
        with torch.no_grad():
            given.clamp_(0.0, 1.0)
    return found, traces


class OutOfTimeError(Exception):
    """The other method has had as long."""


def without_gradient(problem: Trained | Free, start: np.ndarray, seconds: float) -> tuple[np.ndarray, Trace]:
    """Likewise, of differential evolution that begins with the same cut, all cuts of a generation side by side."""
    best: list[tuple[float, np.ndarray]] = [(np.inf, start)]
    trace: Trace = []
    began = time.process_time()

    def losses(columns: np.ndarray) -> np.ndarray:
        if time.process_time() - began > seconds:
            raise OutOfTimeError
        with torch.no_grad():
            answer = problem.simulator.rollouts(problem.cuts(torch.from_numpy(columns.T.copy())).numpy())
            parts = [
                torch.from_numpy(part) for part in (answer.latent, answer.force, answer.torque, answer.poses)
            ]
            found = problem.loss(TorchPath(*parts, torch.zeros(columns.shape[1], 0))).numpy()
        lowest = int(found.argmin())
        if found[lowest] < best[0][0]:
            best[0] = float(found[lowest]), columns[:, lowest].copy()
        trace.append((time.process_time() - began, best[0][0]))
        return found

    try:
        bounds = [(0.0, 1.0)] * len(start)
        differential_evolution(
            losses, bounds, x0=start, popsize=3, maxiter=10_000, tol=0.0, rng=0, polish=False, vectorized=True,
            updating="deferred",
        )  # fmt: skip
    except OutOfTimeError:
        pass
    return best[0][1], trace


def write_path(problem: Problem, poses: np.ndarray, file: Path) -> None:
    """A file for `scene.path`."""
    rows = np.column_stack([problem.time.numpy(), poses])
    np.savetxt(file, rows, delimiter=",", header="t,x,y,z,qx,qy,qz,qw", comments="")


def verified(problem: Trained | Free, poses: np.ndarray, name: str) -> tuple[float, float]:
    """Soil moved [l] and work [J] of a cut in the solver."""
    folder = Path("outputs/inverse")
    folder.mkdir(parents=True, exist_ok=True)
    file, run = folder / f"{name}.csv", folder / f"{name}.h5"
    write_path(problem, poses, file)
    scene = [
        "scene=quick_excavation",
        "scene.motion=path",
        f"scene.path={file}",
        f"scene.duration={DURATION}",
    ]
    command = [sys.executable, "-m", "sgns", "simulate", *scene, f"output={run}", "overwrite=true"]
    subprocess.run(command, check=True, capture_output=True)
    with Run(run) as done:
        way = np.linalg.norm(done.positions(len(done.time) - 1) - done.positions(0), axis=-1)
        work = -(done.force[1:] * np.diff(done.pose[:, :3], axis=0)).sum()
    bed = problem.scene.bed
    return 1e3 * float((way**2 / (way**2 + 0.05**2)).sum() * bed.particle_volume), float(work)


def row_of(
    problem: Trained | Free, method: str, start: str, found: np.ndarray, trace: Trace
) -> dict[str, Any]:
    """A row of the table; the cut is verified."""
    with torch.no_grad():
        poses = problem.cuts(torch.from_numpy(found[None]))
        moved, work, outside = (part.max().item() for part in problem.measures(problem.torch.rollout(poses)))
    name = f"{type(problem).__name__}_{method.replace(' ', '_')}_{start}"
    really, needed = verified(problem, poses[0].numpy(), name)
    rake = problem.high[-1] * found[-1]
    return {
        "problem": problem.name,
        "method": method,
        "start": start,
        "seconds": trace[-1][0] if trace else 0.0,
        "found": f"rake {rake:.0f} deg, {100 * float(poses[0, -1, 0] - poses[0, 0, 0]):.0f} cm long, "
        f"{100 * float(poses[0, 0, 2] - poses[0, :, 2].min()):.1f} cm down",
        "unit": "l/J",
        "network": moved / work,
        "solver": really / needed,
        "network_moved_l": moved,
        "solver_moved_l": really,
        "network_work_J": work,
        "solver_work_J": needed,
        "outside": outside,
    }


def main() -> None:
    torch.set_num_threads(1)
    for kind in (Trained, Free):
        if not sys.argv[1:] or kind.__name__.lower() in sys.argv[1:]:
            search(kind())


def search(problem: Trained | Free) -> None:
    """All starts of a kind of cut, by both methods; the rows of both tables."""
    rows, cuts = [], []
    low, high = np.array(problem.low), np.array(problem.high)
    starts = np.stack([(np.array(guess) - low) / (high - low) for guess in problem.guesses.values()])
    ends, traces = by_gradient(problem, starts)
    for name, start, end, followed in zip(problem.guesses, starts, ends, traces, strict=True):
        tries: dict[str, tuple[np.ndarray, Trace]] = {"guess": (start, []), "gradient": (end, followed)}
        tries["differential evolution"] = without_gradient(problem, start, followed[-1][0])
        for method, (found, trace) in tries.items():
            rows.append(row_of(problem, method, name, found, trace))
            print(rows[-1], flush=True)
            with torch.no_grad():
                poses = problem.cuts(torch.from_numpy(found[None]))[0].numpy()
            own = {"problem": problem.name, "method": method, "start": name}
            tip = {"x": poses[::10, 0] - poses[0, 0], "z": poses[::10, 2] - poses[0, 2]}
            cuts += [own | dict(zip(tip, values, strict=True)) for values in zip(*tip.values(), strict=True)]
    for file, new in ((HERE / "cuts.csv", cuts), (HERE / "table.csv", rows)):
        write_rows(file, [*(row for row in read_rows(file) if row["problem"] != problem.name), *new])


if __name__ == "__main__":
    main()
