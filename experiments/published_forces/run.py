"""The published runs, simulated at the published settings and compared with the published forces and sinkages.

    python experiments/published_forces/run.py excavation <folder of the authors' excavation files>
    python experiments/published_forces/run.py wheel <folder of the authors' wheel files>

Makes one run file per case (about 200 MB of a blade, 80 MB of a wheel, in data/<scene>; finished ones are kept), then
a table and a figure beside this script. With `--reference` the same motions on the bed, grid and numerics of
scene=excavation or scene=wheel.
"""

from __future__ import annotations

import argparse
import logging
import sys
from itertools import product
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from omegaconf import OmegaConf

from mpm_warp import Scene, Wheel
from sgns.config import UserError
from sgns.data.run import Run
from sgns.reduction.published import DIAMETERS, PublishedRun, read_published
from sgns.simulate.campaign import Campaign
from sgns.simulate.command import simulate_campaign
from sgns.simulate.scene import asked_effects, scene_from_config

HERE = Path(__file__).parent
sys.path.insert(1, str(HERE.parent))

from common import composed, write_rows  # noqa: E402

WINDOW = 15  # frames of the centred mean: ours are frame means, theirs samples of one substep
FIRST = 10  # the frames before hold the published runs' settling spike; they enter nowhere
RESULT = {  # kind and whether at the reference setting -> names of table and figure
    ("excavation", False): ("table", "histories"),
    ("excavation", True): ("table_excavation", "histories_excavation"),
    ("wheel", False): ("wheel", "wheel"),
    ("wheel", True): ("wheel_reference", "wheel_reference"),
}
PUBLISHED_DAMPING = 500.0  # of the published wheels' height [1/s]
THEIR_WHEEL = (  # what scene=published_wheel has of the wheel and its motion, beside what differs between the cases
    "scene.friction=3",
    "scene.bilateral=true",
    f"scene.damping={PUBLISHED_DAMPING}",
    "scene.settle=4",
    "scene.clearance=0.0132890365",
    "scene.duration=9.3333333333",
)


DEPTHS = (0.02, 0.04, 0.05, 0.08, 0.10)  # [m]
SPEEDS = (0.01, 0.04, 0.08, 0.10, 0.15)  # [m/s]
RAKES = (0.0, 3.8, 10.0, 30.8, 45.0)  # [degrees]
MOTIONS = ("ramp", "curved")
GRAVITIES = (1.62, 3.72, 9.81)  # [m/s^2]
# Forward speeds 15.60, 12.00, 5.85 mm/s at a rim speed of 19.5; named 20, 40, 70 %.
SLIPS = (0.2, 5.0 / 13.0, 0.7)
LOADS = (100.0, 164.0, 225.0)  # [N]
WIDTHS = {0.05: 0.25 / 3, 0.15: 0.25 / 3, 0.30: 0.125}  # of each diameter [m]
ANGLES = (30.0, 37.0, 43.0)  # friction angles [degrees]


def _case(kind: str, case: int, **values: tuple[Any, ...]) -> dict[str, Any]:
    """The combination of values that has this number, counted from 1, the last one changing fastest."""
    grid = list(product(*values.values()))
    if not 1 <= case <= len(grid):
        raise UserError(f"published {kind} case {case}: allowed are 1 to {len(grid)}")
    return dict(zip(values, grid[case - 1], strict=True))


def excavation_case(case: int) -> dict[str, float | str]:
    """Depth [m], speed [m/s], rake [degrees] and motion of a published excavation run, numbered from 1."""
    return _case("excavation", case, depth=DEPTHS, speed=SPEEDS, rake=RAKES, motion=MOTIONS)


def wheel_case(case: int) -> dict[str, float]:
    """Gravity [m/s^2], slip, load [N], diameter [m], friction angle [degrees] and width [m] of a published wheel run,
    numbered from 1. The 5 cm wheel carries a ninth of the loads."""
    values = {"gravity": GRAVITIES, "slip": SLIPS, "load": LOADS, "diameter": DIAMETERS}
    found = _case("wheel", case, **values, friction_angle=ANGLES)
    if found["diameter"] == DIAMETERS[0]:
        found["load"] /= 9.0
    return found | {"width": WIDTHS[found["diameter"]]}


def ripple(run: PublishedRun, scene: Scene) -> dict[str, float]:
    """Frequency of a blade's published vertical force while it moves at its forward speed, of its largest part above
    1.5 Hz, and that at which the blade then reaches grid nodes [Hz]."""
    assert run.case is not None
    speed, rate = float(excavation_case(run.case)["speed"]), scene.frame_rate
    moving = np.abs(rate * np.gradient(run.body_points[:, :, 0].mean(axis=1)) - speed) < 0.02 * speed
    moving[:FIRST] = False
    force = run.force[moving, 2]
    time = np.arange(len(force)) / rate
    swing = np.abs(
        np.fft.rfft((force - np.polyval(np.polyfit(time, force, 3), time)) * np.hanning(len(time)), 4096)
    )
    frequency = np.fft.rfftfreq(4096, 1.0 / rate)
    swing[frequency <= 1.5] = 0.0
    return {"case": run.case, "ripple": float(frequency[swing.argmax()]), "nodes": speed / scene.bed.spacing}


CASE = {"excavation": excavation_case, "wheel": wheel_case}


def smoothed(series: np.ndarray) -> np.ndarray:
    """Centred mean over WINDOW of the frames from FIRST on; frames without a full window are left out."""
    return np.convolve(series[FIRST:], np.ones(WINDOW) / WINDOW, mode="valid")


def nrmse(ours: np.ndarray, theirs: np.ndarray) -> float:
    """RMS difference over the RMS of the published series."""
    a, b = smoothed(ours), smoothed(theirs)
    return float(np.sqrt(np.mean((a - b) ** 2) / np.mean(b**2)))


def campaign_of(options: argparse.Namespace) -> tuple[list[PublishedRun], Campaign]:
    """The published runs in the order of their cases, and the campaign that makes them."""
    published = sorted(read_published(options.published), key=lambda run: run.case)
    published = [run for run in published if options.only is None or run.case in options.only]
    name = options.kind if options.reference else f"published_{options.kind}"
    theirs = THEIR_WHEEL if name == "wheel" else ()
    config = composed("simulate", f"scene={name}", *theirs, *options.overrides)
    scenes = {}
    for run in published:
        for key, value in CASE[options.kind](run.case).items():
            OmegaConf.update(config, f"scene.{key}", value)
        scenes[f"case_{run.case:03d}"] = scene_from_config(config)
    folder = options.runs or Path("data") / name
    split, drawn = dict.fromkeys(scenes, "test"), {name: {} for name in scenes}
    effects, precision = asked_effects(config), config.solver.precision
    campaign = Campaign("published_forces", folder, scenes, split, drawn, effects, precision, seed=0)
    return published, campaign


def needed(sinkage: np.ndarray, scene: Wheel, damping: float) -> np.ndarray:
    """The vertical force [N] that carries the wheel on its way down, without its inertia: weight minus damper.

    Args:
        sinkage: at the frames [mm].
    """
    speed = 1e-3 * np.gradient(sinkage, 1.0 / scene.frame_rate)
    return scene.load - scene.load / scene.gravity * damping * speed


def series_of(file: Path, theirs: PublishedRun, scene: Scene) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Our and their forces [N] and sinkages [mm] by name; a shorter scene.duration compares what there is."""
    # The authors' frame i is our frame i + 1: their poses agree with ours there to 0.1 mm.
    first = 1 + (round(scene.settle * scene.frame_rate) if isinstance(scene, Wheel) else 0)
    with Run(file) as run:
        force, pose = (values[first : first + len(theirs.force)] for values in (run.force, run.pose))
    published = theirs.force[: len(force)]
    vertical = force[:, 2], published[:, 2]
    if not isinstance(scene, Wheel):
        return {"draft": (-force[:, 0], -published[:, 0]), "vertical": vertical}
    height = theirs.body_points[: len(force), :, 2].mean(axis=1)
    sinkage = 1e3 * scene.sinkage(pose), 1e3 * (0.5 * scene.diameter - height)
    carrying = needed(sinkage[0], scene, scene.damping), needed(sinkage[1], scene, PUBLISHED_DAMPING)
    return {
        "pull": (force[:, 0], published[:, 0]),
        "vertical": vertical,
        "sinkage": sinkage,
        "needed": carrying,
    }


def row_of(series: dict[str, tuple[np.ndarray, np.ndarray]]) -> dict[str, float]:
    """Means [N, mm], correlation and NRMSE of every series; of a wheel also what its motion needs."""
    row = {}
    for name, (a, b) in ((name, pair) for name, pair in series.items() if name != "needed"):
        row[f"{name}_mean"], row[f"{name}_published"] = smoothed(a).mean(), smoothed(b).mean()
        row[f"{name}_correlation"] = np.corrcoef(smoothed(a), smoothed(b))[0, 1]
        row[f"{name}_nrmse"] = nrmse(a, b)
    if "needed" in series:
        carried = [smoothed(one).mean() for one in series["needed"]]
        row["published_over_needed"] = row["vertical_published"] / carried[1]
        row["over_needed"] = row["vertical_mean"] / carried[0]
        # What the published force would be if it carried the published wheel, against ours.
        row["needed_nrmse"] = nrmse(series["vertical"][0], series["needed"][1])
        # What the wheel pulls for what it bears: the same if all forces are off by the same factor.
        row["traction"] = row["pull_mean"] / row["vertical_mean"]
        row["traction_published"] = row["pull_published"] / row["vertical_published"]
    return {key: round(float(value), 3) for key, value in row.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kind", choices=CASE)
    parser.add_argument("published", help="folder with valid.tfrecord and metadata.json")
    parser.add_argument("--reference", action="store_true", help="at the reference setting")
    parser.add_argument("--runs", type=Path, help="folder for the run files (default: data/<scene>)")
    parser.add_argument("--other-draw", type=Path, help="such a folder, of another seed, to compare with")
    parser.add_argument("--workers", type=int, help="runs at once (default: one per core)")
    parser.add_argument("--only", type=int, action="append", help="number of a case to make (default: all)")
    parser.add_argument(
        "--table", help="name of the table to write, without a figure (default: both, by kind)"
    )
    parser.add_argument("overrides", nargs="*", help="changes of the scene, for example scene.friction=0.5")
    options = parser.parse_intermixed_args()
    if options.only and not options.table:
        parser.error("--only would leave the others out of the table; give --table another name")
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    published, campaign = campaign_of(options)
    if options.kind == "excavation" and not options.reference and options.table is None:
        ripples = [ripple(run, campaign.scenes[f"case_{run.case:03d}"]) for run in published]
        write_rows(HERE / "ripple.csv", ripples)
    simulate_campaign(campaign, device="cpu", workers=options.workers)

    rows: list[dict[str, float | str]] = []
    columns = 3 if options.kind == "wheel" else 2
    figure = plt.figure(figsize=(14, 2.4 * len(published) + 1), layout="constrained")
    axes = figure.subplots(len(published), columns, sharex=True, squeeze=False)
    for line, theirs in zip(axes, published, strict=True):
        file, scene = campaign.file(f"case_{theirs.case:03d}"), campaign.scenes[f"case_{theirs.case:03d}"]
        series, values = series_of(file, theirs, scene), CASE[options.kind](theirs.case)
        row = {"case": theirs.case, **values, **row_of(series)}
        if options.other_draw and (other := options.other_draw / "runs" / file.name).exists():
            name, (ours, _) = next(iter(series.items()))
            row[f"{name}_nrmse_other_draw"] = round(nrmse(series_of(other, theirs, scene)[name][0], ours), 3)
        rows.append(row)
        time = (FIRST + WINDOW // 2 + 1 + np.arange(len(smoothed(series["vertical"][0])))) / 60.0
        for number, (axis, (name, (a, b))) in enumerate(zip(line, series.items(), strict=False)):
            axis.plot(time, smoothed(b), color=f"C{number}", lw=1, ls="--", label="published")
            axis.plot(time, smoothed(a), color=f"C{number}", lw=1.4, label="sgns")
            if name == "vertical" and "needed" in series:
                axis.plot(time, smoothed(series["needed"][1]), "k:", lw=1, label="needed by their motion")
            axis.set_title(f"{theirs.case}: {name}, NRMSE {row[f'{name}_nrmse']:.2f}", fontsize=9)
            axis.set_ylabel("mm" if name == "sinkage" else "N")
            axis.grid(alpha=0.3)
        words = ", ".join(f"{key} {v:.3g}" if isinstance(v, float) else str(v) for key, v in values.items())
        line[0].set_title(f"{line[0].get_title()}\n{words}", fontsize=9)
    axes[0, 1].legend(fontsize=8)
    figure.supxlabel("time [s]")
    table, picture = RESULT[options.kind, options.reference]
    if options.table is None:
        figure.savefig(HERE / f"{picture}.png", dpi=80)
    table = options.table or table
    write_rows(HERE / f"{table}.csv", rows, digits=6)
    for key in [key for key in rows[0] if "nrmse" in key]:
        errors = [row[key] for row in rows if key in row]
        logging.info("%s: median %.3f, %.3f to %.3f", key, np.median(errors), min(errors), max(errors))


if __name__ == "__main__":
    main()
