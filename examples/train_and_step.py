"""From nothing to a learned simulator that keeps up with a loop at 60 Hz: simulate, train, step.

    python examples/train_and_step.py

Coarse runs and polynomials in place of a network, for half a minute of computing; `make demo` is the real thing.
"""

import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from mpm_warp import Scene
from sgns import Run, Simulator
from sgns.data.dataset import Dataset

folder = Path("outputs/examples")
coarse = "scene.bed.spacing=0.04 scene.bed.size=[0.8,0.6,0.16] scene.blade.thickness=0.084 scene.duration=1.0"
fast = "training.noises=[0.3] training.penalties=[0.01]"  # one choice of each, not the best of fifteen
dataset = f"dataset=quick dataset.path={folder}/data dataset.runs=8"
for command in (
    f"simulate {dataset} {coarse}",
    f"train {dataset} model=polynomial reduction.num_modes=4 {fast} output={folder}/learned",
):
    subprocess.run([sys.executable, "-m", "sgns", *command.split()], check=True)

simulator = Simulator.load(folder / "learned" / "best.ckpt")
truth = Dataset.open(folder / "data").runs("test")[0]  # a run that the training has not seen
with Run(truth) as run:
    scene, force = Scene.from_dict(run.scene), run.force
simulator.reset(scene)
predicted, seconds = [], []
for pose in scene.body_poses()[1:]:
    began = time.perf_counter()
    state = simulator.step(pose)
    seconds.append(time.perf_counter() - began)
    predicted.append(state.force)
error = np.sqrt(((np.array(predicted) - force[1:]) ** 2).mean())
mean = np.sqrt(((simulator.mean_force - force[1:]) ** 2).mean())
print(f"median step {1e3 * np.median(seconds):.2f} ms, force error {error:.0f} N (mean force: {mean:.0f} N)")

assert np.median(seconds) < 1 / 60 and error < mean
