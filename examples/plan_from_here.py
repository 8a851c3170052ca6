"""Plan from where the tool is: try 200 ways to go on, drive the best one.

python examples/plan_from_here.py
"""

import numpy as np

from mpm_warp import Scene
from sgns import Simulator

simulator = Simulator.pretrained("excavation")
scene = Scene.from_dict(simulator.scene)
poses = scene.body_poses()[:61]
simulator.reset(scene)
for pose in poses[1:]:  # the first second of a cut
    state = simulator.step(pose)
here = simulator.save()

# 200 ways through the next second: forward speed [m/s] and how much deeper the blade goes [m].
rng = np.random.default_rng(0)
time = np.arange(61) / simulator.frame_rate
speed, deeper = rng.uniform(0.04, 0.18, 200), rng.uniform(0.0, 0.05, 200)
paths = np.tile(here.pose, (200, 61, 1))  # frame 0 is the tool's place now
paths[:, :, 0] += speed[:, None] * time
paths[:, :, 2] -= deeper[:, None] * np.sin(0.5 * np.pi * time) ** 2

answer = simulator.rollouts(paths, start=here)  # all side by side; the simulator stays where it is
motion = np.diff(paths[:, :, :3], axis=1)
work = -(answer.force[:, 1:] * motion).sum((1, 2))  # against the soil [J]
# The modes are orthonormal: the length of their change is that of the displacement of all particles together.
moved = np.linalg.norm(answer.latent[:, -1] - here.latent, axis=(1, 2))
known = answer.outside < 0.05  # paths that are like those of the training
worth = np.where(known, moved / np.maximum(work, 1.0), 0.0)
best = int(worth.argmax())
print(
    f"{known.sum()} of 200 paths are known, computed in {answer.wall_time_s:.1f} s; best: "
    f"{100 * speed[best]:.1f} cm/s, {100 * deeper[best]:.1f} cm deeper, {work[best]:.1f} J"
)

simulator.restore(here)  # not needed here: nothing was stepped in between
driven = [simulator.step(pose) for pose in paths[best, 1:]]
force = np.array([state.force for state in driven])
x, y, z = driven[-1].surface(0.01)  # heights in cells of 1 cm [m]
print(f"the heap is {100 * np.nanmax(z):.1f} cm high")

assert known.sum() > 20 and worth[best] > 1.2 * np.median(worth[known])
assert np.abs(force - answer.force[best, 1:]).max() < 1e-3 * np.abs(force).max()
