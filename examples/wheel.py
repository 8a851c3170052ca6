"""A wheel under load sinks in, then drives with slip: sinkage and drawbar pull.

python examples/wheel.py
"""

from dataclasses import replace

import numpy as np

from mpm_warp import Bed, Solver, Wheel

driven = Wheel(
    bed=Bed(size=(0.40, 0.20, 0.08), spacing=0.02),
    load=60.0,
    slip=0.4,
    rim_speed=0.06,
    settle=0.4,
    duration=1.6,
)
pull, sinkage = {}, {}
for load in (30.0, 60.0):
    frames = [(f.time, f.force[0], f.body_pose[2]) for f in Solver(replace(driven, load=load)).frames()]
    time, force, height = np.array(frames).T
    pull[load] = force[time > 0.8].mean()  # forward force of the soil on the wheel
    sinkage[load] = height[0] - height[-1]
    print(f"load {load:.0f} N: drawbar pull {pull[load]:.1f} N, sinkage {1e3 * sinkage[load]:.1f} mm")

assert 0 < sinkage[30.0] < sinkage[60.0] < 0.05
