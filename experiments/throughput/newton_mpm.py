"""Newton's implicit MPM on the bin in a case file; prints its times as JSON. Needs `newton` and numpy only.

    python newton_mpm.py case.npz --iterations 50

One implicit step per frame. The bin is five planes, the blade a kinematic box that follows the case's poses.
"""

from __future__ import annotations

import argparse
import json
import time

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverImplicitMPM

WARM, FRAMES = 5, 5  # frames before and in the timing


def build(case: dict[str, np.ndarray]) -> newton.Model:
    """Soil, walls and blade with the case's elastic constants and friction; no rate dependence."""
    builder = newton.ModelBuilder()
    SolverImplicitMPM.register_custom_attributes(builder)
    n = len(case["position"])
    builder.add_particles(
        pos=case["position"].tolist(),
        vel=[(0.0, 0.0, 0.0)] * n,
        mass=[float(case["volume"] * case["density"])] * n,
        radius=[0.5 * float(case["volume"]) ** (1.0 / 3.0)] * n,
    )
    lx, ly, lz = (float(s) for s in case["size"])
    rough = newton.ModelBuilder.ShapeConfig(mu=1.0)
    for plane in ((0, 0, 1, lz), (1, 0, 0, 0), (-1, 0, 0, lx), (0, 1, 0, 0), (0, -1, 0, ly)):
        builder.add_shape_plane(tuple(float(v) for v in plane), width=0.0, length=0.0, cfg=rough)
    pose = case["poses"][0]
    body = builder.add_body(xform=wp.transform(pose[:3], pose[3:]), is_kinematic=True)
    hx, hy, hz = (float(s) for s in case["half_size"])
    blade = newton.ModelBuilder.ShapeConfig(mu=float(case["body_friction"]), density=1000.0)
    builder.add_shape_box(body, hx=hx, hy=hy, hz=hz, cfg=blade)
    model = builder.finalize(device="cpu")
    model.set_gravity((0.0, 0.0, -9.81))
    model.mpm.young_modulus.fill_(float(case["youngs_modulus"]))
    model.mpm.poisson_ratio.fill_(float(case["poissons_ratio"]))
    model.mpm.friction.fill_(float(case["friction"]))
    return model


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("case")
    parser.add_argument("--iterations", type=int, default=250, help="at most, per step")
    options = parser.parse_args()
    wp.config.quiet = True
    case = dict(np.load(options.case))
    model = build(case)
    config = SolverImplicitMPM.Config()
    config.voxel_size = float(case["spacing"])
    config.max_iterations = options.iterations
    config.collider_velocity_mode = "backward"
    solver = SolverImplicitMPM(model, config=config)
    state, after = model.state(), model.state()
    frame_time, times = 1.0 / float(case["frame_rate"]), []
    for frame in range(WARM + FRAMES):
        state.body_q.assign(case["poses"][frame + 1][None].astype(np.float32))
        begin = time.process_time()
        solver.step(state, after, None, None, frame_time)
        solver.project_outside(after, after, frame_time)
        times.append(time.process_time() - begin)
        state, after = after, state
    found = {
        "version": f"newton {newton.__version__}, warp {wp.__version__}",
        "particles": len(case["position"]),
    }
    print(json.dumps(found | {"s_per_simulated_s": [t / frame_time for t in times[WARM:]]}))


if __name__ == "__main__":
    main()
