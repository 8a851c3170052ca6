"""A bucket of your own (a mesh file) on a path of your own (a CSV file).

python examples/bucket_on_a_path.py
"""

import csv
import subprocess
import sys
from pathlib import Path

import numpy as np

from sgns import Run

folder = Path("outputs/examples")
folder.mkdir(parents=True, exist_ok=True)

# A bucket seen from the side, in millimetres: an L with walls 100 mm thick, extruded along y. Corners anticlockwise.
side = np.array([(0, 0), (300, 0), (300, 100), (100, 100), (100, 250), (0, 250)])
triangles = [(0, 1, 2), (0, 2, 3), (0, 3, 5), (3, 4, 5)]  # of the side
n = len(side)
corners = [(x, y, z) for y in (-150, 150) for x, z in side]
faces = [*triangles, *((c + n, b + n, a + n) for a, b, c in triangles)]
for i in range(n):
    j = (i + 1) % n
    faces += [(j, i, i + n), (j, i + n, j + n)]
with open(folder / "bucket.obj", "w") as file:
    file.writelines(f"v {x} {y} {z}\n" for x, y, z in corners)
    file.writelines(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in faces)

# Its centre of mass goes down into the soil (the surface is at z = 0), then forward. It does not turn.
path = [(0.0, 0.25, 0.12), (0.4, 0.25, 0.075), (1.2, 0.45, 0.075)]  # t [s], x, z [m]
with open(folder / "path.csv", "w", newline="") as file:
    rows = csv.writer(file)
    rows.writerow("t x y z qx qy qz qw".split())
    rows.writerows((t, x, 0.3, z, 0, 0, 0, 1) for t, x, z in path)

command = f"""simulate scene=body scene/tool=mesh scene.tool.file={folder}/bucket.obj scene.tool.unit=mm
    scene.path={folder}/path.csv scene.bed.size=[0.8,0.6,0.16] scene.bed.spacing=0.04 scene.duration=1.2
    output={folder}/bucket.h5"""
subprocess.run([sys.executable, "-m", "sgns", *command.split()], check=True)

with Run(folder / "bucket.h5") as run:
    forward = run.force[run.time > 0.5, 0].mean()
    print(
        f"mean force while it moves forward: {forward:.0f} N along x; largest {np.abs(run.force).max():.0f} N"
    )
    moved = np.linalg.norm(run.positions(-1)[0] - run.positions(0)[0], axis=1)
    print(f"{(moved > 0.02).mean():.0%} of the soil moved more than 2 cm")

assert forward < -10 and (moved > 0.02).any()
