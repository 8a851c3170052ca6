"""Runs of another simulator become a dataset, and a learned simulator.

python examples/import_runs.py

The other simulator is a toy of thirty lines: a wall pushes soil, which moves the less the farther it is. Put your own
in its place; newton_runs.py does so with Newton. What a run must hold: docs/guides/import.md.
"""

import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np

from sgns import Run, Simulator
from sgns.data.dataset import Dataset

folder = Path("outputs/examples/foreign")
(folder / "arrays").mkdir(parents=True, exist_ok=True)
RATE, SIZE = 60.0, np.array([0.6, 0.3, 0.12])  # frames per second [Hz]; the bin [m]


def toy(depth: float, speed: float) -> dict[str, np.ndarray]:
    """A wall goes down to a depth [m] and forward [m/s] for a second."""
    time = np.arange(61) / RATE
    counts = (24, 12, 6)
    middles = [(np.arange(n) + 0.5) / n * s for n, s in zip(counts, SIZE, strict=True)]
    soil = np.stack(np.meshgrid(*middles, indexing="ij"), axis=-1).reshape(-1, 3) - [0.0, 0.0, SIZE[2]]
    corners = np.array([[x, y, z] for x in (-0.01, 0.01) for y in (-0.1, 0.1) for z in (0.0, 0.2)])
    pose = np.tile([0.1, 0.15, 0.0, 0.0, 0.0, 0.0, 1.0], (len(time), 1))  # x y z [m], quaternion x y z w
    pose[:, 0] += speed * time
    pose[:, 2] = 0.02 - (0.02 + depth) * np.minimum(time / 0.3, 1.0)
    position, force = [soil], [np.zeros(3)]
    for before, here in pairwise(pose):
        last = position[-1]
        ahead = last[:, 0] - here[0]
        near = np.exp(-np.maximum(ahead, 0.0) / 0.05) * (ahead > -0.02) * (last[:, 2] > here[2] - 0.01)
        step = near[:, None] * (here - before)[:3] * [1.0, 0.0, 0.0]
        step[:, 2] += 0.5 * step[:, 0]  # what is pushed rises
        position.append(last + step)
        cut = max(0.0, -here[2])
        force.append(
            np.array([-2e4 * cut**2 - 5.0 * near.sum() * cut, 0.0, 0.3e4 * cut**2])
        )  # by the soil [N]
    return {
        "position": np.array(position),
        "pose": pose,
        "force": np.array(force),
        "time": time,
        "body_points": corners,
    }


cuts = [(depth, speed) for depth in (0.02, 0.03, 0.04, 0.05) for speed in (0.06, 0.08, 0.1)]
for number, (depth, speed) in enumerate(cuts):
    np.savez(folder / "arrays" / f"cut_{number:02d}.npz", **toy(depth, speed))

fast = "training.noises=[0.1] training.penalties=[0.01]"
for command in (
    f"import {folder}/arrays/*.npz {folder}/data overwrite=true",
    f"check {folder}/data",
    f"train dataset=imported dataset.path={folder}/data model=polynomial reduction.num_modes=8 {fast} "
    f"training.resume=false output={folder}/learned",
):
    subprocess.run([sys.executable, "-m", "sgns", *command.split()], check=True)

simulator = Simulator.load(folder / "learned" / "best.ckpt")
with Run(Dataset.open(folder / "data").runs("test")[0]) as run:  # a run that the training has not seen
    answer = simulator.rollout(run.pose)
    soil, moved = run.positions(-1)[0], run.positions(-1)[0] - run.positions(0)[0]
    error, still = (float(np.sqrt((part**2).mean())) for part in (answer.soil() - soil, moved))
    force, mean = (
        float(np.sqrt(((part - run.force[1:]) ** 2).mean()))
        for part in (answer.force[1:], simulator.mean_force)
    )
print(f"soil error {1e3 * error:.1f} mm (bed at rest: {1e3 * still:.1f} mm)")
print(f"force error {force:.1f} N (mean force: {mean:.1f} N)")

assert error < 0.3 * still and force < 0.5 * mean
