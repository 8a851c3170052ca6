"""The published excavation runs, simulated at the published settings and compared with the published forces.

    python experiments/published_forces/run.py <folder of the authors' excavation files>

Makes one run file per case (about 200 MB each, in data/published_forces; finished ones are kept), then table.csv and
histories.png beside this script.
"""

from __future__ import annotations

import argparse
import csv
import logging
from pathlib import Path

import matplotlib
import numpy as np
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf

from sgns.campaign import Campaign
from sgns.published import excavation_case, read_published
from sgns.runfile import Run
from sgns.scenes import scene_from_config
from sgns.simulate import simulate_campaign

matplotlib.use("Agg")
import matplotlib.pyplot as plt

HERE = Path(__file__).parent
WINDOW = 15  # frames of the centred mean: ours are frame means, theirs samples of one substep
FIRST = 10  # the frames before hold the published runs' settling spike


def smoothed(series: np.ndarray) -> np.ndarray:
    """Centred mean over WINDOW frames, from frame FIRST on; frames without a full window are left out."""
    half = WINDOW // 2
    mean = np.convolve(series, np.ones(WINDOW) / WINDOW, mode="valid")
    return mean[FIRST - half :]


def compared(ours: np.ndarray, theirs: np.ndarray) -> dict[str, float]:
    """Means [N], correlation and NRMSE (RMS difference over RMS of the published series)."""
    a, b = smoothed(ours), smoothed(theirs)
    return {
        "mean": a.mean(),
        "published": b.mean(),
        "correlation": np.corrcoef(a, b)[0, 1],
        "nrmse": np.sqrt(np.mean((a - b) ** 2) / np.mean(b**2)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("published", help="folder with valid.tfrecord and metadata.json")
    parser.add_argument("--runs", default="data/published_forces", help="folder for the run files")
    parser.add_argument("--workers", type=int, default=None, help="runs at once (default: one per core)")
    parser.add_argument("overrides", nargs="*", help="changes of the scene, for example scene.courant=0.4")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")

    with initialize_config_module("sgns.conf", version_base="1.3"):
        config = compose("simulate", ["scene=published_excavation", *options.overrides])
    base = scene_from_config(config)
    published = {run.case: run for run in read_published(options.published, base.bed.size)}
    scenes = {}
    for case in published:
        for key, value in excavation_case(case).items():
            OmegaConf.update(config, f"scene.{key}", value)
        scenes[f"case_{case:03d}"] = scene_from_config(config)
    campaign = Campaign(
        "published_forces", Path(options.runs), scenes, dict.fromkeys(scenes, "test"), OmegaConf.to_object(config.effects), 0
    )
    simulate_campaign(campaign, device="cpu", precision=config.solver.precision, workers=options.workers)

    rows, figure = [], plt.figure(figsize=(12, 3.0 * 4), layout="constrained")
    axes = figure.subplots(4, 3, sharex=True).ravel()
    for axis, (case, theirs) in zip(axes, sorted(published.items()), strict=False):
        with Run(campaign.file(f"case_{case:03d}")) as run:
            # The authors' frame i is our frame i + 1: their poses agree with ours there to 0.1 mm.
            ours, seconds = run.force[1 : 1 + len(theirs.force)], run.wall_time_s / run.time[-1]
        row = {"case": case, **excavation_case(case)}
        for name, component, sign, colour in (("draft", 0, -1, "C0"), ("vertical", 2, 1, "C1")):
            result = compared(sign * ours[:, component], sign * theirs.force[:, component])
            row |= {f"{name}_{key}": round(float(value), 3) for key, value in result.items()}
            time = (FIRST + 1 + np.arange(len(smoothed(ours[:, 0])))) / 60.0
            axis.plot(time, smoothed(sign * theirs.force[:, component]), color="0.2" if name == "draft" else "0.6", lw=1.2,
                      label=f"{name}, published")  # fmt: skip
            axis.plot(time, smoothed(sign * ours[:, component]), color=colour, lw=1.2, label=f"{name}, sgns")
        row["s_per_simulated_s"] = round(seconds, 1)
        rows.append(row)
        axis.set_title(
            f"{case}: {100 * row['depth']:g} cm, {100 * row['speed']:g} cm/s, {row['rake']:g}°, {row['motion']}\n"
            f"NRMSE {row['draft_nrmse']:.2f} draft, {row['vertical_nrmse']:.2f} vertical",
            fontsize=9,
        )
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    axes[-1].axis("off")
    figure.supxlabel("time [s]")
    figure.supylabel("force on the blade [N]")
    figure.savefig(HERE / "histories.png", dpi=110)
    with (HERE / "table.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    for name in ("draft", "vertical"):
        errors = [row[f"{name}_nrmse"] for row in rows]
        logging.info("%s: median NRMSE %.3f, %.3f to %.3f", name, np.median(errors), min(errors), max(errors))


if __name__ == "__main__":
    main()
