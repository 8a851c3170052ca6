"""The published wheel runs, simulated at the published settings and compared with the published forces and sinkage.

    python experiments/published_forces/wheel.py <folder of the authors' wheel files>

Makes one run file per case (about 80 MB each, in data/published_wheel; finished ones are kept), then wheel.csv and
wheel.png beside this script. With `--scene wheel` the same wheels on the bed, grid and numerics of that scene, the
reference setting, into wheel_reference.*.
"""

from __future__ import annotations

import argparse
import csv
import logging
from pathlib import Path

import numpy as np
from run import FIRST, HERE, WINDOW, campaign_of, compared, plt, smoothed

from mpm_warp import Wheel
from sgns.data.published import wheel_case
from sgns.data.run import Run
from sgns.simulate.command import simulate_campaign

SERIES = (("pull", "drawbar pull", "C0"), ("vertical", "vertical force", "C1"), ("sinkage", "sinkage", "C2"))
PUBLISHED_DAMPING = 500.0  # of the published wheels' height [1/s]
THEIR_WHEEL = (  # what scene=published_wheel has of the wheel and its motion, beside what differs between the cases
    "scene.friction=3",
    "scene.bilateral=true",
    f"scene.damping={PUBLISHED_DAMPING}",
    "scene.settle=4",
    "scene.clearance=0.0132890365",
    "scene.duration=9.3333333333",
)


def ours(file: Path, scene: Wheel, count: int) -> dict[str, np.ndarray]:
    """Drawbar pull and vertical force [N] and sinkage [mm] in the `count` frames after settling."""
    first = round(scene.settle * scene.frame_rate) + 1
    with Run(file) as run:
        force, pose = (values[first : first + count] for values in (run.force, run.pose))
    return {"pull": force[:, 0], "vertical": force[:, 2], "sinkage": 1e3 * scene.sinkage(pose)}


def needed(sinkage: np.ndarray, scene: Wheel, damping: float) -> np.ndarray:
    """The vertical force [N] that carries the wheel on its way down, without its inertia: weight minus damper.

    Args:
        sinkage: at the frames [mm].
    """
    return scene.load - scene.load / scene.gravity * damping * 1e-3 * np.gradient(
        sinkage, 1.0 / scene.frame_rate
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("published", help="folder with valid.tfrecord and metadata.json")
    parser.add_argument("--runs", default=None, help="folder for the run files (default: data/<scene>)")
    parser.add_argument("--results", default=HERE, type=Path, help="folder for the table and the figure")
    parser.add_argument(
        "--scene",
        default="published_wheel",
        choices=("published_wheel", "wheel"),
        help="wheel: the reference setting",
    )
    parser.add_argument("--workers", type=int, default=None, help="runs at once (default: one per core)")
    parser.add_argument("--cases", type=int, nargs="*", help="only these case numbers")
    parser.add_argument("overrides", nargs="*", help="changes of the scene, for example scene.friction=0.5")
    options = parser.parse_intermixed_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")

    if options.scene == "wheel":
        options.overrides = [*THEIR_WHEEL, *options.overrides]
    published, campaign = campaign_of(options, wheel_case, options.cases)
    simulate_campaign(campaign, device="cpu", workers=options.workers)
    stem = "wheel" if options.scene == "published_wheel" else "wheel_reference"

    rows = []
    figure = plt.figure(figsize=(14, 2.4 * len(published) + 1), layout="constrained")
    axes = figure.subplots(len(published), 3, sharex=True, squeeze=False)
    for line, theirs in zip(axes, published, strict=True):
        name = f"case_{theirs.case:03d}"
        scene = campaign.scenes[name]
        height = theirs.body_points[..., 2].mean(axis=1)
        there = {
            "pull": theirs.force[:, 0],
            "vertical": theirs.force[:, 2],
            "sinkage": 1e3 * (0.5 * scene.diameter - height),
        }
        here = ours(campaign.file(name), scene, len(height))
        row = {"case": theirs.case, **wheel_case(theirs.case)}
        for axis, (key, label, colour) in zip(line, SERIES, strict=True):
            # Shorter runs (scene.duration) compare what there is.
            a, b = here[key], there[key][: len(here[key])]
            row |= {f"{key}_{what}": round(float(value), 3) for what, value in compared(a, b).items()}
            time = (FIRST + WINDOW // 2 + 1 + np.arange(len(smoothed(b)))) / 60.0
            axis.plot(time, smoothed(b), color=colour, lw=1, ls="--", label="published")
            axis.plot(time, smoothed(a), color=colour, lw=1.4, label="sgns")
            axis.set_title(f"{theirs.case}: {label}", fontsize=9)
            axis.set_ylabel("mm" if key == "sinkage" else "N")
            axis.grid(alpha=0.3)
        line[0].set_title(
            f"{theirs.case}: drawbar pull ({scene.gravity:g} m/s², {scene.load:.0f} N, "
            f"{100 * scene.diameter:g} cm, {scene.friction_angle:g}°, slip {scene.slip:.2f})",
            fontsize=9,
        )
        carried = {
            "published": needed(there["sinkage"], scene, PUBLISHED_DAMPING)[: len(here["sinkage"])],
            "sgns": needed(here["sinkage"], scene, scene.damping),
        }
        line[1].plot(time, smoothed(carried["published"]), "k:", lw=1, label="needed by the published motion")
        row["published_over_needed"] = row["vertical_published"] / smoothed(carried["published"]).mean()
        row["over_needed"] = row["vertical_mean"] / smoothed(carried["sgns"]).mean()
        # What the published force would be if it carried the published wheel, against ours.
        row["needed_nrmse"] = compared(here["vertical"], carried["published"])["nrmse"]
        # What the wheel pulls for what it bears: the same if all forces are off by the same factor.
        row["traction"] = row["pull_mean"] / row["vertical_mean"]
        row["traction_published"] = row["pull_published"] / row["vertical_published"]
        rows.append({key: round(value, 3) for key, value in row.items()})
    axes[0, 1].legend(fontsize=8)
    axes[0, 0].legend(fontsize=8)
    figure.supxlabel("time since the wheel began to drive [s]")
    options.results.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.results / f"{stem}.png", dpi=80)
    with (options.results / f"{stem}.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    labels = {key: label for key, label, _ in SERIES} | {"needed": "vertical force against the needed one"}
    for key, label in labels.items():
        errors = [row[f"{key}_nrmse"] for row in rows]
        logging.info(
            "%s: median NRMSE %.3f, %.3f to %.3f", label, np.median(errors), min(errors), max(errors)
        )
    off = [abs(row["traction"] - row["traction_published"]) for row in rows]
    logging.info(
        "pull over vertical force: median difference %.3f, %.3f to %.3f", np.median(off), min(off), max(off)
    )


if __name__ == "__main__":
    main()
