"""figure.png from the tables of cut.py and wheel.py.

python experiments/inverse/figure.py
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
from common import read_rows  # noqa: E402

COLOURS = {"guess": "0.6", "gradient": "tab:blue", "differential evolution": "tab:orange"}


def draw_cuts(paths: plt.Axes, worth: plt.Axes) -> None:
    """Tips' paths of the cuts that were found; below what network and solver say they are worth."""
    rows = [row for row in read_rows(HERE / "table.csv") if "cut" in row["problem"]]
    cuts = read_rows(HERE / "cuts.csv")
    for problem, line in (("cut of the trained kind", "-"), ("free cut", ":")):
        for start in {row["start"]: None for row in rows if row["problem"] == problem}:
            own = [c for c in cuts if (c["problem"], c["method"], c["start"]) == (problem, "gradient", start)]
            paths.plot(
                [100 * float(c["x"]) for c in own], [100 * float(c["z"]) for c in own], line, color="tab:blue"
            )
        paths.plot([], [], line, color="tab:blue", label=problem)
    paths.set(xlabel="tip moved along x [cm]", ylabel="and z [cm]", title="a  cuts found by gradients")
    paths.legend(fontsize=7)
    for method, colour in COLOURS.items():
        for problem, marker in (("cut of the trained kind", "o"), ("free cut", "x")):
            own = [row for row in rows if (row["method"], row["problem"]) == (method, problem)]
            worth.plot(
                [float(row["network"]) for row in own],
                [float(row["solver"]) for row in own],
                marker,
                color=colour,
                label=f"{method}, {problem.removeprefix('cut of the ').removesuffix(' cut')}",
            )
    top = 1.05 * max(float(row["network"]) for row in rows)
    worth.plot([0, top], [0, top], "-", color="0.8", zorder=0)
    worth.set(xlabel="network [l/J]", ylabel="solver [l/J]", title="soil per joule")
    worth.legend(fontsize=6)


def draw_slips(axes: plt.Axes) -> None:
    """Share of the axle's power that pulls, and the slip that was found."""
    curve = read_rows(HERE / "slips.csv")
    slips = [float(row["slip"]) for row in curve]
    for name, line in (("network", "-"), ("solver", "ko")):
        axes.plot(slips, [float(row[name]) for row in curve], line, label=name, markersize=4)
    found = [
        row
        for row in read_rows(HERE / "table.csv")
        if row["problem"] == "slip" and row["method"] == "gradient"
    ]
    for row in found:
        slip = float(row["found"].split()[1])
        axes.plot([slip], [float(row["network"])], "*", color="tab:red", markersize=12)
    axes.plot([], [], "*", color="tab:red", markersize=12, label=f"found, from {len(found)} starts")
    axes.set(xlabel="slip", ylabel="pull power / axle power", title="b  slip", ylim=(0, None))
    axes.legend(fontsize=7)


def draw_soils(axes: plt.Axes) -> None:
    """True and found angle and friction, with two standard deviations."""
    rows = [
        row for row in read_rows(HERE / "soils.csv") if (row["method"], row["start"]) == ("gradient", "high")
    ]
    for row in rows:
        number = {key: float(value) for key, value in row.items() if key not in ("method", "start")}
        axes.plot(number["angle_true"], number["friction_true"], "k+", markersize=9)
        axes.errorbar(
            number["angle"],
            number["friction"],
            xerr=2 * number["angle_deviation"],
            yerr=2 * number["friction_deviation"],
            color="tab:blue",
            marker=".",
        )
        axes.plot(
            [number["angle_true"], number["angle"]],
            [number["friction_true"], number["friction"]],
            "0.7",
            lw=0.8,
        )
    axes.plot([], [], "k+", label="true")
    axes.errorbar([], [], xerr=[], yerr=[], color="tab:blue", marker=".", label="found ± 2 deviations")
    axes.set(xlabel="friction angle [°]", ylabel="wheel friction", title="c  soil behind two drives")
    axes.legend(fontsize=7)


def main() -> None:
    figure, axes = plt.subplots(1, 4, figsize=(15, 3.6), layout="constrained")
    draw_cuts(*axes[:2])
    draw_slips(axes[2])
    draw_soils(axes[3])
    figure.savefig(HERE / "figure.png", dpi=110)


if __name__ == "__main__":
    main()
