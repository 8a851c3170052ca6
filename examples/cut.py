"""A blade cuts sand: the solver in Python, frame by frame.

python examples/cut.py
"""

from mpm_warp import Bed, Excavation, Plate, Solver

# A coarse grid, for a few seconds of computing. The blade must be at least two grid spacings thick.
scene = Excavation(
    bed=Bed(size=(0.8, 0.6, 0.16), spacing=0.04),
    blade=Plate(thickness=0.084),
    depth=0.08,
    speed=0.2,
    duration=1.5,
)
for warning in scene.warnings():
    print("warning:", warning)
draft, energy = [], 0.0
for frame in Solver(scene).frames():
    draft.append(-frame.force[0])  # soil that resists pushes the blade back, towards -x
    energy += draft[-1] * scene.speed / scene.frame_rate
print(f"largest draft {max(draft):.0f} N, energy of the cut {energy:.0f} J, {len(draft)} frames")

assert max(draft) > 100 and energy > 0
