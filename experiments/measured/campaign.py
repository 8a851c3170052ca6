"""Runs the solver on the measured conditions, a row of ours.csv for each; begun again it goes on where it stopped.

    python experiments/measured/campaign.py STUDY [key=value ...]

STUDY: `fix` (the three conditions that fix parameters; with keys of Setting to try), `judged` (32 of the 63 conditions
with every slip angle and rim speed, then the rest; stop it when it is enough), `repeated` (those after a change of the
solver), `speed`, `grid`, `particles` (two
conditions each); of the larger wheel `larger` (six conditions, in a smaller bin, so on a finer grid), `larger_grid`
(coarser; then in the small wheel's setting), `larger_soil` (one condition, a stronger soil without and with cohesion).
`count=N` stops after N conditions, `workers=N` runs so many at once.
"""

from __future__ import annotations

import csv
import math
import multiprocessing
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np

sys.path.insert(1, str(Path(__file__).resolve().parents[1]))

from common import read_rows, scene_of
from conditions import SLIPS, SMALL, TRAVEL, Condition, cmu, ding

from mpm_warp import Effects, Scene, Solver
from mpm_warp.motions import along_and_across

OURS = Path(__file__).parent / "ours.csv"
FASTEST_RIM = 0.3  # a faster one would throw soil, which the trials' do not [m/s]
GRAIN_DENSITY = 2650.0  # quartz [kg/m^3]


@dataclass(frozen=True)
class Setting:
    """What the tables do not say, and how finely it is computed. The defaults are the campaign's."""

    wheel_friction: float = 0.35
    """Of smooth metal: tan(2/3 of the soil's angle)."""
    friction_map: str = "tan"
    friction_excess: float = 2.0
    """Of the soil, above its angle of repose [degrees]: fixed, so that the rolling wheel sinks as deep as measured."""
    stiffness: float = 5.0e5
    """[Pa]"""
    grid: float = 0.012
    """Of the small wheel; in proportion for the large one [m]."""
    per_cell: float = 4.0
    speed: float = 0.2
    """Of travel, where the rim is not too fast for it; the trials had 0.01 [m/s]."""
    travel: float = 0.4
    """Of the small wheel where it pushes soil, 0.6 of it where it only rolls; the last quarter is averaged [m]."""
    room: float = 1.0
    """Of the soil behind, ahead, beside and below the wheel; 1 is 2.5, 4.5, 2 and 2.5 radii."""
    cohesion: float = 0.0
    """Share of what the soil's authors give."""


LARGER = Setting(wheel_friction=0.39, friction_excess=0.0, grid=0.004, travel=0.15, room=0.3)
"""Of the larger wheel: its soil's angle of friction is measured, so none is added to it; it sinks little."""

STUDIES: dict[str, list[Setting]] = {
    "fix": [Setting()],
    "judged": [Setting()],
    "repeated": [Setting()],
    "speed": [Setting(speed=speed) for speed in (0.1, 0.05)],
    "grid": [Setting(grid=grid) for grid in (0.016, 0.012, 0.008)],
    "particles": [Setting(per_cell=n) for n in (1.0, 8.0)],
    "larger": [LARGER],
    "larger_grid": [replace(LARGER, grid=0.006), Setting()],
    "larger_soil": [
        replace(LARGER, grid=0.006, wheel_friction=0.35, friction_excess=2.0, cohesion=c) for c in (0.0, 1.0)
    ],
}


def chosen(study: str) -> list[Condition]:
    """The conditions of a study, in the order in which they are run."""
    small = cmu()
    angles = sorted({c.slip_angle for c in small})
    if study in ("judged", "repeated"):
        even = [c for c in small if (angles.index(c.slip_angle) + SLIPS.index(c.slip)) % 2 == 0]
        mixed = [c for first in range(3) for c in even[first::3]]
        return mixed + [c for c in small if c not in even]
    if study == "fix":
        return [c for c in small if c.fixed]
    if study.startswith("larger"):
        return [c for c in ding() if study != "larger_soil" or c.slip == 0.4]
    return [c for c in small if (c.slip_angle, c.slip) in ((0.0, 0.5), (45.0, -0.5))]


def scene_for(condition: Condition, setting: Setting) -> tuple[Scene, Effects]:
    """The wheel in a bin, with the effects that the solver decides on."""
    wheel, soil, radius = condition.wheel, condition.soil, condition.wheel.radius
    larger = radius / SMALL.radius
    speed = min(setting.speed, FASTEST_RIM * TRAVEL / max(condition.rim_speed, 1e-9))
    pushes = condition.slip <= 0.0 or condition.slip_angle >= 60.0
    travel = larger * setting.travel * (1.0 if pushes else 0.6)
    spacing = larger * setting.grid
    across = wheel.width * math.cos(condition.angle) + 2.0 * radius * math.sin(condition.angle)
    room = setting.room * radius
    length = travel + 7.0 * room
    cells = [round(side / spacing) for side in (length, across + 4.0 * room, 2.5 * room)]
    settle = 0.5
    overrides = {
        "diameter": 2.0 * radius,
        "width": wheel.width,
        "friction": setting.wheel_friction,
        "load": condition.load,
        "slip_angle": condition.slip_angle,
        "travel_speed": speed,
        "rim_speed": condition.rim_speed * speed / TRAVEL,
        "friction_angle": soil.friction_angle + setting.friction_excess,
        "settle": settle,
        "duration": settle + travel / speed,
        "start": 2.5 * room / length,
        "frame_rate": 30.0,
        "bed.size": "[" + ",".join(f"{count * spacing:.6g}" for count in cells) + "]",
        "bed.spacing": spacing,
        "bed.particles_per_cell": setting.per_cell,
        "bed.headroom": 1.6 * radius,
    }
    material = {
        "youngs_modulus": setting.stiffness,
        "grain_density": GRAIN_DENSITY,
        "packing": soil.density / GRAIN_DENSITY,
        "friction_map": setting.friction_map,
        "cohesion": setting.cohesion * soil.cohesion,
    }
    words = [f"scene.{key}={value}" for key, value in overrides.items()]
    return scene_of("scene=wheel", *words, *(f"material.{key}={value}" for key, value in material.items()))


def solved(condition: Condition, setting: Setting) -> dict[str, float]:
    """Forces, torque and sinkage over the last quarter of the travel, and the sinkage's change from the one before."""
    scene, effects = scene_for(condition, setting)
    started = time.perf_counter()
    frames = list(Solver(scene, replace(effects, torque=True)).frames())
    sinkage = scene.sinkage(np.array([f.body_pose for f in frames]))
    before, end = slice(len(frames) // 2, 3 * len(frames) // 4), slice(3 * len(frames) // 4, None)
    force, torque = (np.array([getattr(f, name) for f in frames[end]]) for name in ("force", "torque"))
    fx, fy, fz = along_and_across(vars(scene), force.mean(axis=0))
    return {
        "fx": float(fx),
        "fy": float(fy),
        "sinkage": float(sinkage[end].mean()),
        "torque": -float(along_and_across(vars(scene), torque.mean(axis=0))[1]),
        "fz": float(fz),
        "sinking": float(sinkage[end].mean() - sinkage[before].mean()),
        "seconds": time.perf_counter() - started,
    }


def written(row: dict) -> dict[str, str]:
    return {key: f"{value:.6g}" if isinstance(value, float) else str(value) for key, value in row.items()}


def named(study: str, condition: Condition, setting: Setting) -> dict[str, str]:
    """What tells a row of ours.csv from the others."""
    what = {"source": condition.source, "slip_angle": condition.slip_angle, "slip": condition.slip}
    return written({"study": study, **what, "rim_speed": condition.rim_speed, **asdict(setting)})


def append(row: dict[str, str], file: Path) -> None:
    """Add a row; the first one makes the file."""
    new = not file.exists()
    with file.open("a", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, list(row), lineterminator="\n")
        if new:
            writer.writeheader()
        writer.writerow(row)


def missing(study: str, settings: list[Setting], file: Path) -> list[tuple[dict, Condition, Setting]]:
    """What a study asks for and the file has not yet."""
    rows = read_rows(file)
    asked = [(named(study, c, s), c, s) for s in settings for c in chosen(study)]
    return [one for one in asked if not any(one[0].items() <= row.items() for row in rows)]


def main(study: str, *words: str) -> None:
    given = dict(word.split("=", 1) for word in words)
    count, workers = (int(given.pop(key, default)) for key, default in (("count", "999"), ("workers", "1")))
    types = {f.name: str if f.type == "str" else float for f in fields(Setting)}
    changed = {key: types[key](value) for key, value in given.items()}
    todo = missing(study, [replace(s, **changed) for s in STUDIES[study]], OURS)[:count]
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        runs = {pool.submit(solved, c, s): name for name, c, s in todo}
        for run in as_completed(runs):
            row = runs[run] | written(run.result())
            append(row, OURS)
            print(*(f"{key}={value}" for key, value in row.items()), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
