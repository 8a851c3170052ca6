"""A straightforward MLS-MPM in Taichi on the bin in a case file; prints its rates as JSON. Needs taichi and numpy only.

    python taichi_mpm.py case.npz --law hencky --seconds 5

Same particles, grid, substep, B-splines, APIC transfers, gravity and no-slip walls as mpm_warp, without a body. Laws,
all with constant friction and no stress in tension:

- hencky: deviatoric log strain and ln J, updated to first order in the step without a decomposition;
- svd: log strain from the singular values of the elastic deformation gradient, as in most graphics codes.
"""

from __future__ import annotations

import argparse
import json
import math
import time

import numpy as np
import taichi as ti

PADDING = 3


def make_step(case: dict[str, np.ndarray], law: str, atomic: bool):
    """A function that advances the case's bed by one substep."""
    n, h, dt = len(case["position"]), float(case["spacing"]), float(case["dt"])
    cells = [math.ceil(s / h - 1e-6) for s in case["size"]]
    size, headroom = [float(s) for s in case["size"]], float(case["headroom"])
    shape = [c + 2 * PADDING + 1 for c in (cells[0], cells[1], math.ceil((size[2] + headroom) / h))]
    origin = ti.Vector([0.5 * (s - c * h) - PADDING * h for s, c in zip(size, cells, strict=True)])
    origin[2] = -size[2] - PADDING * h
    volume, mass = float(case["volume"]), float(case["volume"] * case["density"])
    youngs, nu = float(case["youngs_modulus"]), float(case["poissons_ratio"])
    shear, bulk = youngs / (2 * (1 + nu)), youngs / (3 * (1 - 2 * nu))
    root_two = math.sqrt(2.0)
    friction, drop = float(case["friction"]), 9.81 * dt
    low, high_x, high_y = PADDING, PADDING + cells[0], PADDING + cells[1]

    x, v = ti.Vector.field(3, ti.f32, n), ti.Vector.field(3, ti.f32, n)
    c, e = ti.Matrix.field(3, 3, ti.f32, n), ti.Matrix.field(3, 3, ti.f32, n)
    ln_j = ti.field(ti.f32, n)
    node = ti.Vector.field(4, ti.f32, shape)
    unit = ti.Matrix([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])

    @ti.func
    def returned(trial, ln_volume):
        # Deviatoric strain after the Drucker-Prager return.
        size, result = trial.norm(), trial
        if ln_volume >= 0.0:
            result *= 0.0
        else:
            limit = -friction * bulk * ln_volume / (root_two * shear)
            if size > limit:
                result *= limit / size
        return result

    @ti.kernel
    def clear():
        for i in ti.grouped(node):
            node[i] = ti.Vector.zero(ti.f32, 4)

    @ti.kernel
    def to_grid():
        for p in x:
            g = (x[p] - origin) / h
            base = (g - 0.5).cast(int)
            f = g - base
            w = [0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2]
            stress = ti.Matrix.zero(ti.f32, 3, 3)
            if ti.static(law == "hencky"):
                if ln_j[p] < 0.0:
                    stress = 2.0 * shear * e[p] + bulk * ln_j[p] * unit
            else:
                # e holds F - I, and the return has been done, so F has the elastic strain.
                u, s, _ = ti.svd(unit + e[p])
                log = ti.Vector([ti.log(s[0, 0]), ti.log(s[1, 1]), ti.log(s[2, 2])])
                tau = 2.0 * shear * log + (bulk - 2.0 / 3.0 * shear) * log.sum()
                stress = u @ ti.Matrix([[tau[0], 0, 0], [0, tau[1], 0], [0, 0, tau[2]]]) @ u.transpose()
            affine = mass * c[p] - dt * volume * 4.0 / h**2 * stress
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                arm = (ti.Vector([i, j, k]) - f) * h
                momentum = mass * v[p] + affine @ arm
                weight = w[i][0] * w[j][1] * w[k][2]
                amount = weight * ti.Vector([momentum[0], momentum[1], momentum[2], mass])
                at = base + ti.Vector([i, j, k])
                if ti.static(atomic):
                    node[at] += amount
                else:
                    node[at] = node[at] + amount

    @ti.kernel
    def on_grid():
        for i, j, k in node:
            m = node[i, j, k][3]
            if m > 0.0:
                u = node[i, j, k] / m
                u[2] -= drop
                if i <= low or j <= low or k <= low or i >= high_x or j >= high_y:
                    u *= 0.0
                node[i, j, k] = u

    @ti.kernel
    def to_particles():
        for p in x:
            g = (x[p] - origin) / h
            base = (g - 0.5).cast(int)
            f = g - base
            w = [0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2]
            new_v = ti.Vector.zero(ti.f32, 3)
            new_c = ti.Matrix.zero(ti.f32, 3, 3)
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                arm = ti.Vector([i, j, k]) - f
                weight = w[i][0] * w[j][1] * w[k][2]
                u = node[base + ti.Vector([i, j, k])]
                here = weight * ti.Vector([u[0], u[1], u[2]])
                new_v += here
                new_c += 4.0 / h * here.outer_product(arm)
            v[p], c[p] = new_v, new_c
            x[p] += dt * new_v
            a = dt * new_c
            if ti.static(law == "hencky"):
                d, spin = 0.5 * (a + a.transpose()), 0.5 * (a - a.transpose())
                ln_j[p] += a.trace()
                trial = e[p] + d - a.trace() / 3.0 * unit + spin @ e[p] - e[p] @ spin
                e[p] = returned(trial, ln_j[p])
            else:
                u, s, r = ti.svd((unit + a) @ (unit + e[p]))
                log = ti.Vector([ti.log(s[0, 0]), ti.log(s[1, 1]), ti.log(s[2, 2])])
                ln_j[p] += a.trace()
                kept = returned(log - log.sum() / 3.0, ln_j[p]) + ti.min(ln_j[p], 0.0) / 3.0
                scaled = ti.Matrix(
                    [[ti.exp(kept[0]), 0, 0], [0, ti.exp(kept[1]), 0], [0, 0, ti.exp(kept[2])]]
                )
                e[p] = u @ scaled @ r.transpose() - unit

    x.from_numpy(case["position"].astype(np.float32))
    start = (case["density"] * 9.81 * case["position"][:, 2] / bulk).astype(np.float32)
    ln_j.from_numpy(start)
    if law == "svd":
        e.from_numpy((np.exp(start / 3.0) - 1.0)[:, None, None] * np.eye(3, dtype=np.float32))

    def step() -> None:
        clear()
        to_grid()
        on_grid()
        to_particles()

    return step


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("case")
    parser.add_argument("--law", choices=["hencky", "svd"], default="hencky")
    parser.add_argument("--atomic", action="store_true", help="atomic sums, Taichi's default for +=")
    parser.add_argument("--seconds", type=float, default=5.0)
    options = parser.parse_args()
    ti.init(arch=ti.cpu, cpu_max_num_threads=1, default_fp=ti.f32, log_level=ti.ERROR)
    case = dict(np.load(options.case))
    step = make_step(case, options.law, options.atomic)
    n, block = len(case["position"]), max(1, round(1e7 / len(case["position"])))
    begin, warm = time.process_time(), 0
    while warm < 3 or time.process_time() - begin < 0.3 * options.seconds:
        step()
        warm += 1
    rates, stop = [], time.process_time() + options.seconds
    while len(rates) < 3 or time.process_time() < stop:
        begin = time.process_time()
        for _ in range(block):
            step()
        rates.append(n * block / (time.process_time() - begin))
    version = "taichi " + ".".join(str(i) for i in ti.__version__)
    print(json.dumps({"version": version, "particles": n, "rates": rates}))


if __name__ == "__main__":
    main()
