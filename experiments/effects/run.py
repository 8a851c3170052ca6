"""Each effect on and off in five scenes: what it costs, what it changes, and whether effects=auto decides well.

    python experiments/effects/run.py

Appends to table.csv (each effect) and edge.csv (rate dependence and nonlocality for grains of several sizes) beside
this script; rows that are there are not made again. Then draws effects.png. About fifteen minutes on one core.
"""

from __future__ import annotations

import logging
import math
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

sys.path.insert(1, str(Path(__file__).resolve().parents[1]))

import matplotlib.pyplot as plt
import numpy as np
from common import read_rows, scene_of, write_rows

from mpm_warp import Effects, Scene, Solver, Tolerances, asymmetry, effects_for

HERE = Path(__file__).parent
REPEATS = 3
SCENES = {
    # Elastic soil flies.
    "excavation": ["scene=quick_excavation", "scene.duration=1.0", "scene.bed.headroom=0.5"],
    "wheel": ["scene=quick_wheel", "scene.duration=1.0"],
    "column": ["scene=column", "scene.duration=0.4"],
    "incline": ["scene=incline", "scene.duration=0.4"],
    "thin_layer": ["scene=thin_layer", "scene.duration=0.5"],
}
EFFECTS = (
    "yielding", "rate_dependence", "fluidity", "nonlocality", "separation", "cohesion", "symmetry", "torque"
)  # fmt: skip
COHESION = "material.cohesion=1000"  # in the rows of cohesion
GRAINS = (1e-4, 3e-4, 5e-4, 7e-4, 1e-3, 2e-3, 5e-3)  # diameters for edge.csv [m]
AIM = 0.03  # what auto leaves out should change force and displacement by less


def pair(chosen: Effects, effect: str) -> tuple[Effects, Effects]:
    """With `effect` off and on, otherwise what auto chose; what needs the effect is off in both, what it needs on."""
    without = {"fluidity": False, "nonlocality": False} if effect in ("rate_dependence", "yielding") else {}
    if effect == "yielding":
        without |= {"rate_dependence": False}
    needs = {"rate_dependence": True} if effect in ("fluidity", "nonlocality") else {}
    base = replace(chosen, **without)
    return replace(base, **{effect: False}), replace(base, **needs, **{effect: True})


def play(scene: Scene, effects: Effects) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Force at the frames (T, 3), first and last positions (n, 3), and processor time [s]."""
    frames = Solver(scene, effects).frames()
    first = next(frames)
    force, last, start = [], first, time.process_time()
    for frame in frames:
        force.append(frame.force)
        last = frame
    return np.array(force), first.position, last.position, time.process_time() - start


def changes(scene: Scene, one: tuple, two: tuple) -> dict[str, float]:
    """How far two runs are apart: RMS over frames of the force, and over particles of the last position, as shares
    of the RMS force and displacement of the run `one`."""

    def rms(a: np.ndarray) -> float:
        return float(np.sqrt((a.astype(float) ** 2).sum(axis=1).mean()))

    force = rms(two[0] - one[0]) / rms(one[0]) if scene.body is not None else math.nan
    moved = rms(two[2] - one[2]) / rms(one[2] - one[1])
    return {"force_change": force, "displacement_change": moved}


def each_effect(name: str, effect: str) -> dict:
    scene, _ = scene_of(*SCENES[name], *([COHESION] if effect == "cohesion" else []))
    chosen, decisions = effects_for(scene)
    decision = decisions[effect]
    row = {"scene": name, "effect": effect, "auto": "on" if decision.on else "off", "number": decision.number}
    if (effect == "symmetry" and asymmetry(scene)) or (effect == "torque" and scene.body is None):
        return row
    off, on = pair(chosen, effect)
    runs = {side: [] for side in (off, on)}
    for _ in range(REPEATS):  # in turn, so that a machine that slows down slows both
        for side in (off, on):
            runs[side].append(play(scene, side))
    seconds = {side: statistics.median(run[3] for run in runs[side]) for side in (off, on)}
    reference, other = (on, off) if getattr(chosen, effect) else (off, on)
    return row | {
        "time_ratio": seconds[on] / seconds[off],
        **changes(scene, runs[reference][0], runs[other][0]),
        "seconds_off": seconds[off],
        "seconds_on": seconds[on],
    }


def at_the_edge(name: str, effect: str, grain: float) -> dict:
    scene, _ = scene_of(*SCENES[name], f"material.grain_diameter={grain}")
    chosen, decisions = effects_for(scene)
    off, on = (play(scene, side) for side in pair(chosen, effect))
    decision, tolerances = decisions[effect], Tolerances()
    which = next(key for key in ("friction", "grid", "reach") if f"tolerance.{key}" in decision.reason)
    return {
        "scene": name,
        "effect": effect,
        "grain_diameter": grain,
        "auto": "on" if decision.on else "off",
        "tolerance": which,
        "number": decision.number,
        "number_over_tolerance": decision.number / getattr(tolerances, which),
        **changes(scene, off, on),
    }


def resume(
    name: str, keys: tuple[str, ...], jobs: list[tuple], make: Callable[..., dict]
) -> list[dict[str, str]]:
    """Rows of the table `name`, made where they are missing; the file is complete after every one."""
    file = HERE / f"{name}.csv"
    done = {tuple(row[key] for key in keys) for row in read_rows(file)}
    for job in jobs:
        if tuple(f"{part:.4g}" if isinstance(part, float) else part for part in job) not in done:
            row = make(*job)
            logging.info("%s", row)
            write_rows(file, [*read_rows(file), row])
    return read_rows(file)


def largest(row: dict[str, str]) -> float:
    """The larger of both changes; nan where there is none."""
    return float(np.fmax(*(float(row[key] or "nan") for key in ("force_change", "displacement_change"))))


def draw(table: list[dict[str, str]], edge: list[dict[str, str]]) -> None:
    """What effects cost; what they change; and that change against `auto`'s number. Filled: auto turns it on."""
    figure, (cost, change, sizes) = plt.subplots(1, 3, figsize=(15, 5), layout="constrained")
    for number, name in enumerate(SCENES):
        colour = f"C{number}"

        def style(row: dict[str, str], colour: str = colour) -> dict[str, str]:
            return {"color": colour, "mfc": colour if row["auto"] == "on" else "white"}

        for row in (row for row in table if row["scene"] == name):
            place = EFFECTS.index(row["effect"]) + 0.16 * (number - 2)
            ratio = float(row["time_ratio"] or "nan")
            cost.barh(place, ratio - 1.0, 0.15, left=1.0, color=colour)
            change.plot(max(largest(row), 1e-7), place, "o", **style(row))
        for row in (row for row in edge if row["scene"] == name):
            marker = "o" if row["effect"] == "rate_dependence" else "s"
            sizes.plot(float(row["number_over_tolerance"]), largest(row), marker, **style(row))
        sizes.plot([], [], "o", color=colour, label=name)
    for axis in (cost, change):
        axis.set_yticks(range(len(EFFECTS)), EFFECTS)
        axis.invert_yaxis()
        axis.axvline(1.0 if axis is cost else AIM, color="k", ls=":")
    cost.set(xlabel="processor time with the effect / without")
    change.set(xscale="log", xlabel="change of force or displacement, the larger (1e-7: none)")
    sizes.axvline(1.0, color="k", lw=1)
    sizes.axhline(AIM, color="k", ls=":", label=f"aim: {AIM:.0%}")
    sizes.set(xscale="log", yscale="log", ylabel="change of force or displacement, the larger")
    sizes.set_xlabel("auto's number / its tolerance (squares: nonlocality)")
    sizes.legend(fontsize=8)
    figure.savefig(HERE / "effects.png", dpi=100)


def main() -> None:
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    jobs = [(name, effect) for name in SCENES for effect in EFFECTS]
    table = resume("table", ("scene", "effect"), jobs, each_effect)
    jobs = [
        (name, effect, grain)
        for name in ("excavation", "wheel", "column", "incline")
        for effect in ("rate_dependence", "nonlocality")
        for grain in GRAINS
    ]
    edge = resume("edge", ("scene", "effect", "grain_diameter"), jobs, at_the_edge)
    draw(table, edge)


if __name__ == "__main__":
    main()
