"""Choose among 100 paths with a learned simulator: the most soil moved for the least energy.

python examples/train_and_step.py       # makes the simulator
python examples/best_of_100_paths.py
"""

from dataclasses import replace

import numpy as np

from mpm_warp import Scene
from sgns import Simulator

simulator = Simulator.load("outputs/examples/learned/best.ckpt")
scene = Scene.from_dict(simulator.scene)
rng = np.random.default_rng(0)
choices = [(rng.uniform(0.04, 0.10), rng.uniform(0.08, 0.15)) for _ in range(100)]  # depth [m], speed [m/s]
poses = np.stack([replace(scene, depth=d, speed=v).body_poses() for d, v in choices])

answer = simulator.rollouts(poses)  # all paths side by side
motion = np.diff(poses[:, :, :3], axis=1)
energy = -(answer.force[:, 1:] * motion).sum((1, 2))  # work against the soil [J]
# The modes are orthonormal: the length of their change is that of the displacement of all particles together.
moved = np.linalg.norm(answer.latent[:, -1] - answer.latent[:, 0], axis=(1, 2))
worth = moved / np.maximum(energy, 1.0)
best = int(worth.argmax())
depth, speed = choices[best]
print(
    f"best of {len(poses)} in {answer.wall_time_s:.2f} s: depth {100 * depth:.1f} cm at {100 * speed:.0f} cm/s"
)
print(f"it needs {energy[best]:.1f} J; the others {np.median(energy):.1f} J (median)")

assert np.isfinite(answer.force).all()
assert worth[best] > 1.2 * np.median(worth)
