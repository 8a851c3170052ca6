"""Cuts computed by Newton (pip install newton) become a dataset, and a learned simulator.

python examples/newton_runs.py     # three minutes of one core, two of them Newton's kernels
"""

import subprocess
import sys
from pathlib import Path

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverImplicitMPM

from mpm_warp.poses import in_world_frame
from sgns import Run, Simulator
from sgns.data.dataset import Dataset

folder = Path("outputs/examples/newton")
(folder / "arrays").mkdir(parents=True, exist_ok=True)
SIZE, CELL, RATE, SUBSTEPS = (
    np.array([0.6, 0.3, 0.12]),
    0.02,
    60.0,
    2,
)  # bin, particle spacing [m]; frames per second
HALF = np.array([0.03, 0.08, 0.08])  # of the box that cuts [m]
CORNERS = HALF * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


def box(
    builder: newton.ModelBuilder, body: int, place: np.ndarray, half: np.ndarray, friction: float
) -> None:
    shape = newton.ModelBuilder.ShapeConfig(mu=friction, density=1000.0)
    frame = wp.transform(wp.vec3(*place.tolist()), wp.quat_identity())
    builder.add_shape_box(body, xform=frame, hx=half[0], hy=half[1], hz=half[2], cfg=shape)


def cut(depth: float, speed: float, seconds: float = 0.8) -> dict[str, np.ndarray]:
    """A box goes down to a depth [m] and forward [m/s]."""
    time = np.arange(round(seconds * RATE) + 1) / RATE
    pose = np.tile([0.12, 0.15, 0.0, 0.0, 0.0, 0.0, 1.0], (len(time), 1))
    pose[:, 0] += speed * time
    pose[:, 2] = HALF[2] + 0.01 - (depth + 0.01) * np.minimum(time / 0.3, 1.0)
    builder = newton.ModelBuilder()
    SolverImplicitMPM.register_custom_attributes(builder)
    counts = np.round(SIZE / CELL).astype(int).tolist()
    builder.add_particle_grid(
        pos=wp.vec3(*(0.5 * CELL - np.array([0.0, 0.0, SIZE[2]])).tolist()),
        rot=wp.quat_identity(),
        vel=wp.vec3(0.0),
        **dict(zip(("dim_x", "dim_y", "dim_z"), counts, strict=True)),
        **dict.fromkeys(("cell_x", "cell_y", "cell_z"), CELL),
        mass=1600.0 * CELL**3,
        jitter=0.0,
        radius_mean=0.5 * CELL,
    )
    tool = builder.add_body(is_kinematic=True)
    box(builder, tool, np.zeros(3), HALF, 0.3)
    for axis, side in ((0, -1), (0, 1), (1, -1), (1, 1), (2, -1)):  # walls and floor
        place, half = 0.5 * SIZE * [1.0, 1.0, -1.0], 0.5 * SIZE + 0.1
        place[axis] += side * (0.5 * SIZE[axis] + 0.1)
        half[axis] = 0.1
        box(builder, -1, place, half, 0.5)
    model = builder.finalize(device="cpu")
    model.set_gravity((0.0, 0.0, -9.81))
    config = SolverImplicitMPM.Config()
    config.voxel_size, config.max_iterations = 2.0 * CELL, 50
    solver = SolverImplicitMPM(model, config=config)
    now, after, dt = model.state(), model.state(), 1.0 / RATE / SUBSTEPS
    arrays: dict[str, list] = {"position": [], "velocity": [], "force": [], "torque": []}
    for frame in range(len(time)):
        load = np.zeros((2, 3))
        for step in range(SUBSTEPS if frame else 0):
            before, here = pose[frame - 1], pose[frame]
            at = before + (here - before) * (step + 1) / SUBSTEPS
            for state in (now, after):
                state.body_q.assign(at[None].astype("f4"))
                state.body_qd.assign(np.append((here - before)[:3] * RATE, [0.0] * 3)[None].astype("f4"))
            solver.step(now, after, None, None, dt)
            impulse, point, collider = (each.numpy() for each in solver.collect_collider_impulses(after))
            ours = (collider >= 0) & (solver.collider_body_index.numpy()[np.maximum(collider, 0)] == tool)
            load += [impulse[ours].sum(0), np.cross(point[ours] - at[:3], impulse[ours]).sum(0)]
            solver.project_outside(after, after, dt)
            now, after = after, now
        found = now.particle_q.numpy().copy(), now.particle_qd.numpy().copy(), *(RATE * load)
        for name, values in zip(arrays, found, strict=True):
            arrays[name].append(values)
    return {name: np.array(values) for name, values in arrays.items()} | {
        "time": time,
        "pose": pose,
        "body_points": CORNERS,
    }


cuts = [(depth, speed) for depth in (0.02, 0.04, 0.06) for speed in (0.1, 0.2, 0.3)]
for number, (depth, speed) in enumerate(cuts):
    if not (file := folder / "arrays" / f"cut_{number}.npz").exists():
        np.savez(file, **cut(depth, speed))
fast = "training.noises=[0.3] training.penalties=[0.01]"
for command in (
    f"import {folder}/arrays/*.npz {folder}/data overwrite=true",
    f"train dataset=imported dataset.path={folder}/data model=polynomial reduction.num_modes=4 {fast} "
    f"training.resume=false output={folder}/learned",
):
    subprocess.run([sys.executable, "-m", "sgns", *command.split()], check=True)

simulator = Simulator.load(folder / "learned" / "best.ckpt")
with Run(Dataset.open(folder / "data").runs("test")[0]) as run:  # a cut that the training has not seen
    answer = simulator.rollout(run.pose)
    truth, start = run.positions(-1)[0], run.positions(0)[0]
    error, still = (float(np.sqrt((part**2).mean())) for part in (answer.soil() - truth, truth - start))
    force, mean = (
        float(np.sqrt(((part - run.force[1:]) ** 2).mean()))
        for part in (answer.force[1:], simulator.mean_force)
    )
    assert np.allclose(run.body_points, in_world_frame(run.pose, CORNERS))
print(f"soil error {1e3 * error:.1f} mm (bed at rest: {1e3 * still:.1f} mm)")
print(f"force error {force:.1f} N (mean force: {mean:.1f} N)")
print(f"one step takes {1e3 * answer.wall_time_s / len(answer.force):.2f} ms")

assert error < still and force < mean
