"""A wheel's most efficient slip, and soil and wheel friction from a measured drive; both verified in the solver.

sgns simulate dataset=quick_wheel dataset.path=data/inverse_wheel dataset.runs=60 'dataset.split=[0.8,0.1,0.1]' \
    'dataset.draw=[{slip: [0.05,0.12,0.2,0.3,0.4,0.55,0.7], friction_angle: [28,31,34,37,40],
    friction: [0.2,0.35,0.5,0.65]}]'
sgns train dataset=quick_wheel dataset.path=data/inverse_wheel 'model.context=[friction_angle,friction,slip]' \
    training.threads=1 output=outputs/inverse_wheel
python experiments/inverse/wheel.py    # rows of table.csv, slips.csv, soils.csv
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.optimize import differential_evolution, minimize, minimize_scalar
from torch import Tensor

from mpm_warp import Scene, Wheel
from sgns import Run, Simulator, TorchSimulator
from sgns.data.dataset import Dataset

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
from common import read_rows, write_rows  # noqa: E402

SLIPS = (0.05, 0.70)
ANGLES, FRICTIONS = (28.0, 40.0), (0.20, 0.65)  # [degrees], [-]
SETTLED = 1.0  # the wheel drives steadily from then on [s]
SOIL = {"friction_angle": 32.5, "friction": 0.45}  # of the search for a slip
NOISE = 0.05  # of a measured force, of its root mean square
DRIVES = (0.15, 0.50)  # slips of the drives that are measured
SOILS = ((29.5, 0.28), (30.5, 0.57), (33.0, 0.42), (35.5, 0.24), (36.0, 0.60), (38.5, 0.38))
"""Friction angle [degrees] and wheel friction that are to be found."""
STARTS = {"low": (28.0, 0.20), "high": (40.0, 0.65), "crossed": (28.0, 0.65)}
SEARCHED = 2  # the soil that is searched from all starts and without gradients, too
BLOCK = 15  # frames in which errors of a force count as one [1/60 s]


class Problem:
    """The network, and drives as it and the solver see them."""

    def __init__(self) -> None:
        self.torch = TorchSimulator(Simulator.load("outputs/inverse_wheel/best.ckpt"))
        scene = Scene.from_dict(self.torch.scene)
        assert isinstance(scene, Wheel)
        self.scene = scene
        # The way is in proportion to 1 - slip, the rotation the same.
        slow, fast = (torch.from_numpy(replace(scene, slip=slip).body_poses()) for slip in (0.5, 0.0))
        self.still, self.way = 2.0 * slow - fast, 2.0 * (fast - slow)
        self.time = np.arange(len(slow)) / scene.frame_rate
        self.driving = torch.from_numpy(self.time >= SETTLED)

    def loads(self, slips: Tensor, angle: Tensor, friction: Tensor) -> Tensor:
        """Pull [N] and torque about the axle [N m] while driving at some slips (B,), shape (B, any, 2)."""
        poses = self.still + (1.0 - slips)[:, None, None] * self.way
        told = {"slip": slips, "friction_angle": angle, "friction": friction}
        path = self.torch.rollout(poses, told, segment=len(self.time))
        return torch.stack([path.force[..., 0], path.torque[..., 1]], -1)[:, self.driving]

    def efficiency(self, slips: Any, loads: Any) -> Any:
        """Power of the pull as a share of that of the axle [1]."""
        pull, torque = (loads[..., i].mean(-1) for i in (0, 1))
        return pull * (1.0 - slips) * 0.5 * self.scene.diameter / -torque

    def measured(self, slip: float, angle: float, friction: float) -> np.ndarray:
        """What the solver says, shape (any, 2)."""
        folder = Path("outputs/inverse")
        folder.mkdir(parents=True, exist_ok=True)
        run = folder / f"wheel_{slip:.4f}_{angle:.3f}_{friction:.4f}.h5"
        if not run.exists():
            values = {"slip": slip, "friction_angle": angle, "friction": friction}
            settings = [f"scene.{key}={value}" for key, value in values.items()]
            command = ["simulate", "scene=quick_wheel", *settings, f"output={run}"]
            subprocess.run([sys.executable, "-m", "sgns", *command], check=True, capture_output=True)
        with Run(run) as done:
            return np.stack([done.force[:, 0], done.torque[:, 1]], -1)[self.driving.numpy()]


# --- The slip with the most pull for the power -----------------------------------------------------------


def best_slips(problem: Problem) -> tuple[list[dict], list[dict]]:
    """Rows of the table; rows of the curve, network and solver."""
    angle, friction = (torch.tensor(SOIL[key], dtype=torch.float64) for key in ("friction_angle", "friction"))
    calls = [0]

    def efficiency(slip: Tensor) -> Tensor:
        calls[0] += 1
        return problem.efficiency(slip, problem.loads(slip, angle, friction))

    def with_slope(x: np.ndarray) -> tuple[float, np.ndarray]:
        slip = torch.tensor(x, requires_grad=True)
        found = -efficiency(slip).sum()
        found.backward()
        return found.item(), slip.grad.numpy()

    def plain(x: float) -> float:
        with torch.no_grad():
            return -float(efficiency(torch.tensor([x], dtype=torch.float64)))

    def solver(slip: float) -> float:
        return float(problem.efficiency(slip, problem.measured(slip, *SOIL.values())))

    tries: list[tuple[str, str, Callable[[], float]]] = [
        ("gradient", f"{start}", lambda start=start: minimize(
            with_slope, [start], jac=True, method="L-BFGS-B", bounds=[SLIPS], options={"maxiter": 12, "ftol": 1e-6}
        ).x[0])
        for start in (0.06, 0.45, 0.69)
    ]  # fmt: skip
    tries.append(("Brent", "none", lambda: minimize_scalar(plain, bounds=SLIPS, method="bounded").x))
    rows = []
    for method, start, search in tries:
        calls[0], began = 0, time.process_time()
        slip = float(search())
        seconds = time.process_time() - began
        rows.append(
            {
                "problem": "slip",
                "method": method,
                "start": start,
                "seconds": seconds,
                "calls": calls[0],
                "found": f"slip {slip:.3f}",
                "unit": "pull power / axle power",
                "network": -plain(slip),
                "solver": solver(round(slip, 3)),
            }
        )
        print(rows[-1], flush=True)
    slips = np.round(np.linspace(*SLIPS, 14), 3)
    curve = [{"slip": slip, "network": -plain(slip), "solver": solver(slip)} for slip in slips]
    return rows, curve


# --- Friction angle and wheel friction from two drives ---------------------------------------------------


class Calibration:
    """Noisy forces of two drives in a soil, and how well some angle and friction agree with them."""

    def __init__(self, problem: Problem, angle: float, friction: float, seed: int) -> None:
        self.problem, self.slips = problem, torch.tensor(DRIVES, dtype=torch.float64)
        true = np.stack([problem.measured(slip, angle, friction) for slip in DRIVES])
        self.size = np.sqrt((true**2).mean((0, 1)))
        noise = np.random.default_rng(seed).normal(size=true.shape)
        self.true, self.loads = true, torch.from_numpy(true + NOISE * self.size * noise)
        self.calls = 0

    def residuals(self, shares: Tensor) -> Tensor:
        """Of angle and friction as shares of their ranges (2,), in units of the forces' size, shape (2, any, 2)."""
        self.calls += 1
        low, high = torch.tensor([ANGLES, FRICTIONS], dtype=torch.float64).T
        angle, friction = low + shares * (high - low)
        return (self.problem.loads(self.slips, angle, friction) - self.loads) / torch.from_numpy(self.size)

    def with_slope(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        shares = torch.tensor(x, requires_grad=True)
        loss = self.residuals(shares).square().mean()
        loss.backward()
        return loss.item(), shares.grad.numpy()

    def plain(self, x: np.ndarray) -> float:
        with torch.no_grad():
            return float(self.residuals(torch.tensor(x)).square().mean())

    def deviations(self, x: np.ndarray, of_network: np.ndarray) -> np.ndarray:
        """Standard deviations of both shares (2,): those of noise and network, with the covariance that the network's
        own errors give on runs that it has not seen (2, 2).

        Errors of a force last for some frames, so that frames are not independent: cov = H⁻¹ (Σ g gᵀ) H⁻¹ with H = JᵀJ
        and g = Jᵀ(error) of every block of frames (Gauss-Newton).
        """
        with torch.no_grad():
            error = self.residuals(torch.tensor(x)).numpy()  # of drives, frames and loads
        jacobian = sensitivity(self.residuals, x)
        scores = np.einsum("dfl,dflj->dfj", error, jacobian)
        count = scores.shape[1] // BLOCK
        blocks = scores[:, : count * BLOCK].reshape(-1, BLOCK, 2).sum(1)
        flat = jacobian.reshape(-1, 2)
        inverse = np.linalg.inv(flat.T @ flat)
        return np.sqrt(np.diag(inverse @ (blocks.T @ blocks) @ inverse + of_network))


def sensitivity(residuals: Callable[[Tensor], Tensor], x: np.ndarray, step: float = 0.02) -> np.ndarray:
    """Change of residuals with both shares, shape (..., 2); with two numbers differences are quicker than gradients."""
    columns = []
    for axis in np.eye(2):
        low, high = (np.clip(x + sign * step * axis, 0.0, 1.0) for sign in (-1, 1))
        with torch.no_grad():
            change = residuals(torch.tensor(high)) - residuals(torch.tensor(low))
        columns.append(change.numpy() / (high - low).sum())
    return np.stack(columns, -1)


def errors_of_network(problem: Problem) -> np.ndarray:
    """Covariance of both shares (2, 2) that the network's errors give for one drive, of the runs it was not fitted on:
    how far each run moves the best shares from the true ones."""
    dataset = Dataset.open(Path("data/inverse_wheel"))
    low, high = torch.tensor([ANGLES, FRICTIONS], dtype=torch.float64).T
    moved = []
    for file in dataset.runs("validation") + dataset.runs("test"):
        with Run(file) as run:
            scene, true = (
                run.scene,
                np.stack([run.force[:, 0], run.torque[:, 1]], -1)[problem.driving.numpy()],
            )
        slip = torch.tensor([scene["slip"]], dtype=torch.float64)
        size = torch.from_numpy(np.sqrt((true**2).mean(0)))

        def residuals(
            shares: Tensor, slip: Tensor = slip, true: np.ndarray = true, size: Tensor = size
        ) -> Tensor:
            angle, friction = low + shares * (high - low)
            return (problem.loads(slip, angle, friction)[0] - torch.from_numpy(true)) / size

        x = (np.array([scene["friction_angle"], scene["friction"]]) - low.numpy()) / (high - low).numpy()
        with torch.no_grad():
            error = residuals(torch.tensor(x)).numpy()
        jacobian = sensitivity(residuals, x).reshape(-1, 2)
        moved.append(np.linalg.lstsq(jacobian, -error.flatten(), rcond=None)[0])
    print("what the network's errors do to the shares:", np.round(moved, 3).tolist(), flush=True)
    return np.einsum("ni,nj->ij", moved, moved) / len(moved)


class OutOfTimeError(Exception):
    """The other method has had as long."""


def evolved(calibration: Calibration, seconds: float, start: Sequence[float]) -> np.ndarray:
    """Differential evolution for so long."""
    best: list[tuple[float, np.ndarray]] = [(np.inf, np.array(start))]
    began = time.process_time()

    def loss(x: np.ndarray) -> float:
        if time.process_time() - began > seconds:
            raise OutOfTimeError
        value = calibration.plain(x)
        if value < best[0][0]:
            best[0] = value, x.copy()
        return value

    try:
        differential_evolution(loss, [(0, 1)] * 2, x0=start, popsize=5, tol=0.0, rng=0, polish=False)
    except OutOfTimeError:
        pass
    return best[0][1]


def calibrated(problem: Problem) -> tuple[list[dict], list[dict]]:
    """Rows of the table, of the first soil that is searched from all starts; and what was found of every soil."""
    low, high = np.array([ANGLES, FRICTIONS]).T
    of_network = errors_of_network(problem) / len(DRIVES)
    rows, soils = [], []
    for number, (angle, friction) in enumerate(SOILS):
        calibration = Calibration(problem, angle, friction, number)
        for name, start in STARTS.items():
            share = (np.array(start) - low) / (high - low)
            for method in ("gradient", "differential evolution"):
                if number != SEARCHED and (name, method) != ("high", "gradient"):
                    continue
                calibration.calls, began = 0, time.process_time()
                if method == "gradient":
                    x = minimize(
                        calibration.with_slope, share, jac=True, method="L-BFGS-B", bounds=[(0, 1)] * 2,
                        options={"maxiter": 12, "ftol": 1e-6},
                    ).x  # fmt: skip
                    allowed = time.process_time() - began
                else:
                    x = evolved(calibration, allowed, share)
                seconds, calls = time.process_time() - began, calibration.calls
                found, deviation = (
                    low + x * (high - low),
                    calibration.deviations(x, of_network) * (high - low),
                )
                soils.append(
                    {
                        "soil": number,
                        "method": method,
                        "start": name,
                        "seconds": seconds,
                        "calls": calls,
                        "loss": calibration.plain(x),
                        "angle_true": angle,
                        "angle": found[0],
                        "angle_deviation": deviation[0],
                        "friction_true": friction,
                        "friction": found[1],
                        "friction_deviation": deviation[1],
                    }
                )
                print(soils[-1], flush=True)
                if number != SEARCHED:
                    continue
                again = np.stack(
                    [problem.measured(s, round(found[0], 2), round(found[1], 3)) for s in DRIVES]
                )
                error = np.sqrt((((again - calibration.true) / calibration.size) ** 2).mean())
                rows.append(
                    {
                        "problem": "calibration",
                        "method": method,
                        "start": name,
                        "seconds": seconds,
                        "calls": calls,
                        "found": f"{found[0]:.1f} +- {deviation[0]:.1f} deg, {found[1]:.3f} +- {deviation[1]:.3f}",
                        "unit": "RMS error / RMS of the loads",
                        "network": np.sqrt(calibration.plain(x)),
                        "solver": error,
                    }
                )
    return rows, soils


def main() -> None:
    torch.set_num_threads(1)
    problem = Problem()
    for name, solved in (("slip", best_slips), ("calibration", calibrated)):
        if sys.argv[1:] and name not in sys.argv[1:]:
            continue
        rows, details = solved(problem)
        write_rows(HERE / {"slip": "slips.csv", "calibration": "soils.csv"}[name], details)
        others = [row for row in read_rows(HERE / "table.csv") if row["problem"] != name]
        write_rows(HERE / "table.csv", [*others, *rows])


if __name__ == "__main__":
    main()
