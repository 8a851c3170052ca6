"""Where the drafts at the published settings differ from the published ones: with the grid cells, or slowly?

    python experiments/published_forces/difference.py <folder of the authors' excavation files> <runs> [<redrawn runs>]

The two last are folders of run files that run.py has made, the second with another `seed`; it may hold some of the
cases only. Writes difference.csv and difference.png beside this script.
"""

from __future__ import annotations

import argparse
import csv
import logging
import math
from pathlib import Path

import numpy as np
from numpy.polynomial.chebyshev import chebvander
from run import FIRST, HERE, first_third, plt, smoothed

from mpm_warp import Scene
from sgns.data.published import excavation_case, read_published
from sgns.data.run import Run

HARMONICS = 3  # of the passage of a grid cell
SLOW = 8  # degree of the polynomial that stands for slow changes beside them


def run_of(folder: Path, case: int) -> tuple[np.ndarray, np.ndarray, Scene]:
    """Draft [N] and the blade's place along x [m] at the published frames, and the scene."""
    with Run(folder / "runs" / f"case_{case:03d}.h5") as run:
        return -run.force[1:, 0], run.pose[1:, 0], Scene.from_dict(run.scene)


def with_the_cells(values: np.ndarray, place: np.ndarray) -> np.ndarray:
    """The part of a series that repeats with every grid cell that the blade passes, fitted by least squares.

    Args:
        place: of the blade [grid cells].
    """
    waves = 2.0 * np.pi * place[:, None] * np.arange(1, HARMONICS + 1)
    slow = chebvander(2.0 * (place - place.min()) / np.ptp(place) - 1.0, SLOW)
    basis = np.concatenate([np.cos(waves), np.sin(waves), slow], axis=1)
    found = np.linalg.lstsq(basis, values, rcond=None)[0]
    return basis[:, : 2 * HARMONICS] @ found[: 2 * HARMONICS]


def spectrum(values: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Waves per grid cell and their share of the squares."""
    even = np.arange(place[0], place[-1], 0.05)
    values = np.interp(even, place, values)
    power = np.abs(np.fft.rfft(values * np.hanning(len(values)))) ** 2
    return np.fft.rfftfreq(len(even), 0.05), power / power.sum()


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("published", help="folder with valid.tfrecord and metadata.json")
    parser.add_argument("runs", type=Path, help="folder of run.py's run files")
    parser.add_argument("redrawn", type=Path, nargs="?", help="the same with another seed")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    published = sorted(read_published(options.published), key=lambda run: run.case)
    rows = []
    figure = plt.figure(figsize=(13, 4), layout="constrained")
    spectra, phases = figure.subplots(1, 2)
    for number, run in enumerate(published):
        ours, place, scene = run_of(options.runs, run.case)
        theirs = -run.force[: len(ours), 0]
        moving = np.concatenate([[True], np.diff(place) > 1e-6])  # the blade comes to rest before the end
        moving[:FIRST] = False
        cells = place / scene.bed.spacing
        frames = (theirs - ours)[moving]
        swing = with_the_cells(frames, cells[moving])
        slow, travel = smoothed(theirs - ours), smoothed(cells)
        still = len(slow) - np.argmax(np.diff(travel[::-1]) < -1e-4)  # first frame of the rest at the end
        fitted = np.zeros_like(slow)
        fitted[:still] = with_the_cells(slow[:still], travel[:still])
        scale = rms(smoothed(theirs))
        third = first_third(travel)
        row = {
            "case": run.case,
            **excavation_case(run.case),
            "cell_share_frames": 1.0 - rms(frames - swing) ** 2 / rms(frames) ** 2,
            "nrmse": rms(slow) / scale,
            "cell_share": 1.0 - rms(slow - fitted) ** 2 / rms(slow) ** 2,
            "nrmse_without_cells": rms(slow - fitted) / scale,
            "share_first_third": float(np.sum(slow[third] ** 2) / np.sum(slow**2)),
            "nrmse_after_first_third": rms(slow[~third]) / rms(smoothed(theirs)[~third]),
            "nrmse_other_draw": math.nan,
            "first_third": float(smoothed(ours)[third].mean()),
            "first_third_published": float(smoothed(theirs)[third].mean()),
        }
        if options.redrawn and (options.redrawn / "runs" / f"case_{run.case:03d}.h5").exists():
            row["nrmse_other_draw"] = rms(smoothed(run_of(options.redrawn, run.case)[0] - ours)) / scale
        rows.append({k: round(v, 3) if isinstance(v, float) else v for k, v in row.items()})
        colour = plt.get_cmap("viridis")(number / len(published))
        spectra.plot(*spectrum(frames, cells[moving]), color=colour, lw=1)
        phases.plot(
            (travel - travel[0]) / (travel[-1] - travel[0]), slow / scale, color=colour, lw=1, label=run.case
        )
    spectra.set(xlim=(0, 4), xlabel="waves per grid cell (13.3 mm) of travel", ylabel="share of the squares")
    spectra.set_title("published − ours, frame by frame", fontsize=10)
    phases.set(
        xlabel="travel of the blade, as a share of the whole", ylabel="over the RMS of the published draft"
    )
    phases.set_title("published − ours, means over 0.25 s", fontsize=10)
    phases.legend(title="run", fontsize=7, ncols=2)
    for axis in (spectra, phases):
        axis.grid(alpha=0.3)
    figure.savefig(HERE / "difference.png", dpi=90)
    with (HERE / "difference.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    for key in [name for name in rows[0] if "share" in name or "nrmse" in name]:
        values = [row[key] for row in rows if not math.isnan(row[key])]
        if values:
            logging.info(
                "%s: median %.3f, %.3f to %.3f, %d runs",
                key,
                np.median(values),
                min(values),
                max(values),
                len(values),
            )


if __name__ == "__main__":
    main()
