"""The published excavation runs, simulated at the published settings and compared with the published forces.

    python experiments/published_forces/run.py <folder of the authors' excavation files>

Makes one run file per case (about 200 MB each, in data/published_excavation; finished ones are kept), then table.csv
and histories.png beside this script. With `--scene excavation` the same cuts at the reference setting, into files of
that name.
"""

from __future__ import annotations

import argparse
import csv
import logging
from collections.abc import Callable
from pathlib import Path

import matplotlib
import numpy as np
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf

from sgns.data.published import PublishedRun, excavation_case, read_published
from sgns.data.run import Run
from sgns.simulate.campaign import Campaign
from sgns.simulate.command import simulate_campaign
from sgns.simulate.scene import asked_effects, scene_from_config

matplotlib.use("Agg")
import matplotlib.pyplot as plt

HERE = Path(__file__).parent
WINDOW = 15  # frames of the centred mean: ours are frame means, theirs samples of one substep
FIRST = 10  # the frames before hold the published runs' settling spike; they enter nowhere


def smoothed(series: np.ndarray) -> np.ndarray:
    """Centred mean over WINDOW of the frames from FIRST on; frames without a full window are left out."""
    return np.convolve(series[FIRST:], np.ones(WINDOW) / WINDOW, mode="valid")


def first_third(travel: np.ndarray) -> np.ndarray:
    """Which frames lie in the first third of the blade's way along x, shape (T,)."""
    return travel < travel[0] + (travel[-1] - travel[0]) / 3.0


def compared(ours: np.ndarray, theirs: np.ndarray) -> dict[str, float]:
    """Means [N], correlation and NRMSE (RMS difference over RMS of the published series)."""
    a, b = smoothed(ours), smoothed(theirs)
    return {
        "mean": a.mean(),
        "published": b.mean(),
        "correlation": np.corrcoef(a, b)[0, 1],
        "nrmse": np.sqrt(np.mean((a - b) ** 2) / np.mean(b**2)),
    }


def campaign_of(
    options: argparse.Namespace,
    values_of: Callable[[int], dict[str, float | str]],
    cases: list[int] | None = None,
) -> tuple[list[PublishedRun], Campaign]:
    """The published runs in the order of their cases, and the campaign that makes them with `options.scene`.

    Args:
        options: published, scene, runs and overrides of the command line.
        values_of: the scene's keys of a case.
        cases: only these; None: all.
    """
    with initialize_config_module("sgns.conf", version_base="1.3"):
        config = compose("simulate", [f"scene={options.scene}", *options.overrides])
    published = read_published(options.published)
    published = sorted((r for r in published if not cases or r.case in cases), key=lambda run: run.case)
    scenes = {}
    for run in published:
        for key, value in values_of(run.case).items():
            OmegaConf.update(config, f"scene.{key}", value)
        scenes[f"case_{run.case:03d}"] = scene_from_config(config)
    campaign = Campaign(
        "published_forces",
        Path(options.runs or f"data/{options.scene}"),
        scenes,
        dict.fromkeys(scenes, "test"),
        asked_effects(config),
        config.solver.precision,
        seed=0,
    )
    return published, campaign


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("published", help="folder with valid.tfrecord and metadata.json")
    parser.add_argument("--runs", default=None, help="folder for the run files (default: data/<scene>)")
    parser.add_argument(
        "--scene",
        default="published_excavation",
        help="published_excavation, or excavation: the reference setting",
    )
    parser.add_argument("--results", default=HERE, type=Path, help="folder for the table and the figure")
    parser.add_argument("--cases", type=int, nargs="*", help="only these case numbers")
    parser.add_argument("--workers", type=int, default=None, help="runs at once (default: one per core)")
    parser.add_argument("overrides", nargs="*", help="changes of the scene, for example scene.courant=0.4")
    options = parser.parse_intermixed_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")

    published, campaign = campaign_of(options, excavation_case, options.cases)
    simulate_campaign(campaign, device="cpu", workers=options.workers)
    suffix = "" if options.scene == "published_excavation" else f"_{options.scene}"

    rows = []
    figure = plt.figure(figsize=(13, 12), layout="constrained")
    axes = figure.subplots(4, 3, sharex=True).ravel()
    for axis, theirs in zip(axes, published, strict=False):
        with Run(campaign.file(f"case_{theirs.case:03d}")) as run:
            # The authors' frame i is our frame i + 1: their poses agree with ours there to 0.1 mm.
            ours, seconds = run.force[1 : 1 + len(theirs.force)], run.wall_time_s / run.time[-1]
        published_force = theirs.force[: len(ours)]  # a shorter scene.duration compares what there is
        row = {"case": theirs.case, **excavation_case(theirs.case)}
        for name, component, sign, colour in (("draft", 0, -1, "C0"), ("vertical", 2, 1, "C1")):
            a, b = sign * ours[:, component], sign * published_force[:, component]
            row |= {f"{name}_{key}": round(float(value), 3) for key, value in compared(a, b).items()}
            time = (FIRST + WINDOW // 2 + 1 + np.arange(len(smoothed(b)))) / 60.0
            axis.plot(time, smoothed(b), color=colour, lw=1, ls="--", label=f"{name}, published")
            axis.plot(time, smoothed(a), color=colour, lw=1.4, label=f"{name}, sgns")
        rows.append(row | {"s_per_simulated_s": round(seconds, 1)})
        axis.set_title(
            f"{theirs.case}: {100 * row['depth']:g} cm, {100 * row['speed']:g} cm/s, "
            f"{row['rake']:g}°, {row['motion']}\n"
            f"NRMSE {row['draft_nrmse']:.2f} draft, {row['vertical_nrmse']:.2f} vertical",
            fontsize=9,
        )
        axis.grid(alpha=0.3)
    axes[-1].axis("off")
    axes[-1].legend(*axes[0].get_legend_handles_labels(), loc="center")
    figure.supxlabel("time [s]")
    figure.supylabel("force on the blade, centred mean over 0.25 s [N]")
    options.results.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.results / f"histories{suffix}.png", dpi=100)
    with (options.results / f"table{suffix}.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    for name in ("draft", "vertical"):
        errors = [row[f"{name}_nrmse"] for row in rows]
        logging.info("%s: median NRMSE %.3f, %.3f to %.3f", name, np.median(errors), min(errors), max(errors))


if __name__ == "__main__":
    main()
